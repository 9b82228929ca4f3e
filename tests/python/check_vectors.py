"""Checks the vectors in tests/vectors against ubimap_wire, and says how many agree."""

import json
import random
import sys
from pathlib import Path

import ubimap_wire as wire
from ubimap_wire import Refused

VECTORS = Path(__file__).resolve().parents[1] / "vectors"
DIRECTIONS = {"to server": wire.TO_SERVER, "to robot": wire.TO_ROBOT}


def equal(found, expected):
    if found != expected:
        raise AssertionError(f"{found!r} is not {expected!r}")


def refused(action):
    try:
        found = action()
    except Refused as error:
        return str(error)
    raise AssertionError(f"not refused: {found!r}")


def unhex(case, field):
    return bytes.fromhex(case[field])


def stuffing(case):
    equal(wire.stuff(unhex(case, "contents")), unhex(case, "wire"))
    equal(wire.unstuff(unhex(case, "wire")[:-1], 1024), unhex(case, "contents"))


def frame(case):
    direction, session, payload = DIRECTIONS[case["direction"]], case["session"], unhex(case, "payload")
    parts = (case["version"], case["kind"], case["sequence"], payload)
    equal(wire.read_frame(unhex(case, "wire"), direction, session), parts)
    equal(wire.write_frame(direction, session, *parts), unhex(case, "wire"))


def message(case):
    direction, kind = DIRECTIONS[case["direction"]], case["kind"]
    fields, rest = wire.read_message(direction, kind, unhex(case, "body"))
    equal(fields, case["fields"] or {})
    equal(rest, unhex(case, "rest"))
    equal(wire.write_message(direction, kind, fields) + rest, unhex(case, "body"))


def payload(case):
    messages = [(it["kind"], unhex(it, "body")) for it in case["messages"]]
    equal(wire.read_payload(unhex(case, "payload")), messages)
    equal(wire.write_payload(messages), unhex(case, "payload"))


def tile(case):
    update, written = wire.Update(unhex(case, "coded")), []
    for part in case["tiles"]:
        header = update.header()
        equal(header, {name: part[name] for name in header})
        was, after = (wire.from_planes(unhex(part, name)) for name in ("before", "after"))
        equal(update.cells(header, was), after)
        equal(wire.tile_hash(after), part["hash"])
        equal(wire.to_planes(after), unhex(part, "after"))
        written.append((header, was, after))
    equal(update.header(), None)
    equal(wire.write_update(written), unhex(case, "coded"))


def replica(case):
    held = wire.Replica()
    for step in case["steps"]:
        equal(held.apply(wire.Update(unhex(step, "coded"))), step["outcome"])
        equal((held.epoch, held.version), (step["epoch"], step["version"]))
        equal(wire.tile_hash(held.cells), step["hash"])


def digest(case):
    equal(wire.digest(case["tiles"]), case["digest"])


def coder(case):
    encoder = wire.Encoder(case["models"])
    decoder = wire.Decoder(unhex(case, "coded"), case["models"])
    for name, first, second in case["steps"]:
        getattr(encoder, name)(first, second)
        if name == "bit":
            equal(decoder.bit(first), second)
        else:
            equal(getattr(decoder, name)(second), first)
    equal(encoder.finish(), unhex(case, "coded"))


def transcript(case):
    direction, session = DIRECTIONS[case["direction"]], case["session"]
    version, kind, sequence, body = wire.read_frame(unhex(case, "wire"), direction, session)
    equal(session == 0, kind == wire.HANDSHAKE)
    messages = wire.read_payload(body)
    again = []
    for number, inner in messages:
        fields, rest = wire.read_message(direction, number, inner)
        again.append((number, wire.write_message(direction, number, fields) + rest))
    body = wire.write_payload(again)
    equal(wire.write_frame(direction, session, version, kind, sequence, body), unhex(case, "wire"))


def answer(case):
    hello, _ = wire.read_message(wire.TO_SERVER, 1, unhex(case, "hello"))
    terms = ("resolution", "frame", "server_epoch", "stores", "session", "first_epoch")
    kind, fields = wire.answer(hello, *(case[name] for name in terms))
    equal(kind, case["kind"])
    equal(wire.write_message(wire.TO_ROBOT, kind, fields), unhex(case, "body"))


