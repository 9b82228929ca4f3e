"""The ubimap protocol, written from protocol/SPEC.md with the standard library alone.

It reads and writes frames, messages and tile updates, and keeps a receiver's window and replica.
Numbers in comments are sections of the specification.
"""

import re
import struct
import zlib
from pathlib import Path

TO_SERVER, TO_ROBOT = 0, 1
VERSION = 1
HANDSHAKE, RELIABLE, DATAGRAM = "handshake", "reliable", "datagram"
KINDS = [HANDSHAKE, RELIABLE, DATAGRAM]


class Refused(Exception):
    """What came in breaks the rule that is named."""


# 2.2 Stuffing


def stuff(contents):
    out, block = bytearray(), bytearray()
    for index, byte in enumerate(contents):
        if byte:
            block.append(byte)
        if not byte:
            out += bytes([len(block) + 1]) + block
            block.clear()
        elif len(block) == 254 and index + 1 < len(contents):
            out += b"\xff" + block
            block.clear()
    return bytes(out + bytes([len(block) + 1]) + block + b"\0")


def unstuff(stuffed, limit):
    """The contents of what stood before one delimiter."""
    out, at, zero = bytearray(), 0, False
    while at < len(stuffed):
        code = stuffed[at]
        out += (b"\0" if zero else b"") + stuffed[at + 1 : at + code]
        at += code
        zero = code < 0xFF
    if len(out) > limit:
        raise Refused("too long")
    if at > len(stuffed):
        raise Refused("truncated")
    return bytes(out)


# 2.3, 2.4 Header and seal


def seal(session, direction, contents):
    crc = zlib.crc32(session.to_bytes(4, "little") + bytes([direction]) + contents)
    return crc.to_bytes(4, "little")


