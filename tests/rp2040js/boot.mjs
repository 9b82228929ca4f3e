// Boots a Raspberry Pi Pico once, in the emulator rp2040js, and writes what it sends over USB to standard output, or
// connects its USB to a TCP port of this computer.
//
//     node boot.mjs FLASH SECONDS [WRITE [PORT]] < IMAGE.uf2
//     node boot.mjs FLASH SECONDS none -
//
// In the second form USB is standard input and output, and the image is that of the boot before.
//
// FLASH is a file with the content of the flash, empty at first: the image is flashed over it, as a UF2 file is, and it is
// kept for the next boot. The power is cut in the middle of the write with number WRITE, from 0 on, if there is one, after
// SECONDS, and when USB's other end is closed. The last line on standard error has the number of writes. It fails if
// anything reads the flash while that can't be read.
//
// The boot ROM is not there: its table leads to breakpoints, at which this file does what its routines do. It is stricter
// than they are: every routine must be called in its turn, with interrupts masked, for the last two sectors alone.

import fs from 'node:fs';
import net from 'node:net';
import { RP2040, Simulator, ConsoleLogger, LogLevel } from 'rp2040js';

const FLASH = 0x1000_0000;
const FLASH_LEN = 2 << 20;
const SECTOR = 4096;
const PAGE = 256;
const SLOTS = FLASH_LEN - 2 * SECTOR;
const RAM = 0x2000_0000;
const CYCLE = 1e9 / 125e6;
// How long a page and a sector take, in nanoseconds (W25Q16JV, typically).
const PROGRAM_TIME = 0.4e6;
const ERASE_TIME = 45e6;

const [path, seconds, cut, port] = process.argv.slice(2);
const simulator = new Simulator();
const { clock, rp2040: chip } = simulator;
const { core, usbCtrl: usb } = chip;
chip.logger = new ConsoleLogger(LogLevel.Error, false);

function fail(message) {
  console.error(`at ${(clock.nanos / 1e6).toFixed(2)} ms, pc ${core.PC.toString(16)}: ${message}`);
  process.exit(1);
}

// The flash, and the image in it: a boot loader erases the sectors that it writes.
chip.loadBootrom(rom());
chip.flash.set(fs.readFileSync(path));
const blocks = [];
const image = port === '-' ? Buffer.alloc(0) : fs.readFileSync(0);
for (let at = 0; at < image.length; at += 512) {
  blocks.push([image.readUInt32LE(at + 12) - FLASH, image.subarray(at + 32, at + 32 + PAGE)]);
}
for (const [at] of blocks) chip.flash.fill(0xff, at - (at % SECTOR), at - (at % SECTOR) + SECTOR);
for (const [at, page] of blocks) chip.flash.set(page, at);

// The ROM's table of functions: letters, address. At each address are a breakpoint with a number, and a return.
function rom() {
  const bytes = new Uint8Array(16 << 10);
  const view = new DataView(bytes.buffer);
  const stub = (at, number) => {
    view.setUint16(at, 0xbe00 | number, true);
    view.setUint16(at + 2, 0x4770, true);
    return at | 1;
  };
  view.setUint16(0x14, 0x100, true);
  view.setUint16(0x18, stub(0x80, 0), true);
  ['IF', 'EX', 'RE', 'RP', 'FC'].forEach((name, index) => {
    bytes.set(Buffer.from(name), 0x100 + 4 * index);
    view.setUint16(0x102 + 4 * index, stub(0x200 + 4 * index, index + 1), true);
  });
  return new Uint32Array(bytes.buffer);
}

// 'reading' is the only state in which the flash can be read.
let state = 'reading';
let writes = 0;
let hasPower = true;
const turn = (from, to) => {
  if (state !== from) fail(`the flash is ${state}, not ${from}`);
  state = to;
};
const routines = [
  () => turn('reading', 'connected'),
  () => turn('connected', 'taking commands'),
  ([at, count, block, command]) => {
    if (at % SECTOR || count !== SECTOR || block !== 1 << 16 || command !== 0xd8) fail(`erase ${at}, ${count}`);
    write(at, new Uint8Array(SECTOR).fill(0xff), ERASE_TIME);
  },
  ([at, from, count]) => {
    if (at % PAGE || count !== PAGE || from < RAM) fail(`program ${at}, ${from}, ${count}`);
    const page = chip.sram.subarray(from - RAM, from - RAM + PAGE);
    write(at, page.map((byte, index) => byte & chip.flash[at + index]), PROGRAM_TIME);
  },
  () => turn('taking commands', 'flushed'),
];

function write(at, bytes, time) {
  turn('taking commands', 'taking commands');
  if (at < SLOTS || at + bytes.length > FLASH_LEN) fail(`writes ${at.toString(16)}`);
  // In the middle of a write, some of the bits have changed.
  hasPower = String(writes) !== cut;
  bytes.forEach((byte, index) => {
    const changed = hasPower ? 0xff : (37 * (index + writes)) & 0xff;
    chip.flash[at + index] ^= (chip.flash[at + index] ^ byte) & changed;
  });
  writes += 1;
  clock.tick(time);
}

