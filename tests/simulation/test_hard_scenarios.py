"""Worlds that separate methods: what they share with the clean ones, woods, and what ails an IMU in them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from lslam.simulation.built_scenario import build_scenario
from lslam.simulation.imu import IMUS, ImuFaults
from lslam.simulation.scenario_files import find_scenario, parse_scenario, scenario_names
from lslam.simulation.scenarios import simulate
from lslam.simulation.scene_mesh import Surface

SHARES_TOWNS = True

FLIGHTS = ("closed", "open", "climbing", "small-eight", "large-eight")
PAIRS = {name: f"{name}-hard" for name in ("urban", "residential", *FLIGHTS)}


@pytest.mark.parametrize("name", PAIRS)
def test_a_hard_scenario_goes_the_way_of_its_clean_one(name: str) -> None:
    plain, hard = find_scenario(name), find_scenario(PAIRS[name])
    ways = ("carrier", "lidar", "speed", "start_speed", "lateral", "path", "motion_compensated", "overlap")
    assert {key: getattr(plain, key) for key in ways} == {key: getattr(hard, key) for key in ways}
    assert plain.real_returns is None
    assert hard.real_returns is not None
    assert hard.layout.volumes
    assert hard.vibration.angle_deg > 0
    assert hard.imu.jitter_ms > 0
    assert hard.traffic.cars + hard.traffic.people > plain.traffic.cars + plain.traffic.people


def test_own_files_may_stand_on_a_hard_scenario() -> None:
    own = parse_scenario("own", {"base": "urban-hard", "returns": {"grass": 0.2}})
    hard = find_scenario("urban-hard")
    assert own.returns == hard.returns.model_copy(update={"grass": 0.2})
    assert own.model_copy(update={"name": hard.name, "returns": hard.returns}) == hard


def test_only_hard_worlds_and_woods_have_real_returns() -> None:
    asked = {name for name in scenario_names() if find_scenario(name).real_returns is not None}
    assert asked == {*PAIRS.values(), "park", "forest-road"}


@pytest.mark.parametrize("name", ["park", "forest-road"])
def test_in_woods_leaves_are_everywhere_but_on_the_way(name: str) -> None:
    scenario = find_scenario(name)
    place = build_scenario(scenario, 1, count=50)
    mesh, street = place.city.mesh, place.city.street
    assert street is not None
    leaves = np.isin(mesh.surfaces, (Surface.CROWN, Surface.HEDGE))
    assert leaves.sum() > 10_000
    trunks = mesh.vertices[np.unique(mesh.faces[mesh.surfaces == Surface.TRUNK])][:, :2]
    away = cKDTree(street.position(street.sample(0.25))).query(trunks)[0]
    assert away.min() > scenario.layout.band
    drive = simulate(name, seed=1, count=12)
    scan = drive.scan(6)
    assert len(scan) > 0.3 * drive.lidar.rays


def test_park_and_forest_road_run_from_end_to_end() -> None:
    for name in ("park", "forest-road"):
        drive = simulate(name, seed=0)
        assert len(drive) > 150
        assert len(drive.scan(len(drive) - 1)) > 0


def test_stamps_of_an_imu_jitter_and_its_readings_do_not() -> None:
    exact, late = (
        simulate("block", count=300, imu="ideal", settings=settings).imu for settings in ([], ["imu.jitter_ms=1.5"])
    )
    assert exact is not None
    assert late is not None
    np.testing.assert_array_equal(exact.accel, late.accel)
    off = (late.stamps_ns - exact.stamps_ns) * 1e-6
    assert off[0] == 0
    assert np.std(off) == pytest.approx(1.5, rel=0.05)
    assert (np.diff(late.stamps_ns) > 0).all()
    wild = simulate("block", count=300, imu="ideal", settings=["imu.jitter_ms=50"]).imu
    assert wild is not None
    assert (np.diff(wild.stamps_ns) > 0).all()


def test_an_imu_saturates_at_the_scenarios_limit() -> None:
    free = simulate("walk", count=60, imu="ideal").imu
    tight = simulate("walk", count=60, imu="ideal", settings=["imu.accel_limit=9.9", "imu.gyro_limit_deg=20"]).imu
    assert free is not None
    assert tight is not None
    assert np.abs(free.accel).max() > 9.9
    np.testing.assert_array_equal(tight.accel, np.clip(free.accel, -9.9, 9.9))
    limit = np.radians(20.0)
    assert np.abs(free.gyro).max() > limit
    np.testing.assert_array_equal(tight.gyro, np.clip(free.gyro, -limit, limit))
    narrow = replace(IMUS["icm20948"], accel=replace(IMUS["icm20948"].accel, limit=5.0))
    assert ImuFaults(accel_limit=9.9).of(narrow).accel.limit == 5.0
    assert ImuFaults().of(narrow) == narrow
