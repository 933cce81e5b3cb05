"""A real drive between real buildings, on the map that people drew of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import lslam
from lslam.core.config import load_config
from lslam.core.geometry import geodesy, se2
from lslam.io.readers import open_sequence

# Where a point of the recording's world, whose axes are east and north, lies on the Earth (README of the recording).
PLACE, POINT = np.array([59.348268650, 18.073204280, 0.0]), np.array([64.3932532565158, 66.4832330946657, 38.514])


@pytest.mark.usefixtures("shared_odometry")
@pytest.mark.parametrize("wrong", [(2.5, -1.7, 10.0), (-2.0, 2.2, -10.0), (-0.4, 3.0, -10.0), (-2.5, -1.5, 0.0)])
def test_from_a_start_3_m_and_10_deg_off_it_ends_where_it_was(
    wrong: tuple[float, float, float], recordings: Callable[[str], Path]
) -> None:
    """The georeference itself is known to half a metre and one degree.

    A pose of the ground truth belongs to the end of its sweep, one of the run to the start, where the sweep before ended.
    """
    folder = recordings("mcd_kth_day_06") / "mcd_kth_day_06"
    # What a run finds out by itself: tests/pipeline/test_point_times.py.
    sequence = open_sequence(folder, point_times="columns")
    truth = sequence.ground_truth
    assert truth is not None
    real = truth.poses.copy()
    real[:, :3, 3] -= POINT
    origin = geodesy.from_local(real[:1, :3, 3] + [[wrong[0], wrong[1], 0.0]], PLACE)[0]
    heading = float((90 - np.degrees(se2.of_se3(real[0])[2]) + wrong[2] + 180) % 360 - 180)
    settings = [
        f"osm.extract={json.dumps(str(folder / 'kth.osm'))}", f"osm.origin={json.dumps(origin.tolist())}",
        f"osm.heading_deg={heading}", "loops.use=false",
    ]  # fmt: skip
    record = lslam.run(sequence, load_config(None, settings, {})).record
    assert record.osm is not None, record.problems
    assert record.georeference is not None
    found = record.trajectory.poses.copy()
    found[:, :3, 3] = geodesy.to_local(geodesy.from_local(found[:, :3, 3], record.georeference.origin), PLACE)
    np.testing.assert_array_equal(record.trajectory.stamps_ns, truth.stamps_ns)
    away = se2.of_se3(found[1:]) - se2.of_se3(real[:-1])
    assert np.linalg.norm(away[:, :2], axis=1).max() < 1.0
    assert np.abs(np.degrees(se2.wrap(away[:, 2]))).max() < 2.0
