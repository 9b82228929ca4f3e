"""Follows a recorded session from its bytes: `tests/vectors/session.json`."""

import ubimap_wire as wire
from ubimap_link import Receiver
from ubimap_map import RobotTiles, ServerTiles


def equal(found, expected):
    if found != expected:
        raise AssertionError(f"{found!r} is not {expected!r}")


class Listener:
    """Both ends of a recorded session: what arrives at each."""

    def __init__(self, case):
        self.case, self.session, self.frame_size = case, 0, 1_024
        self.windows = {direction: Receiver() for direction in wire.DIRECTIONS.values()}
        self.sent, self.asked, self.clock = {}, {}, wire.Clock()
        self.own, self.server = RobotTiles(), ServerTiles(4)
        self.server.begin(case["server_epoch"])
        self.kinds = set()

    def hear(self, at, direction, is_lost, raw):
        assert len(raw) <= self.frame_size
        version, kind, sequence, body = wire.read_frame(raw, direction, self.session)
        equal(version, 1)
        messages = wire.read_payload(body)
        if kind == wire.RELIABLE:
            # What is sent again is the same.
            equal(self.sent.setdefault((direction, sequence), body), body)
        for number, inner in messages:
            if number == wire.NUMBERS[wire.TO_SERVER, "TimeRequest"] and direction == wire.TO_SERVER:
                fields, _ = wire.read_message(direction, number, inner)
                self.asked = {fields["nonce"]: at + self.case["robot_ahead"]}
        if is_lost:
            return
        arrived = at + self.case["travel"]
        if kind == wire.RELIABLE and self.windows[direction].arrive(sequence, arrived) != "new":
            return
        for number, inner in messages:
            name = wire.NAMES[direction, number]
            fields, rest = wire.read_message(direction, number, inner)
            equal(wire.write_message(direction, number, fields) + rest, inner)
            self.kinds.add(name)
            self.take(direction, name, fields, rest, arrived)

    def take(self, direction, name, fields, rest, now):
        if name == "Welcome":
            self.session, self.frame_size = fields["session"], fields["frame"]
        elif name == "TimeReply" and fields["nonce"] in self.asked:
            t0, t1 = self.asked.pop(fields["nonce"]), fields["received"]
            self.clock.reply(t0, t1, t1 + fields["held_micros"], now + self.case["robot_ahead"])
            assert abs(self.clock.ahead() + self.case["robot_ahead"]) <= 1
        elif name == "Interest":
            self.server.window = fields
        elif name == "TileUpdate" and direction == wire.TO_SERVER:
            self.own.update(rest)
        elif name == "TileUpdate":
            self.server.update(fields["layer"], rest)


def session(case):
    """A recorded session, followed from its bytes alone."""
    listener = Listener(case)
    for at, direction, fate, raw in case["frames"]:
        listener.hear(at, wire.DIRECTIONS[direction], fate == "lost", bytes.fromhex(raw))
    assert len(listener.kinds) >= 15, listener.kinds
    assert not listener.own.missing and not any(listener.server.missing.values())
    held = {(x, y): tile for (x, y, _), tile in listener.own.tiles.items()}
    for tiles, said in (
        (held, case["own"]),
        (listener.server.tiles["Fused"], case["fused"]),
        (listener.server.tiles["Coverage"], case["coverage"]),
    ):
        assert said
        for tile in said:
            found = tiles[tile["x"], tile["y"]]
            equal((found.version, wire.tile_hash(found.cells)), (tile["version"], tile["hash"]))
