"""Each mode on the map it is made for: exact, off as a whole, drawn house by house; under drift that wanders."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from wrong_maps import MODES, OFF, SHIFT, Found, on

from lslam.backend.keyframes.store import KeyframeStore
from lslam.core.types.scan_result import MotionCheck, ScanResult
from lslam.core.types.trajectory import Keyframe
from lslam.odometry.frontend.keyframing import Keyframing
from lslam.odometry.frontend.register_scans import estimate
from lslam.odometry.integrity.monitor import IntegrityMonitor
from lslam.pipeline import odometry_pass

# Half as many keyframes: what is common to the map shows as well; of single houses each needs all that saw it.
SPARSE = ("keyframes.distance=4",)


@pytest.fixture(scope="module", autouse=True)
def shared_odometry() -> Iterator[None]:
    """Runs of the same scans whose configurations differ in the section `osm` alone share the results of odometry."""
    held: dict[str, tuple[list[ScanResult], KeyframeStore, list[Keyframe], list[MotionCheck]]] = {}

    def once(*given: Any, keyframing: Keyframing, monitor: IntegrityMonitor, **more: Any) -> list[ScanResult]:
        sequence = given[0]
        scans = hash((sequence.stamps_ns.tobytes(), sequence.scan(0).points.tobytes()))
        key = f"{scans} {keyframing._config.model_dump_json(exclude={'osm'})}"
        if key not in held:
            results = estimate(*given, keyframing=keyframing, monitor=monitor, **more)
            keyframing.settle()
            held[key] = list(results), keyframing.store, list(keyframing.store.keyframes), list(monitor.checks)
            return results
        results, store, keyframes, checks = held[key]
        monitor.checks.extend(checks)
        for keyframe in keyframes:
            keyframing.store.add(keyframe, store.points(keyframe.number))
        keyframing.settle()
        for result in results:
            more["on_scan"](result)
        return list(results)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(odometry_pass, "estimate", once)
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