chip.onBreak = (number) => {
  const registers = core.registers;
  const given = [...registers.subarray(0, 4)].map((value) => value >>> 0);
  if (number === 0) {
    registers[0] = 0;
    for (let at = given[0]; chip.readUint16(at) !== 0; at += 4) {
      if (chip.readUint16(at) === given[1]) registers[0] = chip.readUint16(at + 2);
    }
    if (!registers[0]) fail(`the ROM has no routine ${given[1].toString(16)}`);
    return;
  }
  if (!core.PM) fail('interrupts are not masked');
  routines[number - 1](given);
  // A routine may leave anything here.
  [0, 1, 2, 3, 12].forEach((register) => (registers[register] = 0xdead_0000 + register));
};
for (const width of ['readUint32', 'readUint16', 'readUint8']) {
  const read = chip[width].bind(chip);
  chip[width] = (address) => {
    if (state !== 'reading' && address >>> 24 === FLASH >>> 24) fail(`${address.toString(16)} is read while the flash is ${state}`);
    return read(address);
  };
}
// The second stage of the boot loader, which is run from RAM, at last enables the flash's interface (SSIENR).
hook(chip.peripherals[0x18000], 'writeUint32', (offset, value) => {
  if (offset === 8 && (state === 'flushed' || state === 'reading')) state = value === 1 ? 'reading' : 'flushed';
});

function hook(object, name, then) {
  const plain = object[name].bind(object);
  object[name] = (...given) => {
    plain(...given);
    then(...given);
  };
}

// A host on the USB. It resets the robot 20 ms after that has pulled up its line (SIE_CTRL), gives it an address, selects
// its configuration, and says that somebody reads (DTR and RTS); each after the answer to the one before.
const requests = [[0, 5, 1, 0, 0, 0, 0, 0], [0, 9, 1, 0, 0, 0, 0, 0], [0x21, 0x22, 3, 0, 0, 0, 0, 0]];
const request = () => requests.length && usb.sendSetupPacket(new Uint8Array(requests.shift()));
let isPlugged = false;
const said = [];
let say = (bytes) => said.push(...bytes);
if (port) {
  const [input, output] = port === '-' ? [process.stdin, process.stdout] : Array(2).fill(await connected());
  say = (bytes) => output.write(bytes);
  input.on('data', (bytes) => heard.push(...bytes));
  for (const end of ['close', 'end', 'error']) input.on(end, () => (hasPower = false));
}

// Whoever listens at the port may not do so yet.
async function connected() {
  for (let tries = 0; tries < 100; tries += 1) {
    const socket = net.connect(port, '127.0.0.1');
    if (await new Promise((done) => socket.once('connect', () => done(true)).once('error', () => done(false)))) return socket;
    await new Promise((done) => setTimeout(done, 100));
  }
  return fail(`nobody listens at ${port}`);
}

hook(usb, 'writeUint32', (offset, value) => {
  if (offset !== 0x4c || !(value & (1 << 16)) || isPlugged) return;
  isPlugged = true;
  clock.createAlarm(() => usb.resetDevice()).schedule(20e6);
});
usb.onUSBEnabled = () => {};
usb.onResetReceived = request;
// What the host sends waits until the robot has a buffer for it.
const heard = [];
let room = 0;
const hear = () => {
  if (!room || !heard.length) return;
  usb.endpointReadDone(1, new Uint8Array(heard.splice(0, room)));
  room = 0;
};
usb.onEndpointRead = (endpoint, bytes) => {
  if (endpoint === 1) room = bytes;
  hear();
};
usb.onEndpointWrite = (endpoint, bytes) => {
  if (endpoint === 0 && bytes.length === 0) request();
  if (endpoint === 2 && requests.length === 0) say(bytes);
};
chip.peripherals[0x40058].onWatchdogTrigger = () => fail('the watchdog resets the robot');

// What rp2040js 1.4.1 does not model: the flags of a UART's receiver (UARTRSR) read as set.
for (const uart of chip.uart) {
  const read = uart.readUint32.bind(uart);
  uart.readUint32 = (offset) => (offset === 4 ? 0 : read(offset));
}

// Nor does it model that an interrupt which the program has set pending is so until it is taken, and that of a device for
// as long as the device asks for it.
const asking = new Set();
hook(core, 'setInterrupt', (number, value) => (value ? asking.add(number) : asking.delete(number)));
hook(core, 'exceptionEntry', (number) => {
  if (number >= 16) core.pendingInterrupts &= ~(1 << (number - 16));
});
hook(core, 'exceptionReturn', () => {
  for (const number of asking) core.pendingInterrupts |= 1 << number;
  core.interruptsUpdated = true;
});

core.VTOR = FLASH + PAGE;
core.reset();
const began = performance.now();
let looked = 0;
while (hasPower && clock.nanos < seconds * 1e9) {
  // Every millisecond, and no faster than in real time, the socket's events.
  if (port && clock.nanos > looked + 1e6) {
    looked = clock.nanos;
    hear();
    const ahead = looked / 1e6 - (performance.now() - began);
    await new Promise((done) => (ahead > 1 ? setTimeout(done, ahead) : setImmediate(done)));
  }
  // As in rp2040js itself, but a pending SysTick wakes the core as well, and exceptions begin at even addresses.
  if (core.waiting) {
    clock.tick(Math.max(clock.nanosToNextAlarm, CYCLE));
    core.waiting = !(core.pendingSystick || core.pendingInterrupts & core.enabledInterrupts);
  } else {
    core.PC &= ~1;
    clock.tick(core.executeInstruction() * CYCLE);
  }
}
fs.writeFileSync(path, chip.flash.subarray(0, FLASH_LEN));
fs.writeSync(1, Buffer.from(said));
console.error(`writes: ${writes}`);
if (port) process.exit();
