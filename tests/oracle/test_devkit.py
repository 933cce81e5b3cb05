"""KITTI drift against an independent implementation of the development kit's formula."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import devkit
import make_golden
import pytest

from lslam.evaluation.kitti_drift import kitti_drift
from lslam.io.formats.trajectory_files import read_trajectory


def test_synthetic_equals_the_formula() -> None:
    estimate, truth = make_golden.synthetic()
    translation, rotation, segments = devkit.drift(estimate.tolist(), truth.tolist())
    mine = kitti_drift(estimate, truth)
    assert mine.available
    assert mine.segments == segments
    assert mine.translation_percent == pytest.approx(translation, abs=1e-6)
    assert mine.rotation_deg_per_100m == pytest.approx(rotation, abs=1e-6)
    assert translation > 0.1


@pytest.mark.parametrize("name", make_golden.REAL)
def test_real_equals_the_formula(name: str, recordings: Callable[[str], Path]) -> None:
    root = recordings("kitti_poses") / "kitti_poses"
    estimate = read_trajectory(root / "estimates" / f"{name}.txt").poses
    truth = read_trajectory(root / "ground_truth" / f"{make_golden.REAL[name]}.txt").poses
    translation, rotation, segments = devkit.drift(estimate.tolist(), truth.tolist())
    mine = kitti_drift(estimate, truth)
    assert mine.segments == segments
    assert mine.translation_percent == pytest.approx(translation, abs=1e-6)
    assert mine.rotation_deg_per_100m == pytest.approx(rotation, abs=1e-6)


def test_a_number_of_the_kit_itself(recordings: Callable[[str], Path]) -> None:
    """A user's run of the compiled kit on this estimate gave 0.511501 % and 0.180865 deg/100 m (SiMpLE, issue 3).

    Close, not equal: which revision of the files that was is not known.
    """
    root = recordings("kitti_poses") / "kitti_poses"
    estimate = read_trajectory(root / "estimates/simple_offline_00.txt").poses
    truth = read_trajectory(root / "ground_truth/00.txt").poses
    drift = kitti_drift(estimate, truth)
    assert drift.translation_percent == pytest.approx(0.511501, abs=2e-4)
    assert drift.rotation_deg_per_100m == pytest.approx(0.180865, abs=1e-3)
