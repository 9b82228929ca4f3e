"""Checks the vectors in tests/vectors against the document and what was written from it, and says how
many agree. `--brief` ends at the first failure, without a word."""

import json
import random
import re
import sys
from pathlib import Path

import ubimap_seals as seals
import ubimap_spec as spec
import ubimap_wire as wire
from follow_session import equal, session
from ubimap_link import Knocking, Receiver, Sender
from ubimap_map import RobotTiles, ServerTiles
from ubimap_wire import Refused

VECTORS = Path(__file__).resolve().parents[1] / "vectors"
DIRECTIONS = wire.DIRECTIONS


def refused(action):
    try:
        found = action()
    except Refused as error:
        return str(error)
    raise AssertionError(f"not refused: {found!r}")


def unhex(case, field):
    return bytes.fromhex(case[field])


def varint(case):
    reader = wire.Reader(unhex(case, "bytes"))
    equal(reader.varint(case["bits"]), case["value"])
    equal(reader.left(), 0)
    equal(wire.write_varint(case["value"]), unhex(case, "bytes"))


def zigzag(case):
    integer = wire.Signed(case["bits"])
    equal(integer.read(wire.Reader(unhex(case, "bytes"))), case["value"])
    equal(integer.write(case["value"]), unhex(case, "bytes"))


def crc(case):
    equal(wire.crc32(unhex(case, "contents")), case["crc"])


def header(case):
    equal(wire.write_header(case["version"], case["kind"], case["sequence"]), unhex(case, "bytes"))


def seal(case):
    sealed = wire.seal(case["session"], DIRECTIONS[case["direction"]], unhex(case, "contents"))
    equal(sealed, unhex(case, "bytes"))


def capacity(case):
    equal(wire.capacity(case["frame"]), case["capacity"])


def traced(case):
    """Every decision of an update of one tile, and the cells that they mean."""
    update, steps = wire.read_update(unhex(case, "coded")), []
    decide = update.coder.bit

    def recorded(model, bit=0):
        p = None if model is None else update.coder.models[model]
        before = [model, p, update.coder.range, update.coder.code]
        steps.append(before + [decide(model, bit)])
        return steps[-1][-1]

    update.coder.bit = recorded
    before = wire.from_planes(unhex(case, "before"))
    equal(update.header(), case["header"])
    after = update.cells(before)
    equal(update.header(), None)
    for found, (_, *expected) in zip(steps, case["decisions"]):
        equal(found, expected)
    equal(len(steps), len(case["decisions"]))
    equal(wire.to_planes(after), unhex(case, "after"))
    equal(wire.tile_hash(after), case["hash"])
    firsts = [it[1] for it in case["decisions"] if it[0] in ("KNOWN", "CHANGED")]
    equal(firsts, [cell[-2] for cell in case["cells"]])
    for x, y, was, *_, code in case["cells"]:
        equal((before[32 * y + x], after[32 * y + x]), (was, code))


def step(case):
    stages = {
        "varint": varint, "zigzag": zigzag, "stuffing": stuffing, "header": header, "crc": crc,
        "seal": seal, "frame": frame, "payload": payload, "message": message, "capacity": capacity,
        "one tile": traced, "an update on a base": traced,
    }  # fmt: skip
    for inner in case["cases"]:
        stages[case["stage"]](inner)


def stuffing(case):
    stuffed = unhex(case, "bytes" if "bytes" in case else "wire")
    equal(wire.stuff(unhex(case, "contents")), stuffed)
    contents = unhex(case, "contents")
    equal(wire.unstuff(stuffed[:-1], len(contents)), contents)
    equal(refused(lambda: wire.unstuff(stuffed[:-1], len(contents) - 1)), "too long")


def frame(case):
    direction, session, payload = DIRECTIONS[case["direction"]], case["session"], unhex(case, "payload")
    parts = (case["version"], case["kind"], case["sequence"], payload)
    sent = unhex(case, "bytes" if "bytes" in case else "wire")
    equal(wire.read_frame(sent, direction, session), parts)
    equal(wire.write_frame(direction, session, *parts), sent)


def message(case):
    direction, kind = DIRECTIONS[case["direction"]], case["kind"]
    fields, rest = wire.read_message(direction, kind, unhex(case, "body"))
    equal(fields, case["fields"] or {})
    equal(rest, unhex(case, "rest") if "rest" in case else b"")
    equal(wire.write_message(direction, kind, fields) + rest, unhex(case, "body"))


def payload(case):
    messages = [(it["kind"], unhex(it, "body")) for it in case["messages"]]
    sent = unhex(case, "bytes" if "bytes" in case else "payload")
    equal(wire.read_payload(sent), messages)
    equal(wire.write_payload(messages), sent)


def tile(case):
    update, written = wire.read_update(unhex(case, "coded")), []
    for part in case["tiles"]:
        header = update.header()
        equal(header, {name: part[name] for name in header})
        was, after = (wire.from_planes(unhex(part, name)) for name in ("before", "after"))
        equal(update.cells(was), after)
        equal(wire.tile_hash(after), part["hash"])
        equal(wire.to_planes(after), unhex(part, "after"))
        written.append((header, was, after))
    equal(update.header(), None)
    equal(wire.write_update(written), unhex(case, "coded"))


