"""Compares `ubimap replay` with two SLAMs of MRPT on the raw Intel log, and tells what costs F1.

Needs Python 3.11, NumPy, MRPT's programs, a release build, and the logs of ../shared/data or UBIMAP_DATA:

    apt install mrpt-apps
    pip install numpy
    cargo build --release
    python tests/python/compare_slam.py

All get the same scans and odometry. Poses are compared with the 174 reference poses of the log: RMS of
the position after the best rigid fit, and the errors of the motion from row to row (mean, median). Each
map is drawn here from the poses and the raw ranges up to 4 m, as submaps/drawing.rs does, after that
fit, and its occupied cells are compared with `ubimap replay`'s map of the corrected log, as `ubimap
compare` does, at 1, 2 and 3 cells of 5 cm. Bytes are those up per scan, framing included; time is CPU
seconds of the whole process. The last rows show what F1 better poses, or a poorer drawing, would give.

MRPT's settings are those of its samples icp-slam_demo_classic.ini and gridmapping_RBPF_ICPbased_intel.ini,
except insertion each 1 m instead of 2. It takes some 10 minutes; --work DIR keeps the results and reuses them.
"""

import argparse
import gzip
import json
import os
import re
import resource
import shutil
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("UBIMAP_DATA", ROOT.parent / "shared" / "data")).resolve()
RAW, CORRECTED = DATA / "intel_raw/intel_raw_2726.flaser.log.gz", DATA / "carmen_corrected/intel-corrected.log.gz"
BEAMS = np.radians(np.arange(180) - 90.0)
SIDE, CELLS, RANGE_M, LEAST_HITS = 0.05, 1600, 4.0, 0.4
COLUMNS = np.linspace(1, 178, 64).round().astype(int)

POINTS = """LOG_FREQUENCY=0\nSAVE_3D_SCENE=0\nSAVE_POSE_LOG=0\nrawlog_offset=0\nCAMERA_3DSCENE_FOLLOWS_ROBOT=0
occupancyGrid_count=0\ngasGrid_count=0\nlandmarksMap_count=0\nbeaconMap_count=0\npointsMap_count=1
likelihoodMapSelection=-1\n[MappingApplication_pointsMap_00_insertOpts]
minDistBetweenLaserPoints=0.05\nfuseWithExisting=0\nisPlanarMap=1
[MappingApplication_pointsMap_00_likelihoodOpts]\nmax_corr_distance=5.0\nsigma_dist=0.05"""
ICP_SLAM = f"""[ICP]\nICP_algorithm=icpClassic\nmaxIterations=80\nminAbsStep_trans=1e-6\nminAbsStep_rot=1e-6
thresholdDist=0.3\nthresholdAng_DEG=5\nALFA=0.8\nsmallestThresholdDist=0.05\nonlyClosestCorrespondences=true
onlyUniqueRobust=true\ncorresponding_points_decimation=5
[MappingApplication]\nlogOutput_dir=out\nSHOW_PROGRESS_3D_REAL_TIME=0\nSHOW_LASER_SCANS_3D=0
SHOW_PROGRESS_3D_REAL_TIME_DELAY_MS=0\nlocalizationLinDistance=0.2\nlocalizationAngDistance=5
insertionLinDistance=1.2\ninsertionAngDistance=45\nminICPgoodnessToAccept=0.4\nmatchAgainstTheGrid=0\n{POINTS}"""
RBPF_SLAM = f"""[MappingApplication]\nlogOutput_dir=out\nSAVE_MAP_IMAGES=0\nSHOW_PROGRESS_IN_WINDOW=0\nRANDOM_SEED=1
insertionLinDistance=1.0\ninsertionAngDistance_deg=30\nlocalizeLinDistance=0.2\nlocalizeAngDistance_deg=10
PF_algorithm=2\nadaptiveSampleSize=0\nresamplingMethod=0\nsampleSize=10\nBETA=0.5\npfOptimalProposal_mapSelection=3
ICPGlobalAlign_MinQuality=0.8\nICP_algorithm=1\nmaxIterations=60\nthresholdDist=1.0\nthresholdAng_DEG=5\nALFA=0.5
smallestThresholdDist=0.1\nonlyClosestCorrespondences=1\n{POINTS}"""


