"""A small robot: the whole robot side of the protocol, with the standard library alone.

    python3 ubimap_robot.py --serial PATH | --udp HOST:PORT | --tcp HOST:PORT | --stdio [--robot N]
                            [--key FILE --boot-file FILE]

It stands in a little room that it has drawn (`Room`), drives the paths that it gets, and lets a box
come and go, so that its tiles change. A real robot replaces `Room` by its sensors, wheels and map,
and keeps the rest. `Robot` has no clock and no port: bytes and the time go in, frames come out.
Numbers in comments are sections of protocol/SPEC.md.
"""

import math
import random
import sys

import ubimap_wire as wire
from ubimap_frames import OpenFrames
from ubimap_link import Knocking, Receiver, Sender, earliest
from ubimap_map import OwnTile, ServerTiles, tile_update
from ubimap_room import Room
from ubimap_wire import DATAGRAM, HANDSHAKE, RELIABLE, TO_ROBOT, TO_SERVER, Refused

SECOND = 1_000_000
FRAME = 250
RESOLUTION = 50
#: The side of the window of the server's tiles.
SIDE = 4
STARTED, PATH_DONE = 1, 11
POSTURES = ["unknown", "standing", "sitting", "lying"]
#: 6: number: (value at the start, lowest, highest). The others of the table it does not have.
PARAMETERS = {
    1: (0, -2_000, 2_000), 2: (0, -2_000, 2_000), 3: (0, -32_768, 65_535), 4: (35, 0, 10_000),
    5: (910, 0, 32_767), 6: (1_000, 0, 60_000), 7: (1_500, 0, 60_000), 8: (1, 0, 1 << 30),
    13: (1, 1, 1),
}  # fmt: skip
FIRST_EPOCH, STORED = 8, 13
#: 11, and the names of the errors that do not count as refused frames.
COUNTERS = ("bad", "refused", "replayed", "forged", "duplicate", "unknown", "malformed")
WHY = {
    "truncated": "bad", "too long": "bad", "seal": "bad", "replayed": "replayed", "forged": "forged",
}  # fmt: skip


