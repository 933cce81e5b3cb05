"""Simulated drives as another machine or another day would give them, on request: a test that hangs on a rounding shows.

`--scan-noise-mm A` moves every point of a simulated scan by a normal error of A mm along each axis; `--noise-seed K` draws
another such error and, when no A is given, other noise of every sensor on the same drive.
Drives that tests simulate in other processes, and rays that they trace themselves, stay as they are: a test that compares
one of these with one of this process is marked `unperturbed`, and left out.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

if TYPE_CHECKING:
    from lslam.simulation.scenarios import SimulatedDrive

SHIFT = 2**31  # keeps these seeds apart from the numbers of visits


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("simulated drives")
    group.addoption("--scan-noise-mm", type=float, default=0.0, help="move every simulated point by about as much")
    group.addoption("--noise-seed", type=int, default=0, help="other noise: of --scan-noise-mm, else of all sensors")


def pytest_configure(config: pytest.Config) -> None:
    """Drives change for the whole session: what tests share is made before any of them asks."""
    config.addinivalue_line("markers", "unperturbed: compares bytes with a drive of another process or with kept ones")
    noise_m, seed = config.getoption("scan_noise_mm") / 1000, config.getoption("noise_seed")
    if noise_m:
        move_points(noise_m, seed)
    elif seed:
        draw_other_noise(seed)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what says of itself that a perturbation breaks it."""
    if config.getoption("scan_noise_mm") or config.getoption("noise_seed"):
        for item in items:
            if item.get_closest_marker("unperturbed"):
                item.add_marker(pytest.mark.skip(reason="drives are perturbed"))


def move_points(noise_m: float, seed: int) -> None:
    """Let the points of every simulated scan be off by `noise_m`, m, the same in every process."""
    from lslam.simulation.scenarios import SimulatedDrive

    scan_of = SimulatedDrive.scan

    def scan(drive: SimulatedDrive, index: int) -> Any:
        exact = scan_of(drive, index)
        rng = np.random.default_rng([*drive._seeds, index, SHIFT + seed])
        off = rng.normal(0, noise_m, exact.points.shape)
        return replace(exact, points=(exact.points + off).astype(np.float32))

    SimulatedDrive.scan = scan  # type: ignore[method-assign]


def draw_other_noise(seed: int) -> None:
    """Let the noise of scans, IMU and GNSS be drawn anew in every drive; what moves in its town stays."""
    from lslam.simulation import scenarios

    drive, build, read = scenarios.SimulatedDrive, scenarios.SimulatedDrive.__init__, scenarios.read_sensors

    def init(self: SimulatedDrive, *given: Any, **named: Any) -> None:
        build(self, *given, **named)
        self._seeds = (*self._seeds, SHIFT + seed)

    def read_sensors(motion: Any, sensors: Any, carrier: str, end: float, seeds: tuple[int, ...], *more: Any) -> Any:
        return read(motion, sensors, carrier, end, (*seeds, SHIFT + seed), *more)

    drive.__init__, scenarios.read_sensors = init, read_sensors  # type: ignore[method-assign]


def with_other_noise(drive: SimulatedDrive, seed: int) -> SimulatedDrive:
    """The same drive, whose scans have other noise."""
    other = copy(drive)
    other._seeds = (*drive._seeds, SHIFT + seed)
    return other