def replica(case):
    held = wire.Replica()
    for step in case["steps"]:
        equal(held.take(wire.read_update(unhex(step, "coded"))), step["outcome"])
        equal((held.epoch, held.version), (step["epoch"], step["version"]))
        equal(wire.tile_hash(held.cells), step["hash"])


def row(case):
    """7.3: one row of the table."""
    held = wire.Replica()
    before, after = case["held"], case["after"]
    held.cells = wire.from_planes(unhex(before, "cells"))
    held.epoch, held.version, held.next = (before[name] for name in ("epoch", "version", "next"))
    equal(held.take(wire.read_update(unhex(case, "coded"))), case["outcome"])
    equal([held.epoch, held.version, held.next], [after[it] for it in ("epoch", "version", "next")])
    equal(wire.to_planes(held.cells), unhex(after, "cells"))
    equal(wire.tile_hash(held.cells), after["hash"])


def repair(case):
    """7.5: what a receiver of tiles and digests answers, and then holds."""
    direction = DIRECTIONS[case["direction"]]
    back = 1 - direction
    if direction == wire.TO_ROBOT:
        tiles = ServerTiles(3)
        tiles.begin(case["server_epoch"])
        tiles.follow(800, 800, 1_600)
    else:
        tiles = RobotTiles()
    for step in case["steps"]:
        [(kind, body)] = wire.read_payload(unhex(step, "message"))
        fields, rest = wire.read_message(direction, kind, body)
        layer = [] if direction == wire.TO_SERVER else [fields["layer"]]
        if kind == wire.NUMBERS[direction, "TileUpdate"]:
            tiles.update(*layer, rest)
        else:
            tiles.compare(*layer, fields["tiles"])
        request, answer = tiles.request(), None
        if request:
            number = wire.NUMBERS[back, "Request"]
            answer = wire.write_payload([(number, wire.write_message(back, number, request))]).hex()
        equal(answer, step["answer"])
        if direction == wire.TO_ROBOT:
            held = tiles.tiles["Fused"].get((0, 0), wire.Replica())
        else:
            held = tiles.tiles.get((0, 0, step["epoch"]), wire.Replica())
        equal((held.version, wire.tile_hash(held.cells)), (step["version"], step["hash"]))


def hellos(case):
    knocking, moments = Knocking(7), []
    while len(moments) < len(case["moments"]):
        moments.append(knocking.due)
        assert not knocking.poll(knocking.due - 1) and knocking.poll(knocking.due)
    equal(moments, case["moments"])


def acknowledgements(case):
    receiver, sent, datagrams = Receiver(), [], 0

    def until(end):
        nonlocal datagrams
        while receiver.due is not None and receiver.due < end:
            now = receiver.due
            ack = wire.write_message(wire.TO_SERVER, 0, receiver.ack())
            body = wire.write_payload([(0, ack)])
            frame = wire.write_frame(wire.TO_SERVER, case["session"], 1, wire.DATAGRAM, datagrams, body)
            sent.append([now, frame.hex()])
            datagrams += 1
            receiver.acknowledged(now)

    for at, sequence in case["arrivals"]:
        until(at)
        receiver.arrive(sequence, at)
    until(2**63)
    equal(sent, case["sent"])


def retransmissions(case):
    sender, events = Sender(), []
    steps = [event for event in case["events"] if event[1] != "again"]
    until = 2**63

    def wait(end):
        while sender.due is not None and sender.due < end and len(events) < len(case["events"]):
            now = sender.due
            assert sender.again(now - 1) is None
            events.append([now, "again", sender.again(now)[0]])

    for at, what, *rest in steps:
        wait(at)
        if what == "sends":
            events.append([at, what, sender.keep(b"", None, at)])
        else:
            sender.acknowledge({"next": rest[0], "later": rest[1]}, at)
            events.append([at, what, *rest])
    wait(until)
    equal(events, case["events"])


def acknowledged(case):
    equal(wire.acknowledges(case["next"], case["later"], case["sequence"]), case["arrived"])


def clock(case):
    kept = wire.Clock()
    for exchange, ahead in case["exchanges"]:
        kept.reply(*exchange)
        equal(kept.ahead(), ahead)


def longest(case):
    """The lengths in the tables of 5 and 6 are those of the layouts."""
    layout = wire.MESSAGES[DIRECTIONS[case["direction"]]][case["kind"]]
    equal(spec.MESSAGES[case["direction"], case["kind"]][0], case["name"])
    if case["bytes"] != "any":
        equal(layout.longest, int(case["bytes"]))


def tables():
    sections = {"to server": "## 5 ", "to robot": "## 6 "}
    for direction, start in sections.items():
        section = spec.TEXT.split(f"\n{start}")[1].split("\n## ")[0]
        for kind, name, length in re.findall(r"^\| (\d+) \| (\w+) \| .* \| (\w+) \|$", section, re.M):
            yield {"direction": direction, "kind": int(kind), "name": name, "bytes": length}


