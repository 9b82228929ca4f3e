"""Tiles that travel (SPEC.md 7): the server's at a robot, a robot's at the server, and a robot's own."""

import copy

from ubimap_wire import (
    NUMBERS, TO_SERVER, UNKNOWN, Refused, Replica, read_update, tile_hash, write_message, write_update,
)  # fmt: skip

LAYERS = ("Fused", "Coverage")


def names_base(header):
    return header["base"] is not None and header["start"] == 0


def read_tiles(coded, held, keep):
    """Reads an update. `held` gives a copy of the replica that a header is meant for; `keep` is
    called with each header and what its replica has become.

    Returns None, or the header of the tile to request: the first whose base is missing, or one of
    those that build upon other cells. Raises `Refused` for what cannot be read. Tiles before such a
    tile count, unless their own bases are in doubt (8.3, wrong base).
    """
    update, changes, missing, error, doubted = read_update(coded), [], None, None, None
    while True:
        try:
            header = update.header()
        except Refused as refused:
            error = refused
            break
        if header is None:
            doubted = None
            break
        replica = held(header)
        if replica.apply(update, header) == "base missing":
            missing = header
            break
        doubted = doubted or (header if names_base(header) else None)
        changes.append((header, replica))
    if doubted:
        return doubted
    for header, replica in changes:
        keep(header, replica)
    if error:
        raise error
    return missing