def write_frame(direction, session, version, kind, sequence, payload):
    word = sequence | KINDS.index(kind) << 11 | version << 13
    contents = word.to_bytes(2, "little") + payload
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
    version = word >> 13
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
    return b"".join(bytes([kind]) + varint(len(body)) + body for kind, body in messages)


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
        value = 0
        for index in range((bits + 6) // 7):
            byte = self.byte()
            value |= (byte & 127) << 7 * index
            if byte < 128:
                break
        else:
            raise Refused("malformed")
        if value >> bits:
            raise Refused("malformed")
        return value


def varint(value):
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes(out + bytes([value]))


class Unsigned:
    def __init__(self, bits):
        self.bits = bits

    def read(self, reader):
        return reader.byte() if self.bits == 8 else reader.varint(self.bits)

    def write(self, value):
        return bytes([value]) if self.bits == 8 else varint(value)


class Signed:
    def __init__(self, bits):
        self.bits = bits

    def read(self, reader):
        z = reader.varint(self.bits)
        return z >> 1 ^ -(z & 1)

    def write(self, value):
        return varint((value << 1 ^ value >> self.bits - 1) & (1 << self.bits) - 1)


class Bool:
    def read(self, reader):
        byte = reader.byte()
        if byte > 1:
            raise Refused("malformed")
        return byte == 1

    def write(self, value):
        return bytes([value])


class Option:
    def __init__(self, inner):
        self.inner = inner

    def read(self, reader):
        return self.inner.read(reader) if BOOL.read(reader) else None

    def write(self, value):
        return b"\0" if value is None else b"\1" + self.inner.write(value)


class Struct:
    def __init__(self, **fields):
        self.fields = fields

    def read(self, reader):
        return {name: field.read(reader) for name, field in self.fields.items()}

    def write(self, value):
        return b"".join(field.write(value[name]) for name, field in self.fields.items())


class Tuple:
    def __init__(self, *parts):
        self.parts = parts

    def read(self, reader):
        return [part.read(reader) for part in self.parts]

    def write(self, value):
        return b"".join(part.write(inner) for part, inner in zip(self.parts, value))


class Enum:
    """Variants in order: a name, or a name and what follows it."""

    def __init__(self, *variants):
        self.variants = [it if isinstance(it, tuple) else (it, None) for it in variants]

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
        return varint(number) + (b"" if inner is None else inner.write(value[name]))


class List:
    def __init__(self, inner, bound):
        self.inner, self.bound = inner, bound

    def read(self, reader):
        count = reader.varint(32)
        if count > self.bound:
            raise Refused("malformed")
        return [self.inner.read(reader) for _ in range(count)]

    def write(self, value):
        return varint(len(value)) + b"".join(self.inner.write(inner) for inner in value)


class Text:
    def __init__(self, bound):
        self.bound = bound

    def read(self, reader):
        count = reader.varint(32)
        if count > self.bound:
            raise Refused("malformed")
        try:
            return reader.take(count).decode()
        except UnicodeDecodeError:
            raise Refused("malformed") from None

    def write(self, value):
        return varint(len(value.encode())) + value.encode()


# 1.1 Quantities

U8, U16, U32, U64 = Unsigned(8), Unsigned(16), Unsigned(32), Unsigned(64)
I16, I32 = Signed(16), Signed(32)
BOOL = Bool()
MM, ANGLE, MOMENT = I32, U16, U64
POSE = Struct(x=MM, y=MM, heading=ANGLE)

# 5, 6 Messages

LAYER = Enum("Robot", "Coverage", "Fused")
TILE_ID = Struct(x=I16, y=I16)
STAMP = Struct(epoch=U32, version=U32)
PARAMETER_VALUE = Struct(parameter=U16, value=I32)
ACK = Struct(next=U16, later=U32)
TILE_UPDATE_HEAD = Struct(layer=LAYER, seconds=U32)
REQUEST = Struct(layer=LAYER, tiles=List(TILE_ID, 8))
DIGESTS = Struct(layer=LAYER, tiles=List(Struct(id=TILE_ID, stamp=STAMP, hash=U32), 8))
MESSAGES = {
    TO_SERVER: {
        0: ACK,
        1: Struct(
            version=U8, min_version=U8, robot=U16, nonce=U32, frame=U16, resolution=MM, fused_tiles=U16
        ),
        2: Struct(nonce=U16),
        3: TILE_UPDATE_HEAD,
        4: Struct(
            time=Option(MOMENT), pose=Option(POSE), odometry=Option(POSE), cells_refused=U32
        ),
        5: Struct(number=U32, **{"from": TILE_ID, "to": TILE_ID}),
        6: REQUEST,
        7: Struct(time=MOMENT, pose=POSE, first=ANGLE, step=I16, distances=List(U8, 64)),
        8: Struct(
            time=Option(MOMENT), severity=Enum("Info", "Warning", "Error"), code=U16, detail=Text(32)
        ),
        9: DIGESTS,
        10: Struct(
            number=U16,
            outcome=Enum("Done", "Unknown", "OutOfRange"),
            values=List(PARAMETER_VALUE, 16),
        ),
    },
    TO_ROBOT: {
        0: ACK,
        1: Struct(
            nonce=U32, version=U8, session=U32, frame=U16, server_epoch=U32, first_epoch=U32, stores=BOOL, renumber=BOOL
        ),
        2: Struct(nonce=U16, received=MOMENT, held_micros=U32),
        3: TILE_UPDATE_HEAD,
        4: Struct(
            time=MOMENT,
            pose=POSE,
            certainty=Struct(x=U16, y=U16, heading=U16),
            source=Enum("Camera", "MapMatch"),
            earlier=List(Struct(before_micros=U32, dx=I32, dy=I32, turn=I16), 3),
        ),
        5: Struct(
            nonce=U32,
            reason=Enum(
                ("Version", Struct(min=U8, current=U8)), ("Resolution", MM), ("Frame", U16), "NumberInUse", "TooManyRobots"
            ),
        ),
        6: REQUEST,
        7: Struct(),
        8: Struct(
            time=MOMENT,
            peers=List(Struct(robot=U16, pose=POSE, age=U8, half_length=U16, half_width=U16), 8),
        ),
        9: Struct(
            time=MOMENT,
            obstacles=List(
                Struct(
                    number=U16,
                    **{"class": Enum("Person", "Movable", "Fixed")},
                    x=MM,
                    y=MM,
                    velocity_x=I16,
                    velocity_y=I16,
                    radius=U16,
                ),
                12,
            ),
        ),
        10: Struct(number=U32, waypoints=List(Struct(x=MM, y=MM), 16)),
        11: Struct(number=U32, stop=BOOL),
        12: Struct(number=U16, action=Enum("List", ("Get", U16), ("Set", PARAMETER_VALUE))),
        13: Struct(tiles=List(Tuple(TILE_ID, STAMP), 8)),
        14: DIGESTS,
        15: Struct(time=MOMENT, interest=U32, first=U16, tiles=List(U8, 32)),
    },
}


def read_message(direction, kind, body):
    """The fields, and the bytes that follow them."""
    reader = Reader(body)
    fields = MESSAGES[direction][kind].read(reader)
    return fields, body[reader.at :]


def write_message(direction, kind, fields):
    return MESSAGES[direction][kind].write(fields)


# 3.1 The receiver's window


class Window:
    def __init__(self):
        self.next, self.later = 0, 0

    def arrive(self, sequence):
        ahead = (sequence - self.next) % 2048
        if ahead == 0:
            # Bit 0 now stands for `next` itself.
            self.next += 1
            while self.later & 1:
                self.next, self.later = self.next + 1, self.later >> 1
            self.next, self.later = self.next % 2048, self.later >> 1
            return "new"
        if ahead <= 32:
            seen = self.later >> ahead - 1 & 1
            self.later |= 1 << ahead - 1
            return "duplicate" if seen else "new"
        return "refused" if ahead < 1024 else "duplicate"


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
    out = b""
    for plane in (0, 1):
        for y in range(32):
            word = sum((cells[32 * y + x] >> plane & 1) << x for x in range(32))
            out += word.to_bytes(4, "little")
    return out


def tile_hash(cells):
    return zlib.crc32(to_planes(cells))


def base_check(cells, check):
    """The sum over the bases of an update, whose upper 16 bits end it (8.3)."""
    for (row,) in struct.iter_unpack("<I", to_planes(cells)):
        check = ((check << 5 | check >> 27) ^ row) * 0x9E3779B9 & 0xFFFFFFFF
    return check


def digest(tiles):
    total = 0
    for tile in tiles:
        total += zlib.crc32(
            tile["x"].to_bytes(2, "little", signed=True)
            + tile["y"].to_bytes(2, "little", signed=True)
            + tile["epoch"].to_bytes(4, "little")
            + tile["version"].to_bytes(4, "little")
            + tile["hash"].to_bytes(4, "little")
        )
    return total % 2**64


# 8.1 The range coder

EVEN = None


class Coder:
    """What decoder and encoder share: the split, the models, and numbers (8.2)."""

    def __init__(self, models):
        self.models, self.range = list(models), 0xFFFFFFFF

    def bit(self, model, bit=None):
        if model is EVEN:
            return self.decide(self.range >> 1, bit)
        p = self.models[model]
        bit = self.decide((self.range >> 12) * max(p >> 4, 1), bit)
        self.models[model] = p - (p >> 5) if bit else p + (65536 - p >> 5)
        return bit


class Decoder(Coder):
    def __init__(self, data, models):
        super().__init__(models)
        self.data, self.at, self.code = data, 0, 0
        for _ in range(4):
            self.pull()

    def pull(self):
        byte = self.data[self.at] if self.at < len(self.data) else 0
        self.at += 1
        self.code = (self.code << 8 | byte) & 0xFFFFFFFF

    def decide(self, split, _):
        bit = int(self.code >= split)
        if bit:
            self.code -= split
            self.range -= split
        else:
            self.range = split
        while self.range < 1 << 24:
            self.range <<= 8
            self.pull()
        return bit

    def plain(self, count):
        value = 0
        for _ in range(count):
            value = value << 1 | self.bit(EVEN)
        return value

    def golomb(self, order):
        count = 0
        while self.bit(EVEN):
            count += 1
            if count + order > 32:
                raise Refused("malformed")
        value = (1 << count + order) - (1 << order) + self.plain(count + order)
        if value >> 32:
            raise Refused("malformed")
        return value

    def signed(self, order):
        z = self.golomb(order)
        return z >> 1 ^ -(z & 1)


class Encoder(Coder):
    def __init__(self, models):
        super().__init__(models)
        self.low, self.cache, self.pending, self.out = 0, 0, 1, bytearray()

    def decide(self, split, bit):
        if bit:
            self.low += split
            self.range -= split
        else:
            self.range = split
        while self.range < 1 << 24:
            self.range <<= 8
            self.shift()
        return bit

    def shift(self):
        if self.low < 0xFF000000 or self.low >= 1 << 32:
            carry = self.low >> 32
            self.out.append(self.cache + carry & 0xFF)
            self.out += bytes([0xFF + carry & 0xFF]) * (self.pending - 1)
            self.pending, self.cache = 0, self.low >> 24 & 0xFF
        self.pending += 1
        self.low = (self.low & 0x00FFFFFF) << 8

    def plain(self, value, count):
        for shift in reversed(range(count)):
            self.bit(EVEN, value >> shift & 1)

    def golomb(self, value, order):
        count = ((value >> order) + 1).bit_length() - 1
        for _ in range(count):
            self.bit(EVEN, 1)
        self.bit(EVEN, 0)
        self.plain(value + (1 << order) - (1 << count + order), count + order)

    def signed(self, value, order):
        self.golomb((value << 1 ^ value >> 31) & 0xFFFFFFFF, order)

    def finish(self):
        high = self.low + self.range - 1
        ends = [high >> zeros << zeros for zeros in (24, 16, 8, 0)]
        self.low = next(end for end in ends if end >= self.low)
        for _ in range(5):
            self.shift()
        return bytes(self.out[1:]).rstrip(b"\0")


# 8.6 Contexts, with the priors as the specification prints them

MORE, SAME_EPOCH, HAS_BASE, FROM_START, TO_END = range(5)
ROW, KNOWN, OCCUPIED, MOVABLE, CHANGED, USUAL, SECOND = 5, 7, 61, 115, 116, 152, 155
SPEC = Path(__file__).resolve().parents[2] / "protocol" / "SPEC.md"
PRIORS = re.search(r"```priors\n(.*?)```", SPEC.read_text(encoding="utf-8"), re.S).group(1).split()
MODELS = [256 * int(prior) + 128 for prior in PRIORS]
OTHERS = {1: (2, 3, 0), 2: (1, 3, 0), 3: (1, 2, 0)}


def code_cells(coder, start, end, was, new):
    """8.5: writes the cells of `new`, or reads them if it is None. Returns the cells."""
    cells = list(was)

    def changed(x, y):
        return y >= start // 32 and x >= 0 and cells[32 * y + x] != was[32 * y + x]

    for y in range(start // 32, (end - 1) // 32 + 1):
        columns = range(max(start - 32 * y, 0), min(end - 32 * y, 32))
        south = any(changed(x, y - 1) for x in range(32))
        row = new and int(any(new[32 * y + x] != was[32 * y + x] for x in columns))
        if not coder.bit(ROW + south, row):
            continue
        for x in columns:
            at = 32 * y + x
            west = cells[at - 1] if x else 0
            south = cells[at - 32] if y else 0
            south_east = cells[at - 31] if y and x < 31 else 0
            east = was[at + 1] if x < 31 else 0
            old, now = was[at], new and new[at]
            if old == 0:
                kinds = [min(code, 2) for code in (west, south, south_east)]
                context = ((kinds[0] * 3 + kinds[1]) * 3 + kinds[2]) * 2 + (east != 0)
                code = coder.bit(KNOWN + context, new and int(now != 0))
                if code:
                    code += coder.bit(OCCUPIED + context, new and int(now >= 2))
                if code == 2:
                    code += coder.bit(MOVABLE, new and int(now == 3))
            else:
                occupied = min(sum(code >= 2 for code in (west, south, east)), 2)
                context = ((old - 1) * 3 + occupied) * 4 + changed(x - 1, y) + 2 * changed(x, y - 1)
                code = old
                if coder.bit(CHANGED + context, new and int(now != old)):
                    usual, second, third = OTHERS[old]
                    if coder.bit(USUAL + old - 1, new and int(now == usual)):
                        code = usual
                    else:
                        code = second if coder.bit(SECOND + old - 1, new and int(now == second)) else third
            cells[at] = code
    return cells


# 8.3 Updates


class Update:
    """Reads an update, a header at a time; the cells of each must be read before the next."""

    def __init__(self, coded):
        self.coder, self.before, self.count, self.check = Decoder(coded, MODELS), None, 0, None

    def header(self):
        coder = self.coder
        if self.before is None:
            x, y = coder.signed(3), coder.signed(3)
            epoch = None
        else:
            if not coder.bit(MORE):
                if self.check is not None and coder.plain(16) != self.check >> 16:
                    raise Refused("wrong base")
                if coder.at < len(coder.data):
                    raise Refused("malformed")
                return None
            if self.count == 32:
                raise Refused("too many tiles")
            x = self.before["x"] + coder.signed(0)
            y = self.before["y"] + coder.signed(0)
            if max(abs(2 * x + 1), abs(2 * y + 1)) > 65535:
                raise Refused("malformed")
            epoch = self.before["epoch"] if coder.bit(SAME_EPOCH) else None
        if max(abs(2 * x + 1), abs(2 * y + 1)) > 65535:
            raise Refused("malformed")
        epoch = coder.golomb(4) if epoch is None else epoch
        has_base = coder.bit(HAS_BASE)
        version = coder.golomb(3)
        base = version - 1 - coder.golomb(0) if has_base else None
        if version == 0 or has_base and base <= 0:
            raise Refused("malformed")
        from_start = coder.bit(FROM_START)
        start = 0 if from_start else coder.plain(10)
        end = 1024 if coder.bit(TO_END) else coder.plain(10)
        if start >= end or not from_start and start == 0:
            raise Refused("malformed")
        self.count += 1
        self.before = {
            "x": x, "y": y, "epoch": epoch, "version": version, "base": base, "start": start, "end": end,
        }  # fmt: skip
        return self.before

    def cells(self, header, was):
        if header["base"] is not None and header["start"] == 0:
            self.check = base_check(was, self.check or 0)
        return code_cells(self.coder, header["start"], header["end"], was, None)


def write_update(tiles):
    """The update of these headers, each with its cells `was` and `new`."""
    coder, before, check = Encoder(MODELS), None, None
    for header, was, new in tiles:
        if before is None:
            coder.signed(header["x"], 3)
            coder.signed(header["y"], 3)
            coder.golomb(header["epoch"], 4)
        else:
            coder.bit(MORE, 1)
            coder.signed(header["x"] - before["x"], 0)
            coder.signed(header["y"] - before["y"], 0)
            same = int(header["epoch"] == before["epoch"])
            coder.bit(SAME_EPOCH, same)
            if not same:
                coder.golomb(header["epoch"], 4)
        base = header["base"]
        coder.bit(HAS_BASE, int(base is not None))
        coder.golomb(header["version"], 3)
        if base is not None:
            coder.golomb(header["version"] - 1 - base, 0)
        coder.bit(FROM_START, int(header["start"] == 0))
        if header["start"]:
            coder.plain(header["start"], 10)
        coder.bit(TO_END, int(header["end"] == 1024))
        if header["end"] != 1024:
            coder.plain(header["end"], 10)
        if base is not None and header["start"] == 0:
            check = base_check(was, check or 0)
        code_cells(coder, header["start"], header["end"], was, new)
        before = header
    coder.bit(MORE, 0)
    if check is not None:
        coder.plain(check >> 16, 16)
    return coder.finish()


# 7.3 Replica


class Replica:
    def __init__(self):
        self.cells, self.epoch, self.version, self.next = list(UNKNOWN), 0, 0, 0

    def apply(self, update):
        header = update.header()
        stamp, held = (header["epoch"], header["version"]), (self.epoch, self.version)
        whole, start, end = header["base"] is None, header["start"], header["end"]
        if whole and start == 0:
            if stamp < held or (stamp == held and not self.next):
                cells = update.cells(header, UNKNOWN)
                if stamp < held or end == 1024 or cells[:end] == self.cells[:end]:
                    return "old"
                self.cells, self.next = cells[:end] + list(UNKNOWN)[end:], end
                return "partial"
            self.cells = list(UNKNOWN)
        elif whole and not self.next and stamp == held:
            part = update.cells(header, self.cells[:start] + list(UNKNOWN)[start:])
            self.cells[start:end] = part[start:end]
            return "complete"
        elif start == 0:
            if held != (header["epoch"], header["base"]) or self.next:
                return "base missing"
        elif held != stamp or self.next != start:
            return "base missing"
        cells = update.cells(header, self.cells)
        if start == 0 and not whole:
            # The end of an update of one tile tells whether the base was the right one.
            try:
                update.header()
            except Refused:
                return "wrong base"
        self.cells = cells
        self.epoch, self.version = stamp
        self.next = end % 1024
        return "partial" if self.next else "complete"