class Robot:
    """The robot's side of the protocol. After every input, take frames from `poll` until it returns
    None, and come back at `due`. Times are in microseconds of the robot's own clock."""

    def __init__(self, number, boot_nonce, now=0, frames=None, storage=None):
        self.number, self.room, self.frame = number, Room(), FRAME
        self.frames = frames or OpenFrames()
        self.frames.attempt(now)
        self.knocking, self.session = Knocking(boot_nonce), 0
        self.sender, self.receiver, self.datagram = Sender(), Receiver(), 0
        self.server_epoch, self.stores, self.heard = None, False, now
        self.counters = dict.fromkeys(COUNTERS, 0)
        self.input = bytearray()
        # The map.
        self.tiles, self.own, self.first_epoch = ServerTiles(SIDE), {}, 1
        self.updates, self.drawn = 0, None
        # What waits to be sent.
        self.events, self.reports, self.digested, self.told = [STARTED], [], 0, 0
        # What is stored outlives the boot.
        self.parameters = {number: it[0] for number, it in PARAMETERS.items()} | (storage or {})
        self.storage, self.next_boot = storage, dict(self.parameters)
        if storage is None:
            del self.parameters[STORED]
        # Moments at which something is due.
        self.next = dict.fromkeys(("time", "state", "vector", "digests", "tiles", "step"), now)
        self.forget_server()

    def forget_server(self):
        """4.2: another life of the server."""
        self.clock, self.asked, self.nonce = wire.Clock(), None, -1
        self.fix, self.pose, self.stop, self.path = None, None, 0, 0
        self.peers, self.obstacles, self.fresh = (0, []), (0, []), {}
        self.room.waypoints, self.room.is_stopped = [], False

    # Input

    def receive(self, data, now):
        self.input += data
        while 0 in self.input:
            end = self.input.index(0)
            frame, self.input = bytes(self.input[: end + 1]), self.input[end + 1 :]
            if end:
                self.take_frame(frame, now)
        # Noise without a delimiter need not be kept.
        if len(self.input) > 2 * FRAME:
            del self.input[:-FRAME]

    def take_frame(self, frame, now):
        """2.6"""
        try:
            kind, sequence, payload = self.frames.read(frame, FRAME)
            outcome = self.receiver.arrive(sequence, now) if kind == RELIABLE else "new"
            if outcome == "refused":
                raise Refused("sequence")
        except Refused as error:
            self.counters[WHY.get(str(error), "refused")] += 1
            return
        if kind == HANDSHAKE:
            self.take_handshake(*wire.read_payload(payload)[0], now)
            return
        self.heard = now
        if outcome == "duplicate":
            self.counters["duplicate"] += 1
            return
        for message in wire.read_payload(payload):
            if message is None:
                self.counters["malformed"] += 1
                return
            self.take_message(*message, now)

    def take_handshake(self, kind, body, now):
        """4.2"""
        try:
            fields, _ = wire.read_message(TO_ROBOT, kind, body)
        except (Refused, KeyError):
            self.counters["malformed"] += 1
            return
        name = wire.NAMES[TO_ROBOT, kind]
        if name == "Reset":
            if self.session and now - self.heard > 300_000 and self.frames.is_meant(body):
                self.session = 0
                self.knocking.restart(now)
                self.frames.attempt(now)
        elif self.session or fields.get("nonce") != self.knocking.nonce:
            return
        elif name == "Refusal":
            self.knocking.refused(fields["reason"] == "NumberInUse", now)
        elif name == "Welcome" and fields["version"] == wire.VERSION:
            self.welcomed(fields, now)

    def welcomed(self, welcome, now):
        self.session, self.frame, self.heard = welcome["session"], welcome["frame"], now
        self.frames.begin(self.session)
        self.sender, self.receiver, self.datagram = Sender(), Receiver(), 0
        is_same = welcome["server_epoch"] == self.server_epoch
        self.server_epoch, self.stores = welcome["server_epoch"], welcome["stores"]
        if not is_same:
            self.forget_server()
        self.tiles.begin(self.server_epoch)
        self.told = 0
        self.events = [event if isinstance(event, int) else event[0] for event in self.events]
        # 7.2: a server that has lost its memory grants lower epochs than it once did.
        granted = welcome["first_epoch"]
        is_too_far = self.first_epoch > granted + 8_192
        self.first_epoch = granted if is_too_far else max(self.first_epoch, granted)
        for tile in self.own.values():
            moves = is_too_far or welcome["renumber"]
            if moves or not tile.version:
                tile.epoch = self.first_epoch
            if moves or not is_same:
                tile.forget()
                tile.stored = 0
            tile.interrupt()
        for what in ("time", "state", "tiles"):
            self.next[what] = now

    def take_message(self, kind, body, now):
        name = wire.NAMES.get((TO_ROBOT, kind))
        if name is None:
            self.counters["unknown"] += 1
            return
        try:
            fields, rest = wire.read_message(TO_ROBOT, kind, body)
            if name in ("Welcome", "Refusal", "Reset"):
                raise Refused("malformed")
            getattr(self, "take_" + name)(fields, rest, now)
        except Refused:
            self.counters["refused" if name == "Ack" else "malformed"] += 1

    def take_Ack(self, ack, _, now):
        for token in self.sender.acknowledge(ack, now):
            self.acknowledged(token)

    def take_TimeReply(self, reply, _, now):
        """9"""
        if self.asked is None or self.asked[0] != reply["nonce"]:
            return
        sent, self.asked = self.asked[1], None
        if now - sent <= 2 * SECOND:
            received = reply["received"]
            self.clock.reply(sent, received, received + reply["held_micros"], now)

    def take_TileUpdate(self, head, coded, now):
        self.tiles.update(head["layer"], coded)

    def take_PoseFix(self, fix, _, now):
        """The pose is that of the newest fix, and what odometry has added since."""
        if not self.clock.replies or self.fix and fix["time"] <= self.fix["time"]:
            return
        self.fix, self.pose = fix, (dict(fix["pose"]), self.room.odometry())

    def take_Request(self, request, _, now):
        """7.3: sent whole, with all that travelled in the same frames."""
        if request["layer"] != "Robot":
            return
        asked = {(it["x"], it["y"]) for it in request["tiles"]} or set(self.own)
        lasts = {self.own[it].last for it in asked if it in self.own} - {None}
        for place, tile in self.own.items():
            if place in asked or tile.last in lasts:
                tile.forget()
        self.next["tiles"] = now

    def take_Peers(self, peers, _, now):
        if peers["time"] > self.peers[0]:
            self.peers = peers["time"], peers["peers"]

    def take_Obstacles(self, obstacles, _, now):
        if obstacles["time"] > self.obstacles[0]:
            people = [it for it in obstacles["obstacles"] if it["class"] == "Person"]
            for place, person in enumerate(people):
                # 6: two bits each; an earlier server leaves them out.
                person["posture"] = POSTURES[obstacles.get("postures", 0) >> 2 * place & 3]
            self.obstacles = obstacles["time"], obstacles["obstacles"]

    def take_Path(self, path, _, now):
        if path["number"] > self.path:
            self.path = path["number"]
            self.room.waypoints = [self.in_odometry(it) for it in path["waypoints"]]

    def take_Stop(self, stop, _, now):
        if stop["number"] > self.stop:
            self.stop, self.room.is_stopped = stop["number"], stop["stop"]

    def take_Parameter(self, command, _, now):
        action, values, outcome = command["action"], [], "Done"
        if action == "List":
            named = list(self.parameters)
        else:
            ((what, told),) = action.items()
            number = told["parameter"] if what == "Set" else told
            named = [number] if number in self.parameters else []
            if not named:
                outcome = "Unknown"
            elif what == "Set" and not PARAMETERS[number][1] <= told["value"] <= PARAMETERS[number][2]:
                outcome = "OutOfRange"
            elif what == "Set" and number == STORED and self.is_driving() and not self.parameters[STORED]:
                outcome = "OutOfRange"
            elif what == "Set":
                self.set_parameter(number, told["value"])
        values = [{"parameter": it, "value": self.parameters[it]} for it in named]
        self.reports = [{"number": command["number"], "outcome": outcome, "values": values}]

    def is_driving(self):
        return bool(self.room.waypoints) and not self.room.is_stopped

    def set_parameter(self, number, value):
        if number == FIRST_EPOCH and value != self.parameters[number]:
            # All own tiles are given up; they are drawn again in an epoch of their own.
            self.first_epoch, self.own, self.drawn = max(value, self.first_epoch + 1), {}, None
        self.parameters[number] = value % 65_536 if number == 3 else value
        if self.storage is not None:
            stored = [it for it in PARAMETERS if it not in (FIRST_EPOCH, STORED)]
            if number == STORED:
                self.storage.update({it: self.parameters[it] for it in stored})
                self.next_boot.update(self.storage)
            self.parameters[STORED] = int(all(self.parameters[it] == self.next_boot[it] for it in stored))

    def take_Stored(self, stored, _, now):
        for place, stamp in stored["tiles"]:
            tile = self.own.get((place["x"], place["y"]))
            if tile and tile.epoch == stamp["epoch"]:
                tile.stored = max(tile.stored, stamp["version"])

    def take_Digests(self, digests, _, now):
        self.tiles.compare(digests["layer"], digests["tiles"])

    def take_Freshness(self, freshness, _, now):
        """7.6: which coverage tiles are confirmed, and by the server's clock as of when."""
        window = self.tiles.window
        if not self.clock.replies or not window or window["number"] != freshness["interest"]:
            return
        for index in range(8 * len(freshness["tiles"])):
            if freshness["tiles"][index // 8] >> index % 8 & 1:
                number = freshness["first"] + index
                place = window["from"]["x"] + number % SIDE, window["from"]["y"] + number // SIDE
                if place in self.tiles.tiles["Coverage"]:
                    self.fresh[place] = max(freshness["time"], self.fresh.get(place, 0))

    def acknowledged(self, token):
        what, which = token
        if what == "tiles":
            for tile in self.own.values():
                tile.acknowledged(which)
        elif what == "event":
            self.events.remove((which,))

    # The robot itself

    def server_time(self, now):
        return now + self.clock.ahead() if self.clock.replies else None

    def pose_now(self):
        """`base_link` in `map`, or None."""
        if self.pose is None:
            return None
        (at, then), odometry = self.pose, self.room.odometry()
        turn = (at["heading"] - then["heading"]) / 65_536 * math.tau
        dx, dy = odometry["x"] - then["x"], odometry["y"] - then["y"]
        return {
            "x": round(at["x"] + dx * math.cos(turn) - dy * math.sin(turn)),
            "y": round(at["y"] + dx * math.sin(turn) + dy * math.cos(turn)),
            "heading": (at["heading"] + odometry["heading"] - then["heading"]) % 65_536,
        }

    def in_odometry(self, point):
        """A point of `map` in `odom`."""
        at, then = self.pose or (self.room.odometry(), self.room.odometry())
        turn = (then["heading"] - at["heading"]) / 65_536 * math.tau
        dx, dy = point["x"] - at["x"], point["y"] - at["y"]
        x = then["x"] + dx * math.cos(turn) - dy * math.sin(turn)
        return x, then["y"] + dx * math.sin(turn) + dy * math.cos(turn)

    def step(self, now):
        """Drives, draws and looks around: every 100 ms."""
        if now < self.next["step"]:
            return
        self.next["step"] = now + SECOND // 10
        if self.room.drive(0.1) and PATH_DONE not in self.events:
            self.events.append(PATH_DONE)
        pose = self.pose_now()
        if pose:
            self.tiles.follow(pose["x"], pose["y"], 32 * RESOLUTION)
        if self.drawn != now // SECOND:
            self.drawn = now // SECOND
            for place in [(-1, -1), (0, -1), (-1, 0), (0, 0)]:
                cells = self.room.cells(*place, now)
                tile = self.own.setdefault(place, OwnTile(self.first_epoch))
                tile.cells = cells

    # Output

    @property
    def due(self):
        if not self.session:
            return self.knocking.due
        # Tiles wait for the server's time, and for room in the window.
        waits = not self.clock.replies or not self.sender.has_room()
        moments = [at for what, at in self.next.items() if what != "tiles" or not waits]
        return earliest(self.sender.due, self.receiver.due, *moments)

    def poll(self, now):
        """The next frame to send now, or None."""
        self.step(now)
        if not self.session:
            return self.hello() if self.knocking.poll(now) else None
        again = self.sender.again(now)
        if again:
            return self.frames.write(RELIABLE, *again)
        room = self.frames.capacity(self.frame)
        payload, owes = b"", self.receiver.due is not None
        if owes and (room >= 40 or self.receiver.due <= now):
            payload = message("Ack", self.receiver.ack())
        rest = room - len(payload) if room >= 40 or not payload else 0
        body, token = self.datagram_body(rest, now), None
        if not body and self.sender.has_room():
            body, token = self.reliable_body(rest, now)
        is_ack_due = owes and self.receiver.due <= now
        if not body and not is_ack_due:
            return None
        payload += body
        if owes and payload != body:
            self.receiver.acknowledged(now)
        if token:
            return self.frames.write(RELIABLE, self.sender.keep(payload, token, now), payload)
        self.datagram = (self.datagram + 1) % 2048
        return self.frames.write(DATAGRAM, (self.datagram - 1) % 2048, payload)

    def hello(self):
        hello = {
            "version": wire.VERSION, "min_version": wire.VERSION, "robot": self.number,
            "nonce": self.knocking.nonce, "frame": FRAME, "resolution": RESOLUTION,
            "fused_tiles": SIDE * SIDE,
        }  # fmt: skip
        return self.frames.hello(message("Hello", hello))

    def datagram_body(self, room, now):
        """What is replaced by its successor, as far as it fits."""
        body = b""
        if now >= self.next["time"]:
            self.next["time"] = now + (SECOND // 8 if self.clock.replies < 64 else 5 * SECOND)
            self.nonce = (self.nonce + 1) % 65_536
            request = message("TimeRequest", {"nonce": self.nonce})
            if len(request) <= room:
                self.asked = self.nonce, now
                body += request
        if now >= self.next["state"]:
            self.next["state"] = now + 2 * SECOND
            body += first_that_fits(room - len(body), self.states(now))
        if now >= self.next["vector"]:
            self.next["vector"] = now + 5 * SECOND
            body += first_that_fits(room - len(body), self.vectors(now))
        if now >= self.next["digests"]:
            self.next["digests"] = now + 10 * SECOND
            body += first_that_fits(room - len(body), self.digests())
        return body

    def states(self, now):
        time, pose, odometry = self.server_time(now), self.pose_now(), self.room.odometry()
        for pose, odometry in [(pose, odometry), (pose, None), (None, None)]:
            told = time if pose and time is not None else None
            yield "State", {"time": told, "pose": pose, "odometry": odometry, "cells_refused": 0}

    def vectors(self, now):
        time, pose = self.server_time(now), self.pose_now()
        if time is None or pose is None:
            return
        odometry = {"odometry": self.room.odometry()}
        for columns, also in [(16, odometry), (8, odometry), (4, odometry), (4, {})]:
            step = 16_384 // columns
            distances = [60] * columns  # 1.2 m all over the quarter ahead
            first = (-8_192 + step // 2) % 65_536
            yield "DistanceVector", {
                "time": time, "pose": pose, "first": first, "step": step, "distances": distances, **also,
            }  # fmt: skip

    def digests(self):
        """7.5: two tiles in turn."""
        known = [(place, tile) for place, tile in self.own.items() if tile.is_acknowledged()]
        turn = known[self.digested :] + known[: self.digested]
        self.digested = (self.digested + 2) % max(len(known), 1)
        for count in (2, 1):
            tiles = [tile.digest(*place) for place, tile in turn[:count]]
            if tiles:
                yield "Digests", {"layer": "Robot", "tiles": tiles}

    def reliable_body(self, room, now):
        """One message that must arrive, and the token that comes back when it has."""
        for event in self.events:
            if isinstance(event, int):
                fields = {"time": self.server_time(now), "severity": "Info", "code": event, "detail": ""}
                self.events[self.events.index(event)] = (event,)
                return message("Event", fields), ("event", event)
        if self.reports:
            report = self.reports.pop()
            while len(message("ParameterReport", report)) > room:
                report["values"].pop()
            return message("ParameterReport", report), ("report", None)
        window = self.tiles.window
        if window and window["number"] > self.told:
            self.told = window["number"]
            return message("Interest", window), ("interest", None)
        request = self.tiles.request()
        if request:
            if len(message("Request", request)) > room:
                request["tiles"] = []
            return message("Request", request), ("request", None)
        return self.tile_body(room, now)

    def tile_body(self, room, now):
        time = self.server_time(now)
        if now < self.next["tiles"] or time is None:
            return b"", None
        for place, tile in sorted(self.own.items()):
            if tile.is_due():
                frame = self.updates = self.updates + 1
                seconds = max(time, 0) // SECOND
                coded = tile.write(*place, room - 3 - len(tile_update("Robot", seconds, b"")), frame)
                if coded is None:
                    continue
                number = wire.NUMBERS[TO_SERVER, "TileUpdate"]
                update = tile_update("Robot", seconds, coded)
                return wire.write_payload([(number, update)]), ("tiles", frame)
        # Nothing is due: changes are gathered before they are sent.
        self.next["tiles"] = now + 1_000 * max(self.parameters[6], 100)
        return b"", None


def message(name, fields):
    number = wire.NUMBERS[TO_SERVER, name]
    return wire.write_payload([(number, wire.write_message(TO_SERVER, number, fields))])


def first_that_fits(room, candidates):
    for name, fields in candidates:
        body = message(name, fields)
        if len(body) <= room:
            return body
    return b""


def main(arguments):
    from ubimap_ports import clock, options, run

    port, number, frames = options(arguments, __doc__)
    # A robot without good dice takes its boot counter, which it keeps in its flash.
    run(Robot(number, random.SystemRandom().getrandbits(32), clock(), frames), port)


if __name__ == "__main__":
    main(sys.argv[1:])
