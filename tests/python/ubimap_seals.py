"""Ascon-AEAD128 (NIST SP 800-232) and the sealed frames of section 12 of protocol/SPEC.md.

Plain Python, written from the standard and the document alone: the oracle of the Rust code.
"""

from zlib import crc32

MASK = (1 << 64) - 1
CONSTANTS = (0x3C, 0x2D, 0x1E, 0x0F, 0xF0, 0xE1, 0xD2, 0xC3, 0xB4, 0xA5, 0x96, 0x87, 0x78, 0x69, 0x5A, 0x4B)
ROTATIONS = ((19, 28), (61, 39), (1, 6), (10, 17), (7, 41))
IV = 0x00001000808C0001


def rotate(word, by):
    return (word >> by | word << (64 - by)) & MASK


def permute(state, rounds):
    """The permutation Ascon-p with this number of rounds (SP 800-232, section 3)."""
    for constant in CONSTANTS[16 - rounds:]:
        s0, s1, s2, s3, s4 = state
        s2 ^= constant
        s0 ^= s4
        s4 ^= s3
        s2 ^= s1
        t0, t1, t2, t3, t4 = (
            s0 ^ (~s1 & s2), s1 ^ (~s2 & s3), s2 ^ (~s3 & s4), s3 ^ (~s4 & s0), s4 ^ (~s0 & s1)
        )
        t1 ^= t0
        t0 ^= t4
        t3 ^= t2
        t2 = ~t2
        words = (word & MASK for word in (t0, t1, t2, t3, t4))
        state[:] = [word ^ rotate(word, a) ^ rotate(word, b) for word, (a, b) in zip(words, ROTATIONS)]


def words(data):
    return [int.from_bytes(data[at:at + 8], "little") for at in range(0, len(data), 8)]


def pad(block):
    return block + b"\x01" + bytes(15 - len(block))


def begin(key, nonce, clear):
    state = [IV, *words(key), *words(nonce)]
    permute(state, 12)
    state[3] ^= words(key)[0]
    state[4] ^= words(key)[1]
    if clear:
        whole = len(clear) // 16 * 16
        for block in [*(clear[at:at + 16] for at in range(0, whole, 16)), pad(clear[whole:])]:
            low, high = words(block)
            state[0] ^= low
            state[1] ^= high
            permute(state, 8)
    state[4] ^= 1 << 63
    return state


def finish(state, key):
    low, high = words(key)
    state[2] ^= low
    state[3] ^= high
    permute(state, 12)
    return (state[3] ^ low).to_bytes(8, "little") + (state[4] ^ high).to_bytes(8, "little")


def rate(state):
    return state[0].to_bytes(8, "little") + state[1].to_bytes(8, "little")


def absorb(state, block):
    state[0], state[1] = words(block)


def xor(one, other):
    return bytes(a ^ b for a, b in zip(one, other))


def encrypt(key, nonce, clear, text):
    """The ciphertext and the tag."""
    state, sealed = begin(key, nonce, clear), b""
    for at in range(0, len(text) + 1, 16):
        block = text[at:at + 16]
        if len(block) == 16:
            absorb(state, xor(rate(state), block))
            sealed += rate(state)
            permute(state, 8)
        else:
            absorb(state, xor(rate(state), pad(block)))
            sealed += rate(state)[:len(block)]
    return sealed, finish(state, key)


def decrypt(key, nonce, clear, sealed, tag):
    """The text, or None if the tag is wrong."""
    state, text = begin(key, nonce, clear), b""
    for at in range(0, len(sealed) + 1, 16):
        block = sealed[at:at + 16]
        plain = xor(rate(state), block)
        text += plain
        if len(block) == 16:
            absorb(state, block)
            permute(state, 8)
        else:
            absorb(state, xor(rate(state), pad(plain)))
    return text if finish(state, key) == tag else None


HELLO, ANSWER, SESSION = 1, 2, 3
SEALED = 1 << 15


def u16(value):
    return value.to_bytes(2, "little")


def u32(value):
    return value.to_bytes(4, "little")


def u64(value):
    return value.to_bytes(8, "little")


def header(kind, sequence, version=1):
    return u16(sequence | kind << 11 | version << 13 | SEALED)


