"""Towns that tests share are those that the simulator builds, to the last bit, and no others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from shared_towns import HELD, Towns, TracedScans

from lslam.core.types.scan import Scan
from lslam.simulation import built_scenario, scenarios
from lslam.simulation.scenarios import simulate
from lslam.simulation.scene_mesh import RayScene


def test_a_shared_town_is_the_one_that_is_built_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    shared = Towns()

    def scan(seed: int, count: int, *settings: str) -> bytes:
        return simulate("block", seed=seed, count=count, settings=settings).scan(1).points.tobytes()

    asked = [(0, 2), (1, 2), (0, 2, "layout.storeys=[1, 1]"), (0, 2, "world.relief=0.1"), (0, 3)]
    monkeypatch.setattr(built_scenario, "_city", shared._build)
    monkeypatch.setattr(scenarios, "RayScene", RayScene)
    anew = [scan(*words) for words in asked]
    monkeypatch.setattr(built_scenario, "_city", shared.city)
    monkeypatch.setattr(scenarios, "RayScene", shared.scene)
    assert [scan(*words) for words in asked] == anew
    assert len(set(anew)) == len(shared._held) == 4, "the length of a drive is none of the town's"
    assert HELD > 4
    held = simulate("block", seed=1, count=5)
    assert held.scene is simulate("block", seed=1, count=2, lidar="vlp16").scene
    assert held.city is not simulate("block", seed=0).city


def test_a_town_that_another_worker_built_is_read_from_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shared_towns.KEPT_S", -1.0)  # however coarse the clock

    def scan(towns: Towns) -> bytes:
        monkeypatch.setattr(built_scenario, "_city", towns.city)
        monkeypatch.setattr(scenarios, "RayScene", towns.scene)
        return simulate("block", count=2).scan(1).points.tobytes()

    first, second = Towns(tmp_path), Towns(tmp_path)
    built = scan(first)
    assert len(list(tmp_path.iterdir())) == 1

    def build_anew(*_: object) -> None:
        raise AssertionError("it lies in its file")

    monkeypatch.setattr(second, "_build", build_anew)
    assert scan(second) == built


def test_a_scan_that_is_kept_is_the_one_of_its_drive() -> None:
    asked: list[int] = []
    drives = [simulate("block", seed=seed, count=3, lidar="vlp16") for seed in (0, 1)]

    def trace(drive: scenarios.SimulatedDrive, index: int) -> Scan:
        asked.append(index)
        return Scan(np.full((1000, 3), 10 * drive.seed + index, np.float32), 0, index)

    scan = TracedScans(2 * 12_000).once(trace)
    for drive, index, times in ((0, 1, 1), (1, 1, 2), (0, 1, 2), (0, 2, 3), (0, 1, 3), (1, 1, 4)):
        assert scan(drives[drive], index).points[0, 0] == 10 * drive + index
        assert len(asked) == times, "two are kept, those used last"
