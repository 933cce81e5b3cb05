"""Scenarios as files: all are sound, the thesis' flights are what it flew, wrong keys are named."""

from __future__ import annotations

import numpy as np
import pytest

from lslam.core.errors import ConfigError, UsageError
from lslam.simulation.built_scenario import BuiltScenario, build_scenario
from lslam.simulation.scenario_files import Scenario, find_scenario, parse_scenario, scenario_names
from lslam.simulation.scenarios import simulate

SHARES_TOWNS = True

# Girolimetto, tables 4.2, 4.5, 4.7 and 4.9: length m, time s, speed m/s, frames.
FLIGHTS = {
    "closed": (812.25, 81.23, 10.0, 813),
    "open": (386.96, 38.70, 10.0, 387),
    "climbing": (274.81, 54.69, 5.0, 547),
    "small-eight": (292.82, 58.56, 5.0, 586),
    "large-eight": (566.88, 113.38, 5.0, 1134),
}


def built(name: str, *settings: str) -> tuple[Scenario, BuiltScenario]:
    """A place without its houses, which take time and are not asked about here."""
    bare = ("world.levels=0", "layout.garden_trees=0", "layout.parked=0", "layout.trees=0", *settings)
    scenario = find_scenario(name, bare)
    return scenario, build_scenario(scenario, 0)


@pytest.mark.parametrize("name", FLIGHTS)
def test_flights_are_as_long_and_as_fast_as_the_thesis_says(name: str) -> None:
    length, seconds, speed, frames = FLIGHTS[name]
    scenario, place = built(name, "path.swing=0")
    assert (scenario.lidar, scenario.carrier, scenario.rate_hz) == ("os1-32", "drone", 10.0)
    assert scenario.motion_compensated
    times = np.arange(place.scans) / scenario.rate_hz
    p = place.path.poses(times)[:, :3, 3]
    steps = np.linalg.norm(np.diff(p, axis=0), axis=1)
    assert steps.sum() == pytest.approx(length, rel=0.02)
    assert times[-1] == pytest.approx(seconds, rel=0.02)
    assert place.scans == pytest.approx(frames, rel=0.02)
    np.testing.assert_allclose(steps * scenario.rate_hz, speed, rtol=0.01)


def test_heights_of_the_flights() -> None:
    for name in FLIGHTS:
        scenario, place = built(name, "path.swing=0")
        z = place.path.poses(np.arange(place.scans) / 10.0)[:, 2, 3]
        assert z[0] == pytest.approx(10.0, abs=1e-6)
        if name != "climbing":
            np.testing.assert_allclose(z, 10.0, atol=1e-6)
            continue
        # 0.5 m/s up to about 37 m, round and round: nearly a helix.
        np.testing.assert_allclose(np.diff(z) * scenario.rate_hz, 0.5, atol=0.01)
        assert 36.5 < z[-1] < 38.0
        heading = np.unwrap(np.arctan2(*place.path.poses(np.arange(place.scans) / 10.0)[:, 1::-1, 0].T))
        assert np.ptp(heading) > 2 * np.pi * 1.5