def session_key(key, robot, boot, clock, salt, session):
    nonce = bytes([0, 0]) + u16(robot) + u32(boot) + u64(clock)
    return encrypt(key, nonce, u64(salt) + u32(session), b"")[1]


def hello(key, robot, boot, clock, payload):
    """The frame of a Hello, before stuffing."""
    stamp = u16(robot) + u32(boot) + u64(clock)
    clear = header(0, 0) + stamp
    return clear + b"".join(encrypt(key, bytes([HELLO, 0]) + stamp, clear, payload))


def open_hello(key, frame):
    """Robot, boot, clock and payload, or None."""
    stamp = frame[2:16]
    payload = decrypt(key, bytes([HELLO, 0]) + stamp, frame[:16], frame[16:-16], frame[-16:])
    if payload is None:
        return None
    number = lambda start, end: int.from_bytes(stamp[start:end], "little")
    return number(0, 2), number(2, 6), number(6, 14), payload


def answer_parts(robot, salt, stamp):
    clear = header(0, 0) + u16(robot) + u64(salt)
    nonce = bytes([ANSWER, 0]) + u16(robot) + u32(0) + u64(salt)
    return clear, nonce, clear + (b"" if stamp is None else u32(stamp[0]) + u64(stamp[1]))


def answer(key, robot, salt, stamp, payload):
    """The frame of an answer to the Hello with this stamp; None for a Reset."""
    clear, nonce, associated = answer_parts(robot, salt, stamp)
    return clear + b"".join(encrypt(key, nonce, associated, payload))


def open_answer(key, stamp, frame):
    """Robot, salt and payload, or None."""
    robot, salt = (int.from_bytes(frame[a:b], "little") for a, b in ((2, 4), (4, 12)))
    _, nonce, associated = answer_parts(robot, salt, stamp)
    payload = decrypt(key, nonce, associated, frame[12:-16], frame[-16:])
    return None if payload is None else (robot, salt, payload)


def session_nonce(robot, session, direction, counter):
    return bytes([SESSION, direction]) + u16(robot) + u32(0) + u32(session) + u32(counter)


def frame(session_key, robot, session, direction, kind, sequence, counter, payload):
    """A frame of a session, before stuffing."""
    clear = header(kind, sequence) + u16(robot) + u16(counter & 0xFFFF)
    nonce = session_nonce(robot, session, direction, counter)
    return clear + b"".join(encrypt(session_key, nonce, clear, payload))


class Window:
    """The receiver's side of the counters (12.2, 12.3)."""

    def __init__(self):
        self.accepted = set()

    def whole(self, low):
        highest = max(self.accepted, default=0)
        ahead = (low - highest) % 65_536
        counter = highest + ahead
        if ahead >= 32_768 and counter >= 65_536:
            counter -= 65_536
        return counter - 65_536 if counter >= 1 << 32 else counter

    def is_old(self, counter):
        return counter in self.accepted or counter < max(self.accepted, default=0) - 64


class Opener:
    """One end of a session, for frames in one direction."""

    def __init__(self, session_key, robot, session, direction):
        self.key, self.robot, self.session, self.direction = session_key, robot, session, direction
        self.window = Window()

    def receive(self, contents):
        """"accepted" and the payload, or the rule of 12.3 that the frame breaks and None."""
        word = int.from_bytes(contents[:2], "little")
        if not word & SEALED:
            seal = crc32(u32(0) + bytes([self.direction]) + contents[:-4])
            return ("unsealed" if u32(seal) == contents[-4:] else "seal"), None
        kind = word >> 11 & 3
        if kind == 0:
            return ("handshake" if 28 <= len(contents) <= 62 else "shape"), None
        if kind == 3 or len(contents) < 22:
            return "shape", None
        robot, low = (int.from_bytes(contents[at:at + 2], "little") for at in (2, 4))
        if robot != self.robot:
            return "forged", None
        counter = self.window.whole(low)
        if self.window.is_old(counter):
            return "replayed", None
        nonce = session_nonce(self.robot, self.session, self.direction, counter)
        payload = decrypt(self.key, nonce, contents[:6], contents[6:-16], contents[-16:])
        if payload is None:
            return "forged", None
        self.window.accepted.add(counter)
        if word >> 13 & 3 != 1:
            return "version", None
        return "accepted", payload