def window(case):
    held = wire.Window()
    for arrival in case["frames"]:
        _, _, sequence, _ = wire.read_frame(unhex(arrival, "wire"), wire.TO_SERVER, case["session"])
        equal(held.arrive(sequence), arrival["outcome"])
    equal((held.next, held.later), (case["next"], case["later"]))
    ack = wire.write_message(wire.TO_ROBOT, 0, {"next": held.next, "later": held.later})
    body = wire.write_payload([(0, ack)])
    sent = wire.write_frame(wire.TO_ROBOT, case["session"], 1, wire.DATAGRAM, 0, body)
    equal(sent, unhex(case, "answer"))


def refused_frame(case):
    direction, held = DIRECTIONS[case["direction"]], wire.Window()

    def receive():
        parts = wire.read_frame(unhex(case, "wire"), direction, case["session"], limit=64)
        if parts[1] == wire.RELIABLE and held.arrive(parts[2]) == "refused":
            raise Refused("sequence")
        return parts

    equal(refused(receive), case["error"])


def refused_payload(case):
    messages = wire.read_payload(unhex(case, "payload"))
    equal(messages[-1], None)
    equal(len(messages) - 1, case["messages_before"])


def refused_message(case):
    direction, body = DIRECTIONS[case["direction"]], unhex(case, "body")
    equal(refused(lambda: wire.read_message(direction, case["kind"], body)), case["error"])


def refused_update(case):
    update = wire.Update(unhex(case, "coded"))

    def read():
        while header := update.header():
            update.cells(header, wire.UNKNOWN)

    equal(refused(read), case["error"])
    equal(update.count, case["tiles_before"])


def round_trip(case):
    """Tiles that no vector holds: what is written here is read here."""
    dice = random.Random(case["seed"])
    tiles = []
    for _ in range(dice.randint(1, 4)):
        was = [dice.choice([0, 0, 0, 1, 2, 3]) for _ in range(1024)]
        new = [dice.randrange(4) if dice.random() < 0.1 else code for code in was]
        version = dice.randint(2, 2**32 - 1)
        start, end = sorted(dice.sample(range(1025), 2))
        base = dice.choice([None, dice.randint(1, version - 1)])
        header = {
            "x": dice.randint(-32768, 32767), "y": dice.randint(-9, 9), "epoch": dice.randrange(2**32),
            "version": version, "base": base, "start": start, "end": end,
        }  # fmt: skip
        tiles.append((header, was, was[:start] + new[start:end] + was[end:]))
    update = wire.Update(wire.write_update(tiles))
    for header, was, new in tiles:
        equal(update.header(), header)
        equal(update.cells(header, was), new)
    equal(update.header(), None)


def suites():
    def load(name):
        return json.loads((VECTORS / f"{name}.json").read_text(encoding="utf-8"))

    frames, handshake, coders, bad = (load(it) for it in ("frames", "handshake", "coder", "refused"))
    yield stuffing, frames["stuffing"]
    yield frame, frames["frames"]
    yield message, load("messages")
    yield payload, load("payloads")
    yield tile, load("tiles")
    yield replica, load("replica")
    yield digest, load("digests")
    yield coder, coders["coder"]
    yield refused_update, coders["refused"]
    yield transcript, handshake["transcript"]
    yield answer, handshake["answers"]
    yield window, load("window")
    yield refused_frame, bad["frames"]
    yield refused_payload, bad["payloads"]
    yield refused_message, bad["messages"]
    yield round_trip, [{"name": f"seed {seed}", "seed": seed} for seed in range(20)]


def main():
    passed = failed = 0
    for check, cases in suites():
        assert cases, check.__name__
        for case in cases:
            try:
                check(case)
                passed += 1
            except Exception as error:  # A case that fails must not hide the others.
                failed += 1
                print(f"{check.__name__}, {case['name']}: {type(error).__name__}: {error}")
    print(f"{passed} passed, {failed} failed")
    return failed != 0


if __name__ == "__main__":
    sys.exit(main())
