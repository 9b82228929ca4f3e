"""Compares `ubimap calibrate` with SciPy's least squares on the same landmarks.

Needs Python 3.11, SciPy and a release build:

    pip install scipy
    cargo build --release
    python tests/python/compare_calibration.py

Both get the labelled landmarks of tests/calibration, without floors, and the pose of the first
camera. SciPy minimises UbiSLAM's cost C, the sum of |T_ij p_i - p_j|^2, or its weighted form, from
poses that Horn's closed form gives along the graph; with the robust loss "soft_l1" where a fifth of
the labels is wrong. Times are CPU seconds on one thread, of ubimap those of the whole process.
"""

import argparse
import os
import resource
import subprocess
import tempfile
import time
import tomllib
from pathlib import Path

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).resolve().parents[2]
INSTANCES = ROOT / "tests" / "calibration"
NAMES = ["ring-8", "ring-8-wrong", "grid-16", "grid-16-wrong"]


def read(name):
    """Each camera's landmarks by label, and their noise: across the ray, and of the depth z."""
    cameras = tomllib.loads((INSTANCES / f"{name}.toml").read_text())["cameras"]
    seen = [{row[0]: np.array(row[1:]) for row in camera["landmarks"]} for camera in cameras]
    return [camera["name"] for camera in cameras], seen, [camera["noise"] for camera in cameras]


def poses(path):
    """The rotation and position of each camera by name, from a cameras.toml."""
    return {camera["name"]: pose(camera) for camera in tomllib.loads(path.read_text())["cameras"]}


def pose(camera):
    """Heading about z, then roll about the heading, then tilt about the image's x axis."""
    heading, tilt, roll = (np.radians(camera.get(f"{key}_deg", 0.0)) for key in ("heading", "tilt", "roll"))
    ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
    level = np.array([np.sin(heading), -np.cos(heading), 0.0])
    right = level * np.cos(roll) - np.array([0.0, 0.0, 1.0]) * np.sin(roll)
    up = np.array([0.0, 0.0, 1.0]) * np.cos(roll) + level * np.sin(roll)
    forward = ahead * np.cos(tilt) - up * np.sin(tilt)
    axes = np.column_stack([right, np.cross(forward, right), forward])
    return Rotation.from_matrix(axes), np.array(camera["position_m"])


def covariance(point, noise):
    ray = point / np.linalg.norm(point)
    lateral = noise["lateral_m"]
    along = (noise["depth_m"] + noise["depth_per_m"] * point[2] ** 2) / ray[2]
    return lateral**2 * np.eye(3) + np.outer(ray, ray) * (along**2 - lateral**2)


def horn(ours, theirs):
    """The rotation and translation that map `ours` onto `theirs`."""
    middle, other = ours.mean(axis=0), theirs.mean(axis=0)
    rotation = Rotation.align_vectors(theirs - other, ours - middle)[0]
    return rotation, other - rotation.apply(middle)


def start(seen, pairs, reference):
    """Poses along the pairs with the most landmarks."""
    found = {0: reference}
    while len(found) < len(seen):
        edges = [pair for pair in pairs if (pair[0] in found) != (pair[1] in found)]
        known, new = max(edges, key=lambda pair: len(pairs[pair]))
        if new in found:
            known, new = new, known
        labels = pairs[min(known, new), max(known, new)]
        ours = np.array([seen[new][label] for label in labels])
        theirs = np.array([seen[known][label] for label in labels])
        rotation, shift = horn(ours, theirs)
        of_known, at_known = found[known]
        found[new] = (of_known * rotation, of_known.apply(shift) + at_known)
    return [found[camera] for camera in range(len(seen))]


