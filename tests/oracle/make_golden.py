"""Write golden_evo.json: what evo says about trajectories that a formula makes, and about real ones when they are given.

    python tests/oracle/make_golden.py [KITTI_POSES]

KITTI_POSES is the unpacked recording `kitti_poses`; without it its numbers are kept from the file as it is. Numbers only
are committed: evo is GPL, and the poses belong to their authors.
"""

from __future__ import annotations

import copy
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

GOLDEN = Path(__file__).with_name("golden_evo.json")
ALIGNMENTS = ("none", "origin", "se3", "sim3")
DELTAS = ("1scan/consecutive", "1scan/all", "7scan/consecutive", "7scan/all", "10m/consecutive", "10m/all", "55.5m/all")
REAL = {"simple_offline_00": "00", "simple_offline_04": "04", "simple_offline_07": "07", "orb_slam_00": "00"}


def rotation(v: np.ndarray) -> np.ndarray:
    """Rodrigues, written out here so that the input owes nothing to the code under test."""
    angle = float(np.linalg.norm(v))
    x, y, z = v / max(angle, 1e-300)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def synthetic(count: int = 400) -> tuple[np.ndarray, np.ndarray]:
    """Estimate and truth (N, 4, 4): an uneven drive of about 650 m with drift, noise and one stop. No random generator."""
    truth, estimate = np.tile(np.eye(4), (count, 1, 1)), np.tile(np.eye(4), (count, 1, 1))
    for k in range(1, count):
        speed = 0.0 if 200 <= k < 212 else 1.7 + 0.9 * np.sin(0.11 * k) + 0.3 * np.sin(1.7 * k)
        turn = np.array([0.004 * np.sin(0.31 * k), 0.006 * np.sin(0.23 * k), 0.03 * np.sin(0.037 * k) + 0.012])
        step, wrong = np.eye(4), np.eye(4)
        step[:3, :3], step[:3, 3] = rotation(turn), [speed, 0.02 * np.sin(k), 0.05 * np.sin(0.05 * k)]
        wrong[:3, :3] = rotation(0.0015 * np.sin(k * np.array([12.9898, 78.233, 37.719])) + [0, 2e-4, -3e-4])
        wrong[:3, 3] = 0.02 * np.sin(k * np.array([45.164, 94.673, 63.125])) + [4e-3 * speed, 0, 1e-3]
        truth[k], estimate[k] = truth[k - 1] @ step, estimate[k - 1] @ step @ wrong
    placed = np.eye(4)
    placed[:3, :3], placed[:3, 3] = rotation(np.array([0.1, -0.2, 2.5])), [120.5, -31.25, 7.75]
    return estimate, placed @ truth


def evo_numbers(estimate: np.ndarray, truth: np.ndarray) -> dict[str, Any]:
    """evo's statistics of APE under each alignment and RPE under each recipe."""
    from evo.core import metrics
    from evo.core.trajectory import PosePath3D

    relations = {
        "translation": metrics.PoseRelation.translation_part,
        "rotation_deg": metrics.PoseRelation.rotation_angle_deg,
    }
    ref = PosePath3D(poses_se3=list(truth))
    out: dict[str, Any] = {"ape": {}, "rpe": {}}
    for alignment in ALIGNMENTS:
        est = PosePath3D(poses_se3=copy.deepcopy(list(estimate)))
        if alignment == "origin":
            est.align_origin(ref)
        elif alignment != "none":
            est.align(ref, correct_scale=alignment == "sim3")
        out["ape"][alignment] = {}
        for name, relation in relations.items():
            metric = metrics.APE(relation)
            metric.process_data((ref, est))
            out["ape"][alignment][name] = _plain(metric)
    est = PosePath3D(poses_se3=list(estimate))
    for recipe in DELTAS:
        distance, rule = recipe.split("/")
        unit = metrics.Unit.frames if distance.endswith("scan") else metrics.Unit.meters
        out["rpe"][recipe] = {}
        for name, relation in relations.items():
            metric = metrics.RPE(
                relation, float(distance.removesuffix("scan").removesuffix("m")), unit, all_pairs=rule == "all"
            )
            metric.process_data((ref, est))
            out["rpe"][recipe][name] = _plain(metric)
    return out


def _plain(metric: Any) -> dict[str, float]:
    return {**{key: float(value) for key, value in metric.get_all_statistics().items()}, "n": len(metric.error)}


def load_kitti(path: Path) -> np.ndarray:
    """(N, 4, 4) poses as the file states them."""
    poses = np.tile(np.eye(4), (len(path.read_text().splitlines()), 1, 1))
    poses[:, :3, :] = np.loadtxt(path).reshape(-1, 3, 4)
    return poses


def main() -> None:
    from importlib.metadata import version

    golden = json.loads(GOLDEN.read_text()) if GOLDEN.exists() else {"real": {}}
    golden["evo"] = version("evo")
    golden["synthetic"] = evo_numbers(*synthetic())
    if len(sys.argv) > 1:
        root = Path(sys.argv[1])
        for name, sequence in REAL.items():
            pair = (root / "estimates" / f"{name}.txt", root / "ground_truth" / f"{sequence}.txt")
            golden["real"][name] = evo_numbers(*(load_kitti(path) for path in pair))
    GOLDEN.write_text(json.dumps(golden, indent=1) + "\n")
    print(f"{GOLDEN}: evo {golden['evo']}, {sorted(golden['real'])}")


if __name__ == "__main__":
    main()