def flaser(path):
    """The ranges in metres and the laser's poses of a CARMEN log."""
    words = [line.split() for line in gzip.open(path, "rt") if line.startswith("FLASER")]
    table = np.array([[float(word) for word in line[2:185]] for line in words])
    return table[:, :180], table[:, 180:]


def after(one, other):
    """The pose `other`, known relative to `one`, in the frame of `one`'s coordinates."""
    cos, sin = np.cos(one[..., 2]), np.sin(one[..., 2])
    x, y, turn = np.moveaxis(other, -1, 0)
    return np.stack([one[..., 0] + cos * x - sin * y, one[..., 1] + sin * x + cos * y, one[..., 2] + turn], -1)


def inverse(pose):
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x, y, turn = np.moveaxis(pose, -1, 0)
    return np.stack([-cos * x - sin * y, sin * x - cos * y, -turn], -1)


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def fit(found, reference):
    """The motion that brings the positions closest to the reference's."""
    middle, goal = found[:, :2].mean(axis=0), reference[:, :2].mean(axis=0)
    a, b = found[:, :2] - middle, reference[:, :2] - goal
    turn = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    shift = goal - after(np.array([0.0, 0.0, turn]), np.append(middle, 0.0))[:2]
    return np.append(shift, turn)


def errors(found, reference):
    """RMS of the position after the fit; mean and median errors of the steps, in metres and degrees."""
    off = after(fit(found, reference), found) - reference
    steps = [after(inverse(poses[:-1]), poses[1:]) for poses in (found, reference)]
    metres = np.hypot(*(steps[0] - steps[1])[:, :2].T)
    degrees = np.degrees(np.abs(wrapped(steps[0][:, 2] - steps[1][:, 2])))
    rms = np.sqrt((off[:, :2] ** 2).sum(axis=1).mean())
    return rms, metres.mean(), np.median(metres), degrees.mean(), np.median(degrees)


