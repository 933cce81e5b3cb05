"""ATE and RPE against evo: live where it is installed, and against numbers it gave once where it is not."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import make_golden
import numpy as np
import pytest

from lslam.core.config.outputs import EvalConfig
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.evaluate import evaluate
from lslam.evaluation.metric import Evaluation
from lslam.evaluation.relative import by_index, by_path, error_transforms
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.formats.trajectory_lines import write_tum

GOLDEN = json.loads(make_golden.GOLDEN.read_text())
CONFIG = EvalConfig(align=make_golden.ALIGNMENTS, delta=make_golden.DELTAS)


def trajectory(poses: np.ndarray) -> Trajectory:
    return Trajectory(np.arange(len(poses), dtype=np.int64) * 10**8, poses, frame="unknown")


def assert_agree(result: Evaluation, numbers: dict[str, Any]) -> None:
    """1e-9 of every statistic; `sse` of thousands of square degrees relative to its size."""
    for alignment, parts in numbers["ape"].items():
        for part, statistics in parts.items():
            for key, value in statistics.items():
                mine = getattr(getattr(result.ate[alignment], part), key)
                assert mine == pytest.approx(value, abs=1e-9, rel=1e-9 if key == "sse" else 0), (alignment, part, key)
    for error, (recipe, parts) in zip(result.rpe, numbers["rpe"].items(), strict=True):
        for part, statistics in parts.items():
            assert error.n_pairs == statistics["n"], recipe
            for key, value in statistics.items():
                mine = getattr(getattr(error, part), key)
                assert mine == pytest.approx(value, abs=1e-9, rel=1e-9 if key == "sse" else 0), (recipe, part, key)


def test_synthetic_equals_golden() -> None:
    estimate, truth = make_golden.synthetic()
    assert_agree(evaluate(trajectory(estimate), trajectory(truth), CONFIG), GOLDEN["synthetic"])


@pytest.mark.parametrize("name", make_golden.REAL)
def test_real_equals_golden(name: str, recordings: Callable[[str], Path]) -> None:
    root = recordings("kitti_poses") / "kitti_poses"
    estimate = read_trajectory(root / "estimates" / f"{name}.txt")
    truth = read_trajectory(root / "ground_truth" / f"{make_golden.REAL[name]}.txt")
    assert_agree(evaluate(estimate, truth, CONFIG), GOLDEN["real"][name])


def test_golden_is_what_evo_says_today() -> None:
    pytest.importorskip("evo")
    live = make_golden.evo_numbers(*make_golden.synthetic())
    for kind in ("ape", "rpe"):
        for recipe, parts in GOLDEN["synthetic"][kind].items():
            for part, statistics in parts.items():
                assert live[kind][recipe][part] == pytest.approx(statistics, abs=1e-9, rel=1e-9)


@pytest.mark.parametrize("name", ["simple_offline_04", "simple_offline_07"])
def test_real_equals_live_evo(name: str, recordings: Callable[[str], Path]) -> None:
    pytest.importorskip("evo")
    root = recordings("kitti_poses") / "kitti_poses"
    paths = (root / "estimates" / f"{name}.txt", root / "ground_truth" / f"{make_golden.REAL[name]}.txt")
    live = make_golden.evo_numbers(*(make_golden.load_kitti(path) for path in paths))
    assert_agree(evaluate(*(read_trajectory(path) for path in paths), CONFIG), live)


def test_evo_ape_reads_what_lslam_writes(tmp_path: Path) -> None:
    """`evo_ape tum` on two files of ours: TUM's grammar to the letter, poses and stamps as they are, and the same error."""
    estimate, truth = (replace(trajectory(poses[:200]), frame="lidar") for poses in make_golden.synthetic())
    begin = 1_700_000_000_123_456_789
    for name, poses in (("est", estimate), ("gt", truth)):
        shifted = replace(poses, stamps_ns=poses.stamps_ns + begin)
        write_tum(tmp_path / name, shifted, "lslam: T_world_lidar\nworld: LiDAR at the first scan")
        lines = (tmp_path / name).read_text(encoding="ascii").splitlines()
        rows = [line for line in lines if not line.startswith("#")]
        assert lines == [*lines[: len(lines) - len(rows)], *rows], "comments come first"
        assert len(rows) == 200
        assert all(re.fullmatch(r"\d+\.\d{9}(?: -?\d+\.\d+){7}", row) for row in rows)
    pytest.importorskip("evo")
    from evo.core.metrics import PoseRelation
    from evo.main_ape import ape
    from evo.tools.file_interface import read_tum_trajectory_file

    theirs, reference = (read_tum_trajectory_file(str(tmp_path / name)) for name in ("est", "gt"))
    np.testing.assert_allclose(theirs.poses_se3, estimate.poses, atol=2e-9)
    np.testing.assert_allclose(theirs.timestamps, (estimate.stamps_ns + begin) / 1e9, rtol=0, atol=3e-7)
    found = ape(reference, theirs, PoseRelation.translation_part, align=True)
    mine = evaluate(estimate, truth, CONFIG).ate["se3"].translation.rmse
    assert found.stats["rmse"] == pytest.approx(mine, abs=1e-8)


