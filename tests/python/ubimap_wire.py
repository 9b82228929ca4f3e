"""The ubimap protocol, written from protocol/SPEC.md with the standard library alone.

It reads and writes frames, messages and tile updates, and keeps a receiver's window and replica.
What the document gives as code or as a layout is taken from the document (`ubimap_spec`); the rest
is here. Numbers in comments are sections of the document.
"""

import re
import zlib

import ubimap_spec as spec

TO_SERVER, TO_ROBOT = 0, 1
VERSION = 1
HANDSHAKE, RELIABLE, DATAGRAM = "handshake", "reliable", "datagram"
KINDS = [HANDSHAKE, RELIABLE, DATAGRAM]

globals().update(spec.CODE)
EVEN, MODELS = None, [256 * prior + 128 for prior in spec.PRIORS]


# 2.3, 2.4 Header and seal


def seal(session, direction, contents):
    crc = zlib.crc32(session.to_bytes(4, "little") + bytes([direction]) + contents)
    return crc.to_bytes(4, "little")


def write_header(version, kind, sequence):
    return (sequence | KINDS.index(kind) << 11 | version << 13).to_bytes(2, "little")


def write_frame(direction, session, version, kind, sequence, payload):
    contents = write_header(version, kind, sequence) + payload
    return stuff(contents + seal(session, direction, contents))


def read_frame(wire, direction, session, limit=1024):
    """2.6: (version, kind, sequence, payload) of one frame with its delimiter."""
    frame = unstuff(wire[: wire.index(0)], limit)
    contents, tail = frame[:-4], frame[-4:]
    inside = session != 0 and seal(session, direction, contents) == tail
    if len(frame) < 4 or not (inside or seal(0, direction, contents) == tail):
        raise Refused("seal")
    if len(contents) < 2:
        raise Refused("header")
    word = int.from_bytes(contents[:2], "little")
    if word >> 11 & 3 == 3:
        raise Refused("header")
    kind, payload = KINDS[word >> 11 & 3], contents[2:]
    if inside == (kind == HANDSHAKE):
        raise Refused("kind")
    version = word >> 13 & 3  # Bit 15 is of sealed frames (12).
    if inside and version != VERSION:
        raise Refused("version")
    if not inside:
        messages = read_payload(payload)
        if not messages or messages[0] is None:
            raise Refused("payload")
    return version, kind, word & 2047, payload


# 2.5 Payload


def read_payload(payload):
    """A list of (kind, body); it ends in None if the payload is malformed from there on."""
    messages, reader = [], Reader(payload)
    while reader.left():
        try:
            kind = reader.byte()
            messages.append((kind, reader.take(reader.varint(16))))
        except Refused:
            return messages + [None]
    return messages


def write_payload(messages):
    return b"".join(bytes([kind]) + write_varint(len(body)) + body for kind, body in messages)


# 1.2 Bytes


class Reader:
    def __init__(self, data):
        self.data, self.at = data, 0

    def left(self):
        return len(self.data) - self.at

    def take(self, count):
        if count > self.left():
            raise Refused("malformed")
        self.at += count
        return self.data[self.at - count : self.at]

    def byte(self):
        return self.take(1)[0]

    def varint(self, bits):
        return read_varint(self.byte, bits)


class Unsigned:
    """A number of some bits, below `bound` if there is one."""

    def __init__(self, bits, bound=None):
        self.bits, self.bound = bits, bound
        self.longest = 1 if bits == 8 else len(write_varint((bound or 1 << bits) - 1))

    def read(self, reader):
        value = reader.byte() if self.bits == 8 else reader.varint(self.bits)
        if self.bound and value >= self.bound:
            raise Refused("malformed")
        return value

    def write(self, value):
        return bytes([value]) if self.bits == 8 else write_varint(value)


class Signed:
    def __init__(self, bits):
        self.bits, self.longest = bits, (bits + 6) // 7

    def read(self, reader):
        return unzigzag(reader.varint(self.bits))

    def write(self, value):
        return write_varint(zigzag(value))


class Bool:
    longest = 1

    def read(self, reader):
        byte = reader.byte()
        if byte > 1:
            raise Refused("malformed")
        return byte == 1

    def write(self, value):
        return bytes([value])


class Option:
    def __init__(self, inner):
        self.inner, self.longest = inner, 1 + inner.longest

    def read(self, reader):
        return self.inner.read(reader) if Bool().read(reader) else None

    def write(self, value):
        return b"\0" if value is None else b"\1" + self.inner.write(value)