def test_loops_close() -> None:
    for name in ("closed", "small-eight", "large-eight", "residential", "urban", "walk"):
        scenario, place = built(name, "path.swing=0", "traffic.cars=0", "traffic.people=0")
        p = place.path.poses(np.arange(place.scans) / scenario.rate_hz)[:, :3, 3]
        assert np.linalg.norm(p[len(p) // 2 :] - p[0], axis=1).min() < 0.6 * scenario.speed / scenario.rate_hz, name


def test_an_eight_passes_its_middle_street_twice() -> None:
    for name in ("small-eight", "large-eight"):
        _, place = built(name, "path.swing=0")
        xy = place.path.poses(np.arange(place.scans) / 10.0)[:, :2, 3]
        half = len(xy) // 2
        near = np.linalg.norm(xy[:half, None] - xy[None, half:], axis=2).min(axis=1)
        assert 10 < np.sum(near < 0.5) < 0.4 * half, name


def test_residential_is_as_long_as_kitti_07() -> None:
    scenario, place = built("residential")
    p = place.path.poses(np.arange(place.scans) / 10.0)[:, :3, 3]
    assert 680 < np.linalg.norm(np.diff(p, axis=0), axis=1).sum() < 740
    assert not scenario.motion_compensated
    assert "hdl64" in scenario.lidar


def test_every_scenario_says_what_it_is() -> None:
    names = scenario_names()
    drives = {"block", "street", "residential", "urban", "motorway", "corridor", "identical", "walk", "carpark"}
    assert {*FLIGHTS, *drives, "quadrotor", "stairs"} <= set(names)
    for name in names:
        scenario = find_scenario(name)
        assert scenario.name == name
        assert scenario.summary.endswith(".")
        flown = scenario.carrier == "drone" and scenario.world.kind == "town"
        assert scenario.motion_compensated == (flown or name in ("block", "street"))


def test_settings_change_one_thing() -> None:
    plain, changed = (
        find_scenario("urban"),
        find_scenario("urban", ["layout.parked=0.9", "lidar=vlp16", "layout.storeys=[1, 2]"]),
    )
    assert (changed.layout.parked, changed.lidar, changed.layout.storeys) == (0.9, "vlp16", (1, 2))
    assert changed.model_dump(exclude={"layout", "lidar"}) == plain.model_dump(exclude={"layout", "lidar"})
    assert changed.layout.road == plain.layout.road


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ("sped=5", "unknown key 'sped'; did you mean 'speed'"),
        ("world.reliev=1", "unknown key 'world.reliev'; did you mean 'relief'"),
        ("layout.stories=[1, 2]", "did you mean 'storeys'"),
        ("word.relief=1", "did you mean 'world'"),
        ("name=other", "unknown key 'name'"),
        ("world=3", "'world' is a section"),
        ("speed.cruise=3", "'speed' is a value"),
        ("speed", "expected key=value"),
        ("speed=400", "less than or equal to 40"),
        ("speed=fast", "valid number"),
        ("lidar=hdl46", "did you mean 'hdl64'"),
        ("path.shape=clsoed", "did you mean 'closed'"),
        ("layout.gap=[5, 1]", "layout.gap"),
        ("layout.storeys=[0, 2]", "layout.storeys"),
        ("world.glass=nan", "world.glass"),
        ("world.slope=[0.02, 0.01]", "world.slope"),
    ],
)
def test_wrong_settings_are_named(setting: str, sentence: str) -> None:
    with pytest.raises(ConfigError) as said:
        find_scenario("urban", [setting])
    assert sentence in str(said.value)
    assert "\n" not in str(said.value)


def test_unknown_keys_of_a_file_are_errors() -> None:
    with pytest.raises(ConfigError, match="unknown key 'sumary'; did you mean 'summary'"):
        parse_scenario("own", {"sumary": "x", "speed": 5.0, "start_speed": 5.0})
    with pytest.raises(ConfigError, match="summary: Field required"):
        parse_scenario("own", {"speed": 5.0, "start_speed": 5.0})
    with pytest.raises(UsageError, match="did you mean 'small-eight'"):
        find_scenario("smal-eight")


def test_impossible_bends_and_speeds_are_refused() -> None:
    with pytest.raises(UsageError, match=r"bends with a radius of .* 14 m/s needs .* more than the 6 allowed"):
        simulate("small-eight", speed=14.0)
    with pytest.raises(UsageError, match="a car needs 3 m"):
        simulate("residential", settings=["path.length=60", "path.smoothing=0.5"])
    with pytest.raises(UsageError, match="would not meet its start"):
        simulate("closed", settings=["path.heights=[10, 20]"])
    with pytest.raises(UsageError, match="ends after"):
        simulate("open", count=5000)
