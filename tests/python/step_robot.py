"""Drives the small robot in virtual time, for a test: a line of JSON in, a line of JSON out.

In: `{"now": microseconds, "bytes": [hex, ...]}`, or with "restart" (a boot nonce, which is also
the boot's number) a new robot, whose frames are sealed if there is a "key".
Out: `{"frames": [hex, ...], "due": microseconds}`. After `"report": true` also what it holds.
"""

import json
import sys

from ubimap_frames import SealedFrames
from ubimap_robot import Robot
from ubimap_wire import tile_hash


def report(robot):
    def told(layer):
        tiles = robot.tiles.tiles[layer].items()
        return [[*place, it.version, it.next, tile_hash(it.cells)] for place, it in sorted(tiles)]

    own = [
        [*place, it.epoch, it.version, it.is_acknowledged(), it.stored, tile_hash(it.sent)]
        for place, it in sorted(robot.own.items())
    ]
    return {
        "own": own, "fused": told("Fused"), "coverage": told("Coverage"), "counters": robot.counters,
        "odometry": [robot.room.x, robot.room.y], "parameters": robot.parameters,
        "fresh": len(robot.fresh), "stopped": robot.room.is_stopped,
        "ahead": robot.clock.ahead() if robot.clock.replies else None,
    }  # fmt: skip


def main():
    robot, storage = None, {}
    for line in sys.stdin:
        step = json.loads(line)
        now = step["now"]
        if "restart" in step:
            key = bytes.fromhex(step.get("key", ""))
            frames = SealedFrames(7, key, step["restart"]) if key else None
            robot = Robot(7, step["restart"], now, frames, storage)
        for data in step.get("bytes", []):
            robot.receive(bytes.fromhex(data), now)
        frames = []
        while (frame := robot.poll(now)) is not None:
            frames.append(frame.hex())
            assert len(frames) < 1_000, "the robot never stops sending"
        told = {"frames": frames, "due": robot.due}
        if step.get("report"):
            told.update(report(robot))
        print(json.dumps(told), flush=True)


if __name__ == "__main__":
    main()