def draw(ranges, poses, bearings=BEAMS):
    """The occupied cells, as [x, y]: those where enough of the rays that meet them end."""
    hits, crossings = np.zeros(CELLS**2, np.int32), np.zeros(CELLS**2, np.int32)
    steps = np.arange(int(RANGE_M * 2 / SIDE)) * SIDE / 2
    for scan, (x, y, heading) in zip(ranges, poses):
        is_known = (scan > 0) & (scan < 49.99)
        length, angle = scan[is_known, None], heading + bearings[is_known, None]

        def cell(distance):
            at = np.array([x + distance * np.cos(angle), y + distance * np.sin(angle)]) / SIDE
            column, row = np.clip(np.floor(at).astype(int) + CELLS // 2, 0, CELLS - 1)
            return column * CELLS + row

        ends = np.where(length <= RANGE_M, cell(length), -1)
        crossed = cell(steps)
        is_crossed = (np.arange(len(steps)) < (np.minimum(length, RANGE_M) * 2 / SIDE).astype(int)) & (crossed != ends)
        is_crossed[:, 1:] &= crossed[:, 1:] != crossed[:, :-1]
        np.add.at(crossings, crossed[is_crossed], 1)
        np.add.at(hits, ends[ends >= 0], 1)
    return ((hits > 0) & (hits >= LEAST_HITS * (hits + crossings))).reshape(CELLS, CELLS)


def read_map(folder):
    """The occupied cells of a map that ubimap wrote; its origin is a multiple of the cells' side."""
    head = re.match(rb"P5\s+(?:#.*\n)?(\d+)\s+(\d+)\s+255\s", (folder / "map.pgm").read_bytes())
    width, height = int(head[1]), int(head[2])
    image = np.frombuffer(head.string[head.end() :], np.uint8).reshape(height, width)
    origin = re.search(r"origin: \[(.*?), (.*?),", (folder / "map.yaml").read_text())
    x, y = (round(float(word) / SIDE) + CELLS // 2 for word in origin.groups())
    grid = np.zeros((CELLS, CELLS), bool)
    grid[x : x + width, y : y + height] = image[::-1].T < 90
    return grid


def share_matched(grid, motion, other, cells):
    """The share of the occupied cells that, moved, have one of `other` within a number of cells."""
    centres = (np.argwhere(grid) + 0.5 - CELLS // 2) * SIDE
    centres = after(motion, np.pad(centres, ((0, 0), (0, 1))))[:, :2] / SIDE + CELLS // 2 - 0.5
    base, is_matched = centres.round().astype(int), np.zeros(len(centres), bool)
    for step in np.ndindex(2 * cells + 3, 2 * cells + 3):
        at = np.clip(base + step - (cells + 1), 0, CELLS - 1)
        is_matched |= (((at - centres) ** 2).sum(axis=1) <= cells**2 + 1e-4) & other[at[:, 0], at[:, 1]]
    return is_matched.mean()


def f1(grid, reference, motion=np.zeros(3)):
    """F1 at 1, 2 and 3 cells, as text."""
    scores = []
    for cells in (1, 2, 3):
        precision = share_matched(grid, motion, reference, cells)
        recall = share_matched(reference, inverse(motion), grid, cells)
        scores.append(2 * precision * recall / (precision + recall))
    return ", ".join(f"{score:.3f}" for score in scores)


def run(folder, command):
    """Runs a program in a folder unless it has been run there; returns its CPU time."""
    done = folder / "seconds.txt"
    if not done.exists():
        folder.mkdir(parents=True, exist_ok=True)
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        with open(folder.with_suffix(".txt"), "w") as output:
            status = subprocess.run([str(it) for it in command], cwd=folder, stdout=output, stderr=output).returncode
        if status:
            sys.exit(f"{command[0]} failed with status {status}; its output is in {output.name} (keep it with --work)")
        now = resource.getrusage(resource.RUSAGE_CHILDREN)
        done.write_text(str(now.ru_utime + now.ru_stime - before.ru_utime - before.ru_stime))
    return float(done.read_text())


def rawlog(work, ranges, driven, increments):
    """Writes the log in MRPT's format as rbpf-slam needs it, each scan after its odometry; its path."""
    log, path = work / "intel.log", work / "intel.rawlog"
    with open(log, "w") as out:
        # MRPT centres 179 degrees on the laser's heading, half a degree to the right of the robot's.
        print(f"PARAM robot_front_laser_max 50\nPARAM laser_front_laser_resolution {179 / 180}", file=out)
        for scan, pose in zip(ranges, driven):
            print("FLASER 180", *scan, *(pose - [0, 0, np.radians(0.5)]), *pose, "0 intel 0", file=out)
    run(work / "carmen2rawlog", ["carmen2rawlog", "-q", "-w", "-i", log, "-o", work / "observations.rawlog"])
    stream = gzip.open(work / "observations.rawlog").read()
    odometry = rb"\x9fmrpt::obs::CObservationOdometry.*?ODOMETRY.{10}\x88"
    scans = [scan for scan in re.split(odometry, stream, flags=re.S) if scan]
    stamp = stream[stream.index(b"ODOMETRY") + 8 :][:8]

    def framed(name, version, body):
        return bytes([len(name) | 0x80]) + name.encode() + bytes([version]) + body + b"\x88"

    with gzip.open(path, "wb") as out:
        for index, scan in enumerate(scans):
            time = struct.pack("<Q", struct.unpack("<Q", stamp)[0] + index * 1_000_000)
            step = increments[index - 1] if index else np.zeros(3)
            pose = framed("mrpt::poses::CPose2D", 1, struct.pack("<3d", *step))
            # MRPT's default noise of odometry: first of its Gaussian model, then of Thrun's, unused.
            noise = struct.pack("<I6f", 0, 0.01, 0.0573, 0.01745, 0.05, 0.01, 0.0035)
            noise += struct.pack("<I6f", 300, 0.05, 0.0698, 0.01, 0.0057, 0.001, 0.00087)
            action = struct.pack("<I", 0) + pose + noise + struct.pack("<?ff?ii", 0, 0, 0, 0, 0, 0) + time
            action = framed("mrpt::obs::CActionRobotMovement2D", 6, action)
            out.write(framed("mrpt::obs::CActionCollection", 0, struct.pack("<I", 1) + action))
            scan = struct.pack("<I", 1) + scan.replace(stamp, time)
            out.write(framed("mrpt::obs::CSensoryFrame", 2, scan))
    return path


def since(poses, at, odometry, driven):
    """The pose of each scan: the last of `poses`, of the scans `at`, and the odometry since."""
    last = np.maximum(np.searchsorted(at, np.arange(len(driven)) + 0.5) - 1, 0)
    return after(poses[last], after(inverse(odometry[last]), driven))


def by_mrpt(work, program, settings, log, driven):
    """The poses of the scans by a program of MRPT, and its CPU time."""
    (work / f"{program}.ini").write_text(settings)
    folder = work / program
    seconds = run(folder, [program, work / f"{program}.ini", log])
    if program == "icp-slam":
        return np.loadtxt(folder / "out/log_estimated_path.txt")[:, 1:], seconds
    # The path of the best particle starts with the origin; an update is reported before its step ends.
    words = re.findall(r"New pose=|STEP", folder.with_suffix(".txt").read_text())
    at = np.cumsum([word == "STEP" for word in words])[[word != "STEP" for word in words]]
    path = np.loadtxt(folder / "out/most_likely_path.txt")[-len(at) :]
    return since(path, at, driven[at], driven), seconds


def by_ubimap(work, program, driven):
    """The poses of the scans, and bytes up per mapped scan: all, and those of the map alone; CPU time."""
    seconds, folder = run(work / "raw", [program, "replay", RAW, "--out", "out"]), work / "raw/out"
    rows = np.loadtxt(folder / "trajectory.csv", delimiter=",", skiprows=1)
    robot = json.loads((folder / "report.json").read_text())["robots"][0]
    sizes = [robot[key] / robot["mapped"] for key in ("bytes_up", "bytes_up_map")]
    return since(rows[:, 2:5], rows[:, 1], rows[:, 5:8], driven), sizes, seconds


def compare(work, ubimap):
    ranges, driven = flaser(RAW)
    increments = np.loadtxt(RAW.with_name("intel_ODO.txt"))
    table = np.loadtxt(RAW.with_name("intel_ref_pairs.csv"), delimiter=",", skiprows=1)
    rows, reference = table[:, 0].astype(int), table[:, 1:]
    run(work / "corrected", [ubimap, "replay", CORRECTED, "--out", "out"])
    goal = drawn_by_ubimap = read_map(work / "corrected/out")
    text = np.mean([len(line) for line in gzip.open(RAW, "rt") if line.startswith("FLASER")])
    raw = f"{2 * ranges.shape[1]} (2 a beam); as text {text:.0f}"

    def show(name, poses=None, score="", size="", seconds=""):
        parts = ["", ""]
        if poses is not None:
            rms, *steps = errors(poses[rows], reference)
            parts = [f"{rms:.3f} m", "{:.3f}, {:.3f} m; {:.2f}, {:.2f} degrees".format(*steps)]
        print("| " + " | ".join([name, *parts, score, size, seconds]) + " |", flush=True)

    def fitted(poses):
        return after(fit(poses[rows], reference), poses)

    print("| | position, RMS | row to row: mean, median | F1 at 1, 2, 3 cells | bytes per scan | CPU s |")
    print("|---|---|---|---|---|---|")
    show("odometry alone", driven)
    log = rawlog(work, ranges, driven, increments)
    for program, settings in (("icp-slam", ICP_SLAM), ("rbpf-slam", RBPF_SLAM)):
        poses, seconds = by_mrpt(work, program, settings, log, driven)
        show(f"MRPT {program}", poses, f1(draw(ranges, fitted(poses)), goal), raw, f"{seconds:.0f}")
    poses, sizes, seconds = by_ubimap(work, ubimap, driven)
    ours = fitted(poses)
    sizes = "{:.0f}, of which map {:.0f}".format(*sizes)
    show("ubimap, drawn as the others", poses, f1(draw(ranges, ours), goal), sizes, f"{seconds:.0f}")
    motion, map_drawn = fit(poses[rows], reference), read_map(work / "raw/out")
    whole_cells = np.append((motion[:2] / SIDE).round() * SIDE, 0.0)
    show("ubimap, its own map, moved by whole cells", score=f1(map_drawn, goal, whole_cells))
    show("ubimap, its own map, moved by the fit, off the grid", score=f1(map_drawn, goal, motion))

    affine = np.linalg.lstsq(np.pad(ours[rows, :2], ((0, 0), (0, 1)), constant_values=1), reference[:, :2])[0]
    scaled = np.column_stack([ours[:, :2] @ affine[:2] + affine[2], ours[:, 2]])
    name = f"ubimap's poses, x times {affine[0, 0]:.4f}, y times {affine[1, 1]:.4f}"
    show(name, scaled, f1(draw(ranges, scaled), goal))
    off = reference - ours[rows]
    off[:, 2] = wrapped(off[:, 2])
    pulled = ours + np.column_stack([np.interp(np.arange(len(ours)), rows, column) for column in off.T])
    show("ubimap's poses, pulled onto the reference's", score=f1(draw(ranges, pulled), goal))
    few = f1(draw(ranges[rows], ours[rows]), draw(ranges[rows], reference))
    show("only the 174 scans, ubimap's poses against the reference's", score=few)
    ranges, poses = flaser(CORRECTED)
    goal = draw(ranges, poses)
    show("corrected log, drawn here, against `ubimap replay`", score=f1(goal, drawn_by_ubimap))
    halves = [draw(ranges[first::2], poses[first::2]) for first in (0, 1)]
    show("corrected log: one half of the scans against the other", score=f1(*halves))
    coarse = np.where(ranges < 49.99, (ranges / 0.02).round() * 0.02, ranges)[:, COLUMNS]
    show("corrected log, 64 columns in steps of 2 cm, against all", score=f1(draw(coarse, poses, BEAMS[COLUMNS]), goal))
    for metres in (0.05, 0.07, 0.1):
        bent = poses.copy()
        bent[:, :2] += metres * np.sin(2 * np.pi / 20 * poses[:, 1::-1] + [1, 2])
        score = f1(draw(ranges, bent), goal)
        show(f"corrected log, bent by {100 * metres:.0f} cm RMS over 20 m, against itself", score=score)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ubimap", type=Path, default=ROOT / "target" / "release" / "ubimap")
    parser.add_argument("--work", type=Path, help="keep results here, and use those that are here")
    options = parser.parse_args()
    for path in (options.ubimap, RAW, CORRECTED):
        if not path.exists():
            sys.exit(f"{path} is missing (see --help)")
    for program in ("carmen2rawlog", "icp-slam", "rbpf-slam"):
        if not shutil.which(program):
            sys.exit(f"{program} is missing: apt install mrpt-apps")
    with tempfile.TemporaryDirectory() as folder:
        compare((options.work or Path(folder)).resolve(), options.ubimap.resolve())


main()