def by_scipy(seen, noises, reference, is_weighted, loss):
    """The poses by SciPy and its CPU time."""
    begun = time.process_time()
    pairs = {}
    for one in range(len(seen)):
        for other in range(one + 1, len(seen)):
            labels = sorted(seen[one].keys() & seen[other].keys())
            if len(labels) >= 3:
                pairs[one, other] = labels
    first = start(seen, pairs, reference)
    columns = [
        (one, other, seen[one][label], seen[other][label])
        for (one, other), labels in pairs.items()
        for label in labels
    ]
    one, other = (np.array([row[axis] for row in columns]) for axis in (0, 1))
    ours, theirs = (np.array([row[axis] for row in columns]) for axis in (2, 3))
    turns = Rotation.concatenate([rotation for rotation, _ in first])
    shifts = np.array([shift for _, shift in first])
    weights = np.repeat(np.eye(3)[None], len(columns), axis=0)
    if is_weighted:
        for row, (a, b, p, q) in enumerate(columns):
            total = np.zeros((3, 3))
            for camera, point in ((a, p), (b, q)):
                axes = turns[camera].as_matrix()
                total += axes @ covariance(point, noises[camera]) @ axes.T
            weights[row] = np.linalg.inv(np.linalg.cholesky(total))

    def placed(state):
        steps = np.vstack([np.zeros(6), state.reshape(-1, 6)])
        return Rotation.from_rotvec(steps[:, :3]) * turns, shifts + steps[:, 3:]

    def residuals(state):
        rotation, shift = placed(state)
        apart = rotation[one].apply(ours) + shift[one] - rotation[other].apply(theirs) - shift[other]
        return np.einsum("kij,kj->ki", weights, apart).ravel()

    scale = 1.0 if is_weighted else 0.01
    best = least_squares(residuals, np.zeros(6 * (len(seen) - 1)), loss=loss, f_scale=scale)
    rotation, shift = placed(best.x)
    return list(zip(rotation, shift)), time.process_time() - begun


def by_ubimap(program, name, names, is_weighted):
    """The poses by ubimap and its CPU time."""
    lines = (INSTANCES / f"{name}.toml").read_text().splitlines()
    with tempfile.TemporaryDirectory() as folder:
        observations, out = Path(folder) / "observations.toml", Path(folder) / "cameras.toml"
        observations.write_text("\n".join(line for line in lines if not line.startswith("floor")))
        command = [program, "calibrate", observations, "--cameras", INSTANCES / f"{name}-truth.toml"]
        command += ["--out", out] + ([] if is_weighted else ["--unweighted"])
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([str(it) for it in command], capture_output=True, check=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        found = poses(out)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return [found[name] for name in names], seconds


def errors(found, truth):
    """Median errors of the cameras except the first, in millimetres and degrees."""
    pairs = list(zip(found, truth))[1:]
    metres = [np.linalg.norm(at - there) for (_, at), (_, there) in pairs]
    degrees = [np.degrees((rotation * turn.inv()).magnitude()) for (rotation, _), (turn, _) in pairs]
    return 1000 * np.median(metres), np.median(degrees)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ubimap", default=ROOT / "target" / "release" / "ubimap")
    program = parser.parse_args().ubimap
    print("| instance | ubimap: median errors, CPU s | SciPy: median errors, CPU s | error, ratio | time, ratio |")
    print("|---|---|---|---|---|")
    for name in NAMES:
        names, seen, noises = read(name)
        truth = [poses(INSTANCES / f"{name}-truth.toml")[camera] for camera in names]
        loss = "soft_l1" if "wrong" in name else "linear"
        for is_weighted in (False, True):
            ours, our_s = by_ubimap(program, name, names, is_weighted)
            theirs, their_s = by_scipy(seen, noises, truth[0], is_weighted, loss)
            (mm, deg), (their_mm, their_deg) = errors(ours, truth), errors(theirs, truth)
            what = "weighted" if is_weighted else "C"
            print(
                f"| {name}, {what} | {mm:.1f} mm, {deg:.3f} degrees, {our_s:.2f} "
                f"| {their_mm:.1f} mm, {their_deg:.3f} degrees, {their_s:.2f} "
                f"| {mm / their_mm:.2f} | {our_s / their_s:.3f} |"
            )


main()
