"""Ascon-AEAD128 (NIST SP 800-232) and the sealed frames of section 12 of protocol/SPEC.md.

Plain Python, written from the standard and the document alone: the oracle of the Rust code.
"""

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
