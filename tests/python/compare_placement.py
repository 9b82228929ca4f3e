"""Compares `ubimap place` with HiGHS on UbiSLAM's integer programme, and checks its answers.

Needs Python 3.11, highspy and a release build:

    pip install highspy
    cargo build --release
    python tests/python/compare_placement.py

The programmes are built here from the paper's formulas; nothing is taken from ubimap but its
answers. Times are CPU seconds on one thread, of ubimap those of the whole process.
"""

import argparse
import json
import math
import resource
import subprocess
import time
import tomllib
from pathlib import Path

import highspy

ROOT = Path(__file__).resolve().parents[2]
INSTANCES = ROOT / "tests" / "placement"
CELL_M = 0.5
HEIGHT_M = 3.0
LEAST, MOST = 1, 3
TIME_LIMIT_S = 60.0

# Room, spacing of the candidates in metres, and the number of cameras where it is given.
ROWS = [
    ("room-10x8", 0.5, None),
    ("room-20x15", 0.5, None),
    ("room-40x30", 1.0, None),
    ("room-10x8", 0.5, 4),
    ("room-20x15", 0.5, 12),
]


def centres(length_m, step_m):
    return [(index + 0.5) * step_m for index in range(round(length_m / step_m))]


def extents():
    """Full extents of the rectangle on the floor: across the image and along it, in metres."""
    camera = tomllib.loads((INSTANCES / "camera-69x55.toml").read_text())
    fov = (camera["horizontal_fov_deg"], camera["vertical_fov_deg"])
    return tuple(2 * HEIGHT_M * math.tan(math.radians(it) / 2) for it in fov)


def covered(cells, x, y, heading_deg):
    """The cells whose centres a camera sees; its image's top is towards the heading."""
    width, depth = extents()
    along_x, along_y = (depth, width) if heading_deg % 180 == 0 else (width, depth)
    return [
        number
        for number, (cell_x, cell_y) in enumerate(cells)
        if abs(cell_x - x) <= along_x / 2 and abs(cell_y - y) <= along_y / 2
    ]


def programme(room, spacing_m):
    outline = tomllib.loads((INSTANCES / f"{room}.toml").read_text())["room"]["outline_m"]
    length, width = (max(corner[axis] for corner in outline) for axis in (0, 1))
    cells = [(x, y) for y in centres(width, CELL_M) for x in centres(length, CELL_M)]
    places = [(x, y) for y in centres(width, spacing_m) for x in centres(length, spacing_m)]
    covers = [covered(cells, x, y, heading) for x, y in places for heading in (0, 90)]
    return cells, covers


def by_highs(cells, covers, cameras):
    """The optimum, its bound and the CPU time of HiGHS."""
    model = highspy.Highs()
    for option, value in [("output_flag", False), ("threads", 1), ("time_limit", TIME_LIMIT_S)]:
        model.setOptionValue(option, value)
    start = time.process_time()
    chosen = [model.addBinary(obj=1.0 if cameras is None else 0.0) for _ in covers]
    seen_by = [[] for _ in cells]
    for candidate, row in enumerate(covers):
        for cell in row:
            seen_by[cell].append(chosen[candidate])
    for candidates in seen_by:
        overlap = model.qsum(candidates)
        model.addConstr(overlap <= MOST)
        if cameras is None:
            model.addConstr(overlap >= LEAST)
        else:
            is_covered = model.addBinary(obj=-1.0)
            model.addConstr(overlap - LEAST * is_covered >= 0)
    if cameras is not None:
        model.addConstr(model.qsum(chosen) <= cameras)
    model.run()
    info = model.getInfo()
    value, bound = info.objective_function_value, info.mip_dual_bound
    if cameras is None:
        return round(value), math.ceil(bound - 1e-6), time.process_time() - start
    return round(-value), math.floor(-bound + 1e-6), time.process_time() - start


def by_ubimap(program, room, spacing_m, cameras):
    """The report of ubimap and its CPU time."""
    command = [program, "place", INSTANCES / f"{room}.toml", "--model", "paper", "--json"]
    command += ["--camera", INSTANCES / "camera-69x55.toml", "--height", HEIGHT_M]
    command += ["--min-overlap", LEAST, "--max-overlap", MOST, "--spacing", spacing_m]
    command += ["--cell", CELL_M, "--time-limit", TIME_LIMIT_S]
    if cameras is not None:
        command += ["--cameras", cameras]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    output = subprocess.run([str(it) for it in command], capture_output=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return json.loads(output.stdout), after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def check(report, cells, candidates, cameras):
    """Counts for ourselves what ubimap's cameras see."""
    assert report["placement"]["candidates"] == candidates, "another number of candidates"
    overlap = [0] * len(cells)
    for camera in report["cameras"]:
        x, y, height = camera["position_m"]
        assert height == HEIGHT_M and camera["tilt_deg"] == 90.0
        for cell in covered(cells, x, y, camera["heading_deg"]):
            overlap[cell] += 1
    assert max(overlap) <= MOST, "a cell is seen too often"
    seen = sum(count >= LEAST for count in overlap)
    if cameras is None:
        assert seen == len(cells), "a cell is not covered"
        assert report["placement"]["value"] == len(report["cameras"]) - report["placement"]["added"]
    else:
        assert report["placement"]["value"] == seen and len(report["cameras"]) <= cameras


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ubimap", default=ROOT / "target" / "release" / "ubimap")
    program = parser.parse_args().ubimap
    print("| instance | cells x candidates | ubimap: value (bound), CPU s | HiGHS: value (bound), CPU s | time, ratio |")
    print("|---|---|---|---|---|")
    for room, spacing_m, cameras in ROWS:
        cells, covers = programme(room, spacing_m)
        report, ours_s = by_ubimap(program, room, spacing_m, cameras)
        check(report, cells, len(covers), cameras)
        value, bound, highs_s = by_highs(cells, covers, cameras)
        ours = report["placement"]
        what = "fewest cameras" if cameras is None else f"cells seen by {cameras} cameras"
        print(
            f"| {room}, {what} | {len(cells)} x {len(covers)} "
            f"| {ours['value']} ({ours['bound']}), {ours_s:.2f} "
            f"| {value} ({bound}), {highs_s:.2f} | {ours_s / highs_s:.2f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
