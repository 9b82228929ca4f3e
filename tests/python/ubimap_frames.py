"""How a robot writes and reads frames: on an open link (SPEC.md 2) or on a sealed one (12)."""

import os

import ubimap_wire as wire
from ubimap_wire import HANDSHAKE, KINDS, TO_ROBOT, TO_SERVER, VERSION, Refused

SEALED = 1 << 15
TAG = 16
#: Frames whose echo a Reset may name.
ECHOES = 4


class OpenFrames:
    """A CRC: against faults, on a wire that is trusted."""

    def __init__(self):
        self.session = 0

    def begin(self, session):
        self.session = session

    def capacity(self, frame):
        return wire.capacity(frame)

    def attempt(self, now):
        """A new attempt to open a session begins."""
        self.session = 0

    def hello(self, payload):
        return wire.write_frame(TO_SERVER, 0, VERSION, HANDSHAKE, 0, payload)

    def write(self, kind, sequence, payload):
        return wire.write_frame(TO_SERVER, self.session, VERSION, kind, sequence, payload)

    def read(self, frame, limit):
        """Kind, sequence number and payload."""
        return wire.read_frame(frame, TO_ROBOT, self.session, limit)[1:]

    def is_meant(self, reset):
        """Whether a Reset answers a frame of this robot."""
        return True


class SealedFrames:
    """Ascon-AEAD128 under a key that only this robot and the server have."""

    def __init__(self, number, key, boot):
        from ubimap_seals import decrypt, encrypt

        self.encrypt, self.decrypt = encrypt, decrypt
        self.robot, self.key, self.boot = number.to_bytes(2, "little"), key, boot
        self.session, self.clock, self.salt, self.greeting = 0, -1, b"", None

    def attempt(self, now):
        """Its stamp must be later than that of every earlier one."""
        self.session, self.clock, self.greeting = 0, max(now, self.clock + 1), None

    @property
    def stamp(self):
        return self.boot.to_bytes(4, "little") + self.clock.to_bytes(8, "little")

    def begin(self, session):
        """The session of the Welcome that was read last."""
        self.session = session
        number = session.to_bytes(4, "little")
        _, self.secret = self.encrypt(self.key, b"\0\0" + self.robot + self.stamp, self.salt + number, b"")
        self.written, self.highest, self.seen, self.echoes = 0, -1, 0, []

    def capacity(self, frame):
        return wire.capacity(frame) - 16

    def hello(self, payload):
        if self.greeting is None:
            clear = header(HANDSHAKE, 0) + self.robot + self.stamp
            text, tag = self.encrypt(self.key, b"\1\0" + self.robot + self.stamp, clear, payload)
            self.greeting = wire.stuff(clear + text + tag)
        return self.greeting

    def nonce(self, direction, counter):
        numbers = self.session.to_bytes(4, "little") + counter.to_bytes(4, "little")
        return bytes([3, direction]) + self.robot + bytes(4) + numbers

    def write(self, kind, sequence, payload):
        counter, self.written = self.written, self.written + 1
        clear = header(kind, sequence) + self.robot + (counter & 0xFFFF).to_bytes(2, "little")
        text, tag = self.encrypt(self.secret, self.nonce(TO_SERVER, counter), clear, payload)
        self.echoes = [*self.echoes, tag[:8]][-ECHOES:]
        return wire.stuff(clear + text + tag)

    def read(self, frame, limit):
        contents = wire.unstuff(frame[: frame.index(0)], max(limit, 64))
        word = int.from_bytes(contents[:2], "little")
        if len(contents) < 4 or not word & SEALED or contents[2:4] != self.robot:
            raise Refused("seal")
        number = word >> 11 & 3
        if number == 3:
            raise Refused("header")
        kind = KINDS[number]
        if kind == HANDSHAKE:
            return kind, word & 2047, self.read_answer(contents)
        payload = self.read_session(contents)
        if word >> 13 & 3 != VERSION:
            raise Refused("version")
        return kind, word & 2047, payload

    def read_answer(self, contents):
        clear, text, tag = contents[:12], contents[12:-TAG], contents[-TAG:]
        salt = clear[4:]
        nonce = b"\2\0" + self.robot + bytes(4) + salt
        for stamp in (self.stamp, b""):  # A Reset answers no Hello.
            payload = self.decrypt(self.key, nonce, clear + stamp, text, tag)
            if payload is not None:
                break
        if payload is None:
            raise Refused("forged")
        messages = wire.read_payload(payload)
        if not messages or messages[0] is None:
            raise Refused("payload")
        if (messages[0][0] == wire.NUMBERS[TO_ROBOT, "Reset"]) != (stamp == b""):
            raise Refused("forged")
        if not self.session and stamp:
            self.salt = salt
        return payload

    def read_session(self, contents):
        clear, text, tag = contents[:6], contents[6:-TAG], contents[-TAG:]
        if not self.session or len(contents) < 6 + TAG:
            raise Refused("seal")
        low = int.from_bytes(clear[4:], "little")
        # The number nearest to the highest one so far.
        counter = low + ((self.highest - low + 0x8000) & ~0xFFFF)
        counter = counter if counter >= 0 else low
        behind = self.highest - counter
        if behind > 64 or behind >= 0 and self.seen >> behind & 1:
            raise Refused("replayed")
        payload = self.decrypt(self.secret, self.nonce(TO_ROBOT, counter), clear, text, tag)
        if payload is None:
            raise Refused("forged")
        if behind < 0:
            self.seen, self.highest = self.seen << -behind & (1 << 65) - 1 | 1, counter
        else:
            self.seen |= 1 << behind
        return payload

    def is_meant(self, reset):
        """Whether a Reset (its body) names one of the newest frames."""
        try:
            echo = wire.Reader(reset).varint(64)
        except Refused:
            return False
        return echo.to_bytes(8, "little") in self.echoes


def header(kind, sequence):
    word = int.from_bytes(wire.write_header(VERSION, kind, sequence), "little") | SEALED
    return word.to_bytes(2, "little")


def read_key(path):
    """The key in a file of `ubimap keys make`: hex digits, and comments after `#`."""
    with open(path, encoding="ascii") as file:
        digits = "".join(line.split("#")[0].strip() for line in file)
    key = bytes.fromhex(digits)
    if len(key) != 16:
        raise ValueError(f"{path}: a key has 32 hex digits, this has {len(digits)}")
    return key


def count_boot(path):
    """Raises the counter in a file, and returns it. It is on disk before it is used."""
    boot = 0
    if os.path.exists(path):
        with open(path, encoding="ascii") as file:
            boot = int(file.read())
    with open(f"{path}.new", "w", encoding="ascii") as file:
        file.write(f"{boot + 1}\n")
        file.flush()
        os.fsync(file.fileno())
    os.replace(f"{path}.new", path)
    return boot + 1