class Struct:
    """Fields by name. Those that were `added` may be missing, at the end of a body."""

    def __init__(self, fields, added=()):
        self.fields, self.longest = fields, sum(field.longest for field in fields.values())
        self.added = added

    def read(self, reader):
        there = ((name, field) for name, field in self.fields.items() if name not in self.added or reader.left())
        return {name: field.read(reader) for name, field in there}

    def write(self, value):
        there = (name for name in self.fields if name not in self.added or name in value)
        return b"".join(self.fields[name].write(value[name]) for name in there)


class Tuple:
    def __init__(self, parts):
        self.parts, self.longest = parts, sum(part.longest for part in parts)

    def read(self, reader):
        return [part.read(reader) for part in self.parts]

    def write(self, value):
        return b"".join(part.write(inner) for part, inner in zip(self.parts, value))


class Enum:
    """Variants in order: each a name, and what follows it or None."""

    def __init__(self, variants):
        self.variants = variants
        self.longest = 1 + max(inner.longest if inner else 0 for _, inner in variants)

    def read(self, reader):
        number = reader.varint(32)
        if number >= len(self.variants):
            raise Refused("malformed")
        name, inner = self.variants[number]
        return name if inner is None else {name: inner.read(reader)}

    def write(self, value):
        name = value if isinstance(value, str) else next(iter(value))
        number = [it[0] for it in self.variants].index(name)
        inner = self.variants[number][1]
        return write_varint(number) + (b"" if inner is None else inner.write(value[name]))


class List:
    def __init__(self, inner, bound):
        self.inner, self.bound, self.longest = inner, bound, 1 + bound * inner.longest

    def read(self, reader):
        count = reader.varint(32)
        if count > self.bound:
            raise Refused("malformed")
        return [self.inner.read(reader) for _ in range(count)]

    def write(self, value):
        return write_varint(len(value)) + b"".join(self.inner.write(inner) for inner in value)


class Text:
    def __init__(self, bound):
        self.bound, self.longest = bound, 1 + bound

    def read(self, reader):
        count = reader.varint(32)
        if count > self.bound:
            raise Refused("malformed")
        try:
            return reader.take(count).decode()
        except UnicodeDecodeError:
            raise Refused("malformed") from None

    def write(self, value):
        return write_varint(len(value.encode())) + value.encode()


# 5, 6 Messages, by the layouts of the document


def split(text, separator):
    """Splits where no bracket is open."""
    parts, depth = [""], 0
    for letter in text:
        depth += (letter in "([") - (letter in ")]")
        if letter == separator and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return [part.strip() for part in parts if part.strip()]


def fields_of(text):
    pairs = [part.split(" ", 1) for part in split(text, ",")]
    added = [name for name, kind in pairs if kind.endswith(" +")]
    return Struct({name: type_of(kind.removesuffix(" +")) for name, kind in pairs}, added)


def type_of(text):
    """What reads and writes a type, from its notation (5)."""
    if text in spec.TYPES:
        return type_of(spec.TYPES[text])
    if text.endswith("?"):
        return Option(type_of(text[:-1]))
    if text == "bool":
        return Bool()
    if number := re.fullmatch(r"([ui])(\d+)(?: < (\d+))?", text):
        bits = int(number[2])
        return Signed(bits) if number[1] == "i" else Unsigned(bits, int(number[3] or 0))
    if bounded := re.fullmatch(r"\[(.*); (\d+)\]", text):
        return List(type_of(bounded[1]), int(bounded[2]))
    if bounded := re.fullmatch(r"text (\d+)", text):
        return Text(int(bounded[1]))
    variants = [variant.split(" ", 1) for variant in split(text, "|")]
    if len(variants) > 1:
        return Enum([(it[0], variant_of(it[1]) if it[1:] else None) for it in variants])
    if text.startswith("("):
        return Tuple([type_of(part) for part in split(text[1:-1], ",")])
    return fields_of(text)


def variant_of(text):
    return fields_of(text[1:-1]) if text.startswith("(") else type_of(text)


DIRECTIONS = {"to server": TO_SERVER, "to robot": TO_ROBOT}
MESSAGES = {TO_SERVER: {}, TO_ROBOT: {}}
#: The number of each kind of message, by its direction and name, and the other way round.
NUMBERS, NAMES = {}, {}
for (way, kind), (name, layout) in spec.MESSAGES.items():
    MESSAGES[DIRECTIONS[way]][kind] = fields_of(layout)
    NUMBERS[DIRECTIONS[way], name] = kind
    NAMES[DIRECTIONS[way], kind] = name


