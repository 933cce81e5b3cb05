"""Open ground seen by sixteen beams, from rest: rings that move with the sensor must not bias its pose."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

import lslam
from lslam.core.config import load_config
from lslam.core.config.config import Config
from lslam.core.types.sequence import Sequence
from lslam.odometry import create_odometry
from lslam.odometry.frontend.register_scans import estimate
from lslam.registration import local_map
from lslam.simulation.scenarios import simulate
from lslam.studies.worker import ScanStore, SequenceCache

Floats = NDArray[np.float64]


def from_rest(
    scenario: str, seed: int, count: int, speed: float, settings: tuple[str, ...] = ()
) -> tuple[Sequence, Floats]:
    """A VLP-16 that stands a second, then drives off, every column from its own pose; the true positions (N, 3)."""
    simulated = simulate(
        scenario, seed=seed, lidar="vlp16", count=count, speed=speed, start_speed=0.0, static_start=1.0,
        motion_compensated=False, settings=settings,
    )  # fmt: skip
    assert simulated.ground_truth is not None
    # Each scan is traced once, however often the drive is registered.
    scans = SequenceCache(ScanStore(10**9)).get(simulated.name, lambda: simulated)
    return scans, simulated.ground_truth.poses[:, :3, 3]


def run(sequence: Sequence, method: str = "icp") -> Floats:
    results = estimate(sequence, create_odometry(Config.model_validate({"odometry": {"method": method}})))
    return np.stack([result.T_world_lidar[:3, 3] for result in results])


def worst(found: Floats, truth: Floats) -> float:
    """m; infinite for a run that was given up."""
    return float(np.linalg.norm(found - truth, axis=1).max()) if len(found) == len(truth) else np.inf


@pytest.fixture(scope="module")
def rings() -> tuple[Sequence, Floats]:
    """A motorway whose verge is rough by two centimetres: hardly anything but rings on the ground."""
    return from_rest("motorway", 205, 80, 5.0, ("world.unevenness=0.02",))


@pytest.fixture(scope="module")
def car_park() -> tuple[Sequence, Floats]:
    return from_rest("carpark", 1, 80, 5.0)


@pytest.mark.parametrize("method", ["icp", "loam"])
def test_rings_on_a_rough_motorway_do_not_bias_the_pose(rings: tuple[Sequence, Floats], method: str) -> None:
    sequence, truth = rings
    assert np.linalg.norm(truth[-1] - truth[0]) > 15
    assert worst(run(sequence, method), truth) < 0.25


@pytest.mark.parametrize("method", ["icp", "ndt"])
def test_rings_on_a_car_park_do_not_bias_the_pose(car_park: tuple[Sequence, Floats], method: str) -> None:
    sequence, truth = car_park
    assert np.linalg.norm(truth[-1] - truth[0]) > 10
    assert worst(run(sequence, method), truth) < 0.25


def test_without_the_breadth_gate_single_rings_bias_the_pose(
    car_park: tuple[Sequence, Floats], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Matched with all voxels, it never leaves the start or is given up: the breadth of a voxel is what tells."""
    monkeypatch.setattr(local_map, "LEAST_BREADTH", 0.0)
    sequence, truth = car_park
    assert worst(run(sequence), truth) > 10.0


@cache
def moving_at_once() -> Sequence:
    simulated = simulate("carpark", seed=1, lidar="vlp16", count=80, motion_compensated=True)
    return SequenceCache(ScanStore(10**9)).get(simulated.name, lambda: simulated)


def test_a_method_biased_by_rings_is_reported_as_lost() -> None:
    """It holds points to where a scan's rings were; pairs of scans tell by what lies metres wide, their rings aside."""
    drive = moving_at_once()
    assert drive.ground_truth is not None
    config = load_config(None, ["odometry.method=icp-point", "map.write=false", "loops.use=false"], {})
    record = lslam.run(drive, config).record
    behind = np.linalg.norm(record.trajectory.positions[-1] - drive.ground_truth.positions[-1])
    assert behind > 10.0
    assert np.mean([r.may_be_elsewhere for r in record.results]) > 0.5