def digest(case):
    equal(wire.digest(case["tiles"]), case["digest"])


def coder(case):
    encoder = wire.Encoder(case["models"])
    decoder = wire.Decoder(unhex(case, "coded"), case["models"])
    for name, first, second in case["steps"]:
        getattr(encoder, name)(*((first, second) if name == "bit" else (second, first)))
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
    held, first = wire.Window(), case.get("first", 0)
    for sequence in range(first):
        equal(held.arrive(sequence), "new")
    for arrival in case["frames"]:
        _, _, sequence, _ = wire.read_frame(unhex(arrival, "wire"), wire.TO_SERVER, case["session"])
        equal(held.arrive(sequence), arrival["outcome"])
    equal((held.next, held.later), (case["next"], case["later"]))
    ack = wire.write_message(wire.TO_ROBOT, 0, {"next": held.next, "later": held.later})
    body = wire.write_payload([(0, ack)])
    sent = wire.write_frame(wire.TO_ROBOT, case["session"], 1, wire.DATAGRAM, first, body)
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
    update = wire.read_update(unhex(case, "coded"))

    def read():
        while header := update.header():
            update.cells(wire.UNKNOWN)

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
    update = wire.read_update(wire.write_update(tiles))
    for header, was, new in tiles:
        equal(update.header(), header)
        equal(update.cells(was), new)
    equal(update.header(), None)


def suites():
    def load(name):
        return json.loads((VECTORS / f"{name}.json").read_text(encoding="utf-8"))

    frames, handshake, coders, bad = (load(it) for it in ("frames", "handshake", "coder", "refused"))
    times = load("timing")
    yield step, [{"name": it["stage"], **it} for it in load("first_steps")]
    yield longest, list(tables())
    yield stuffing, frames["stuffing"]
    yield frame, frames["frames"]
    yield message, load("messages")
    yield payload, load("payloads")
    yield tile, load("tiles")
    yield replica, load("replica")
    yield row, load("rows")
    yield repair, load("repair")
    yield session, load("session")
    yield hellos, times["hellos"]
    yield acknowledgements, times["acknowledgements"]
    yield retransmissions, times["retransmissions"]
    yield acknowledged, times["acknowledged"]
    yield clock, times["clocks"]
    yield digest, load("digests")
    yield coder, coders["coder"]
    yield refused_update, coders["refused"]
    yield transcript, handshake["transcript"]
    yield answer, handshake["answers"]
    yield window, load("window")
    yield refused_frame, bad["frames"]
    yield refused_payload, bad["payloads"]
    yield refused_message, bad["messages"]
    sealed = load("seals")
    yield sealed_hello, sealed["hellos"]
    yield sealed_answer, sealed["answers"]
    yield sealed_frame, sealed["sessions"]
    yield sealed_arrivals, sealed["refused"]
    yield round_trip, [{"name": f"seed {seed}", "seed": seed} for seed in range(20)]


def opened(case):
    """The contents of a case's frame, and its key."""
    return wire.unstuff(unhex(case, "wire")[:-1], 1024), unhex(case, "key")


def sealed_hello(case):
    contents, key = opened(case)
    names = case["robot"], case["boot"], case["clock"]
    equal(seals.hello(key, *names, unhex(case, "payload")), contents)
    equal(seals.open_hello(key, contents), (*names, unhex(case, "payload")))
    equal(seals.open_hello(bytes(16), contents), None)


def sealed_answer(case):
    contents, key = opened(case)
    stamp, names = case["answers"], (case["robot"], case["salt"])
    equal(seals.answer(key, *names, stamp, unhex(case, "payload")), contents)
    equal(seals.open_answer(key, stamp, contents), (*names, unhex(case, "payload")))
    equal(seals.open_answer(key, [1, 2], contents), None)


def sealed_session(case):
    fields = (case[name] for name in ("robot", "boot", "clock", "salt", "session"))
    return seals.session_key(unhex(case, "key"), *fields), case["robot"], case["session"]


def sealed_frame(case):
    contents, _ = opened(case)
    session, direction = sealed_session(case), DIRECTIONS[case["direction"]]
    kind = {"reliable": 1, "datagram": 2}[case["kind"]]
    payload = unhex(case, "payload")
    frame = seals.frame(*session, direction, kind, case["sequence"], case["counter"], payload)
    equal(frame, contents)


def sealed_arrivals(case):
    opener = seals.Opener(*sealed_session(case), DIRECTIONS["to server"])
    for frame in case["frames"]:
        found, _ = opener.receive(wire.unstuff(unhex(frame, "wire")[:-1], 1024))
        equal((frame["name"], found), (frame["name"], frame["outcome"]))


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
                if "--brief" in sys.argv:
                    return True
                print(f"{check.__name__}, {case.get('name', case)}: {type(error).__name__}: {error}")
    print(f"{passed} passed, {failed} failed")
    return failed != 0


if __name__ == "__main__":
    sys.exit(main())