class ServerTiles:
    """The server's tiles at a robot, within its window."""

    def __init__(self, side):
        self.side, self.epoch, self.window = side, None, None
        self.tiles = {layer: {} for layer in LAYERS}
        self.missing = {layer: [] for layer in LAYERS}

    def begin(self, server_epoch):
        """A session begins (4.2)."""
        if server_epoch != self.epoch:
            self.epoch = server_epoch
            self.tiles = {layer: {} for layer in LAYERS}
        self.missing = {layer: [] for layer in LAYERS}

    def follow(self, x, y, size):
        """Moves the window to this place in millimetres, with tiles of this size, if it has left
        the middle. Returns whether it did."""
        corner = [int((at - self.side * size / 2) // size) for at in (x, y)]
        if self.window and all(abs(self.window["from"][a] - at) <= 1 for a, at in zip("xy", corner)):
            return False
        number = self.window["number"] + 1 if self.window else 1
        first = dict(zip("xy", corner))
        last = {axis: at + self.side - 1 for axis, at in first.items()}
        self.window = {"number": number, "from": first, "to": last}
        for tiles in self.tiles.values():
            for place in [place for place in tiles if not self.contains(*place)]:
                del tiles[place]
        return True

    def contains(self, x, y):
        window = self.window
        return bool(window) and all(
            window["from"][axis] <= at <= window["to"][axis] for axis, at in (("x", x), ("y", y))
        )

    def update(self, layer, coded):
        if layer not in LAYERS:
            raise Refused("malformed")
        tiles = self.tiles[layer]

        def is_mine(header):
            return header["epoch"] == self.epoch and self.contains(header["x"], header["y"])

        def held(header):
            replica = tiles.get((header["x"], header["y"])) if is_mine(header) else None
            return copy.copy(replica) if replica else Replica()

        def keep(header, replica):
            if is_mine(header) and replica.version:
                tiles[header["x"], header["y"]] = replica

        missing = read_tiles(coded, held, keep)
        if missing:
            place = missing["x"], missing["y"]
            replica = tiles.get(place)
            stamp = missing["epoch"], missing["version"]
            if replica and missing["base"] is None and stamp < (replica.epoch, replica.version):
                del tiles[place]  # Of an earlier life of the server (7.3).
            self.ask(layer, place)

    def compare(self, layer, digests):
        """7.5"""
        if layer not in LAYERS:
            raise Refused("malformed")
        for digest in digests:
            place, stamp = (digest["id"]["x"], digest["id"]["y"]), digest["stamp"]
            if not self.contains(*place):
                continue
            held = self.tiles[layer].get(place) or Replica.of(self.epoch)
            said = stamp["epoch"], stamp["version"], digest["hash"]
            if said != (held.epoch, held.version, tile_hash(held.cells)):
                self.tiles[layer].pop(place, None)
                if stamp["version"]:
                    self.ask(layer, place)

    def ask(self, layer, place):
        if place not in self.missing[layer]:
            self.missing[layer].append(place)

    def request(self):
        """The fields of a Request, or None if nothing is missing."""
        for layer, places in self.missing.items():
            if places:
                self.missing[layer] = []
                # More than fit are all.
                tiles = places if len(places) <= 8 else []
                return {"layer": layer, "tiles": [{"x": x, "y": y} for x, y in tiles]}
        return None


class RobotTiles:
    """A robot's tiles at the server, as far as the vectors need it."""

    def __init__(self):
        self.tiles, self.missing = {}, []

    def is_closed(self, x, y, epoch):
        """Older than the two newest epochs of the tile (7.2)."""
        return sum(1 for it in self.tiles if it[:2] == (x, y) and it[2] > epoch) >= 2

    def update(self, coded):
        def held(header):
            place = header["x"], header["y"], header["epoch"]
            if self.is_closed(*place):
                return Replica()
            return copy.copy(self.tiles.get(place)) or Replica()

        def keep(header, replica):
            place = header["x"], header["y"], header["epoch"]
            if not self.is_closed(*place):
                self.tiles[place] = replica
                for older in [it for it in self.tiles if it[:2] == place[:2] and self.is_closed(*it)]:
                    del self.tiles[older]

        missing = read_tiles(coded, held, keep)
        if missing and not self.is_closed(missing["x"], missing["y"], missing["epoch"]):
            self.missing.append((missing["x"], missing["y"]))

    def compare(self, digests):
        for digest in digests:
            epoch, version = digest["stamp"]["epoch"], digest["stamp"]["version"]
            place = digest["id"]["x"], digest["id"]["y"]
            if self.is_closed(*place, epoch):
                continue
            held = self.tiles.get((*place, epoch)) or Replica()
            if held.version > version or held.version == version and tile_hash(held.cells) == digest["hash"]:
                continue
            if held.version == version:
                self.tiles[*place, epoch] = Replica()
            self.missing.append(place)

    def request(self):
        places, self.missing = self.missing, []
        tiles = [{"x": x, "y": y} for x, y in places]
        return {"layer": "Robot", "tiles": tiles} if tiles else None


class OwnTile:
    """A tile of a robot, and what the server holds of it (the second half of 7.3)."""

    def __init__(self, epoch, cells=UNKNOWN):
        self.epoch, self.cells, self.sent = epoch, list(cells), list(UNKNOWN)
        self.version, self.base, self.next, self.stored = 0, None, 0, 0
        #: The frame in flight, and the one that carried the last update.
        self.frame, self.last = None, None

    def in_flight(self):
        return self.frame is not None

    def is_acknowledged(self):
        return not self.in_flight() and self.next == 0 and self.base == self.version and self.version > 0

    def is_due(self):
        return not self.in_flight() and (self.next > 0 or self.base is None or self.cells != self.sent)

    def write(self, x, y, room, frame):
        """An update in at most `room` bytes, which travels in the frame with this token. None if not
        even one cell fits."""
        start = self.next
        version = self.version if start else self.version + 1
        was = self.sent if self.base else self.sent[:start] + UNKNOWN[start:]
        new = self.sent[:start] + self.cells[start:]
        header = {
            "x": x, "y": y, "epoch": self.epoch, "version": version, "base": self.base, "start": start,
        }  # fmt: skip

        def coded(end):
            return write_update([({**header, "end": end}, was, new)])

        # The longest part that fits, by halving.
        fits, misses = start, 1025
        while misses - fits > 1:
            end = 1024 if misses == 1025 else (fits + misses) // 2
            fits, misses = (end, misses) if len(coded(end)) <= room else (fits, end)
        if fits == start:
            return None
        self.sent = new[:fits] + self.sent[fits:]
        self.version, self.next, self.frame, self.last = version, fits % 1024, frame, frame
        return coded(fits)

    def acknowledged(self, frame):
        if self.frame == frame and frame is not None:
            self.frame = None
            if self.next == 0:
                self.base = self.version

    def forget(self):
        """The server does not hold it: it is sent whole."""
        self.base, self.next, self.frame = None, 0, None

    def interrupt(self):
        """The session has ended: what was under way is lost."""
        if self.in_flight() or self.next:
            self.forget()

    def digest(self, x, y):
        stamp = {"epoch": self.epoch, "version": self.version}
        return {"id": {"x": x, "y": y}, "stamp": stamp, "hash": tile_hash(self.sent)}


def tile_update(layer, seconds, coded):
    head = write_message(TO_SERVER, NUMBERS[TO_SERVER, "TileUpdate"], {"layer": layer, "seconds": seconds})
    return head + coded