@pytest.mark.parametrize("relation", ["full_transformation", "rotation_part", "rotation_angle_rad", "point_distance"])
def test_other_relations_of_rpe(relation: str) -> None:
    """The error transforms themselves agree, so every number evo derives from them can be had."""
    pytest.importorskip("evo")
    from evo.core import metrics
    from evo.core.trajectory import PosePath3D

    estimate, truth = make_golden.synthetic(200)
    metric = metrics.RPE(metrics.PoseRelation[relation], 20.0, metrics.Unit.meters, all_pairs=True)
    metric.process_data((PosePath3D(poses_se3=list(truth)), PosePath3D(poses_se3=list(estimate))))
    pairs = by_path(estimate[:, :3, 3], 20.0, True)
    E = error_transforms(estimate, truth, pairs)
    i, j = pairs.T
    mine = {
        "full_transformation": np.linalg.norm(E - np.eye(4), axis=(1, 2)),
        "rotation_part": np.linalg.norm(E[:, :3, :3] - np.eye(3), axis=(1, 2)),
        "rotation_angle_rad": 2 * np.arcsin(np.linalg.norm(E[:, :3, :3] - np.eye(3), axis=(1, 2)) / np.sqrt(8)),
        "point_distance": np.abs(
            np.linalg.norm(truth[i, :3, 3] - truth[j, :3, 3], axis=1)
            - np.linalg.norm(estimate[i, :3, 3] - estimate[j, :3, 3], axis=1)
        ),
    }[relation]
    np.testing.assert_allclose(mine, metric.error, atol=1e-9)


@pytest.mark.parametrize("all_pairs", [True, False])
@pytest.mark.parametrize("step", [0.1, 0.5, 1.0, 1 / 3])
def test_pairs_of_an_even_drive_with_stops(all_pairs: bool, step: float) -> None:
    """Even steps and repeated positions make ties; each must be decided as evo decides it."""
    pytest.importorskip("evo")
    from evo.core import filters

    x = np.concatenate([np.arange(60) * step, np.full(7, 59 * step), 59 * step + np.arange(1, 80) * step])
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, :3, 3] = np.outer(x, [0.6, 0.48, 0.64])
    for delta in (1.0, 2.5, 10.0, 7 * step):
        theirs = filters.filter_pairs_by_path(list(poses), delta, 0.1 * delta, all_pairs)
        assert [tuple(p) for p in by_path(poses[:, :3, 3], delta, all_pairs).tolist()] == theirs
        scans = filters.filter_pairs_by_index(list(poses), 7, all_pairs)
        assert [tuple(p) for p in by_index(len(poses), 7, all_pairs).tolist()] == scans


def test_association_equals_evo() -> None:
    """Where evo's matches are one to one, ours are the same."""
    pytest.importorskip("evo")
    from evo.core import sync

    from lslam.evaluation.associate import nearest_one_to_one

    first = np.arange(0, 40, 0.1) + 0.004 * np.sin(np.arange(400))
    second = np.arange(3, 33, 0.2) + 0.007 * np.sin(3.3 * np.arange(150))
    short, long = sync.matching_time_indices(second, first, 0.01)
    j, i = nearest_one_to_one(np.rint(second * 1e9).astype(np.int64), np.rint(first * 1e9).astype(np.int64), 10_000_000)
    assert (j.tolist(), i.tolist()) == (short, long)