def read_message(direction, kind, body):
    """The fields, and the bytes that follow them."""
    reader = Reader(body)
    fields = MESSAGES[direction][kind].read(reader)
    return fields, body[reader.at :]


def write_message(direction, kind, fields):
    return MESSAGES[direction][kind].write(fields)


# 4.5 What is agreed


def answer(hello, resolution, frame, server_epoch, stores, session, first_epoch):
    """Kind and fields of the answer to a hello."""
    reason = None
    if hello["min_version"] > VERSION or hello["version"] < VERSION:
        reason = {"Version": {"min": VERSION, "current": VERSION}}
    elif hello["resolution"] != resolution:
        reason = {"Resolution": resolution}
    elif hello["frame"] < 32:
        reason = {"Frame": 32}
    if reason:
        return 5, {"nonce": hello["nonce"], "reason": reason}
    return 1, {
        "nonce": hello["nonce"],
        "version": min(hello["version"], VERSION),
        "session": session,
        "frame": min(hello["frame"], frame, 1024),
        "server_epoch": server_epoch,
        "first_epoch": first_epoch,
        "stores": stores,
        "renumber": False,
    }


# 7.1 Tiles: 1,024 codes, row by row from the south-west

UNKNOWN = [0] * 1024


def from_planes(planes):
    words = [int.from_bytes(planes[4 * at : 4 * at + 4], "little") for at in range(64)]
    return [words[at // 32] >> at % 32 & 1 | (words[32 + at // 32] >> at % 32 & 1) << 1 for at in range(1024)]


def to_planes(cells):
    return b"".join(little_endian(word, 4) for word in planes(cells))


def digest(tiles):
    return sum(digest_entry(*(it[name] for name in ("x", "y", "epoch", "version", "hash"))) for it in tiles) % 2**64


# 8 Updates


def read_update(coded):
    """An update to read, a header at a time; the cells of each must be read before the next."""
    return Update(Decoder(coded, MODELS))


def write_update(tiles):
    """The update of these headers, each with its cells `was` and `new`."""
    update = Update(Encoder(MODELS))
    for header, was, new in tiles:
        update.header(header)
        update.cells(was, new)
    update.header(None)
    return update.coder.finish()


# 7.3 Replica


class Replica:
    """A tile as its receiver holds it: cells, stamp and the first missing cell."""

    def __init__(self):
        self.cells, self.epoch, self.version, self.next = list(UNKNOWN), 0, 0, 0

    @classmethod
    def of(cls, epoch):
        """Nothing, in this epoch."""
        nothing = cls()
        nothing.epoch = epoch
        return nothing

    def apply(self, update, header):
        """7.3: reads the cells after a header. After "base missing" nothing has changed, and the
        rest of the update cannot be read."""
        stamp, held = (header["epoch"], header["version"]), (self.epoch, self.version)
        whole, start, end = header["base"] is None, header["start"], header["end"]
        is_held = stamp == held and not self.next
        if whole and start == 0 and (stamp < held or is_held):
            cells = update.cells(UNKNOWN)
            if stamp < held or end == 1024 or cells[:end] == self.cells[:end]:
                return "old"
            self.cells, self.next = cells[:end] + UNKNOWN[end:], end
            return "partial"
        if whole and start > 0 and is_held:
            part = update.cells(self.cells[:start] + UNKNOWN[start:])
            self.cells = self.cells[:start] + part[start:end] + self.cells[end:]
            return "complete"
        if whole and start == 0:
            was = UNKNOWN
        elif start == 0 and held == (header["epoch"], header["base"]) and not self.next:
            was = self.cells
        elif start > 0 and held == stamp and self.next == start:
            was = self.cells
        else:
            return "base missing"
        self.cells = update.cells(was)
        self.epoch, self.version = stamp
        self.next = end % 1024
        return "partial" if self.next else "complete"

    def take(self, update):
        """What an update of this tile alone comes to: as `apply`, or "wrong base"."""
        header, before = update.header(), vars(self).copy()
        outcome = self.apply(update, header)
        if outcome != "base missing" and header["base"] is not None and header["start"] == 0:
            # The end of the update tells whether the base was the right one.
            try:
                update.header()
            except Refused:
                vars(self).update(before)
                return "wrong base"
        return outcome
