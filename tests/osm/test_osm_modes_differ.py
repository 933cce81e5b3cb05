"""Each mode on the map it is made for: exact, off as a whole, drawn house by house; under drift that wanders."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from shared_odometry import SharedOdometry
from wrong_maps import MODES, OFF, SHIFT, Found, on

from lslam.backend.keyframes.store import KeyframeStore
from lslam.core.arrays import Floats
from lslam.core.config import Config
from lslam.io.formats.osm_buildings import BuildingExtract
from lslam.osm import hold
from lslam.osm.location import MapLocations, locate
from lslam.pipeline import odometry_pass

# Half as many keyframes: what is common to the map shows as well; of single houses each needs all that saw it.
SPARSE = ("keyframes.distance=4",)


@pytest.fixture(scope="module", autouse=True)
def shared_steps(held_odometry: SharedOdometry) -> Iterator[None]:
    """Runs that differ in the mode alone have the same odometry, and match its keyframes with the map in the same way.

    Not so in mode `rigid` unless the start is held, as it is in all of these runs.
    """
    held: dict[tuple[str, bytes], MapLocations] = {}

    def once(
        extract: BuildingExtract, store: KeyframeStore, up: Floats | None, config: Config,
        placed: Floats | None, odometry: Floats | None = None, clocks: Any = None,
    ) -> MapLocations:  # fmt: skip
        assert up is None
        assert placed is None
        assert config.osm.hold_start
        poses = np.stack([k.T_world_lidar for k in store.keyframes]) if odometry is None else odometry
        key = config.model_dump_json(exclude={"osm": {"mode"}}), poses.tobytes()
        if key not in held:
            held[key] = locate(extract, store, up, config, placed, odometry, clocks)
        return held[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(odometry_pass, "estimate", held_odometry.estimate)
        patch.setattr(hold, "locate", once)
        yield


def median(found: Sequence[Found]) -> Found:
    """The median errors over several drifts, and the positions of the first."""
    errors = np.median([(one.trajectory, one.buildings) for one in found], axis=0)
    return Found(float(errors[0]), float(errors[1]), found[0].places)


def medians(found: dict[str, list[Found]]) -> dict[str, Found]:
    return {mode: median(runs) for mode, runs in found.items()}


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Found]:
    return medians(on(tmp_path_factory.mktemp("exact"), "exact", OFF, 1.0, more=SPARSE))


@pytest.fixture(scope="module")
def shifted(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Found]:
    return medians(on(tmp_path_factory.mktemp("shifted"), "shifted", drifts=(0, 1, 2), more=SPARSE))


@pytest.fixture(scope="module")
def houses(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Found]:
    return medians(on(tmp_path_factory.mktemp("houses"), "houses"))


def test_no_two_modes_give_the_same_trajectory(
    exact: dict[str, Found], shifted: dict[str, Found], houses: dict[str, Found]
) -> None:
    for found in (exact, shifted, houses):
        for one, other in combinations(MODES, 2):
            assert np.abs(found[one].places - found[other].places).max() > 1e-4, f"{one} and {other}"


def test_an_exact_map_outweighs_the_start(exact: dict[str, Found]) -> None:
    assert exact["prior"].trajectory < 0.2
    assert exact["prior"].buildings == 0.0
    for mode in ("rigid", "non-rigid", "two-level"):
        assert exact[mode].trajectory > 2 * exact["prior"].trajectory


def test_a_map_that_is_off_as_a_whole_moves_as_one(shifted: dict[str, Found]) -> None:
    # Under the true start, the prior gives up its walls or follows them: its buildings stay 1.8 m off.
    assert shifted["prior"].buildings == pytest.approx(np.hypot(*SHIFT), abs=0.01)
    assert shifted["rigid"].buildings < 0.3
    assert shifted["rigid"].buildings == min(found.buildings for found in shifted.values())
    assert shifted["rigid"].trajectory < min(0.3, shifted["prior"].trajectory)


def test_independent_errors_of_buildings_are_corrected_independently(houses: dict[str, Found]) -> None:
    for mode in ("non-rigid", "two-level"):
        assert houses[mode].buildings < 0.5 * min(houses["prior"].buildings, houses["rigid"].buildings)
        assert houses[mode].trajectory < min(houses["prior"].trajectory, houses["rigid"].trajectory)
