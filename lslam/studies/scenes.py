"""Scenarios as input of a study: what is simulated, when two simulations are the same, and where they lie."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from lslam.errors import OutputExistsError
from lslam.simulation.scenario_files import scenario_named
from lslam.version import __version__

if TYPE_CHECKING:
    from lslam.simulation.scenarios import SimulatedDrive


@dataclass(frozen=True)
class Scene:
    """A scenario as `lslam simulate` takes it; what is None stays as the scenario says.

    scans : of the recording; columns : firings per scan; speed : m/s; compensated : scans without motion in them
    """

    scenario: str
    scans: int | None = None
    lidar: str | None = None
    columns: int | None = None
    speed: float | None = None
    compensated: bool | None = None
    imu: str = "icm20948"
    settings: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """For tables and folders."""
        return Path(self.scenario).stem


def scene_digest(scene: Scene, seed: int) -> str:
    """Digest of all that decides the bytes of the recording, without making it.

    Raises UsageError, ConfigError or InputError for a scenario that is none.
    """
    scenario = scenario_named(scene.scenario, scene.settings)
    said = {
        "scenario": scenario.model_dump(mode="json"), "scene": {**asdict(scene), "scenario": ""}, "seed": seed,
        "lslam": __version__,
    }  # fmt: skip
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


def scene_folder(scene: Scene, seed: int, parent: Path) -> Path:
    """The sequence folder of the recording below `parent`, whether it is there or not."""
    plain = scene == Scene(scene.scenario, scene.scans) and not scene.scenario.endswith(".toml")
    mark = "" if plain else f"-{scene_digest(scene, seed)[:8]}"
    return parent / f"{scene.name}-{seed}{'' if scene.scans is None else f'-{scene.scans}'}{mark}" / "sequences" / "00"


def simulate_once(
    scene: Scene,
    seed: int,
    parent: Path,
    on_start: Callable[[str, int], None] = lambda stage, total: None,
    on_step: Callable[[], None] = lambda: None,
) -> Path:
    """The sequence folder of the scene simulated with `seed` below `parent`; made now unless it is there already.

    It holds what `lslam simulate` writes by default. An interrupted simulation goes on. Raises what `simulate` and `record`
    raise.
    """
    from lslam.simulation.record import record

    sequence = scene_folder(scene, seed, parent)
    folder = sequence.parents[1]
    if sequence.is_dir() and (folder / "poses" / "00.txt").is_file():
        return sequence
    drive = drive_of(scene, seed)
    on_start(f"simulating {scene.name}, seed {seed}", len(drive))
    try:
        record(drive, folder, on_scan=lambda _: on_step(), resume=True)
    except OutputExistsError:
        record(drive, folder, overwrite=True, on_scan=lambda _: on_step())
    return sequence


def drive_of(scene: Scene, seed: int) -> SimulatedDrive:
    """The drive with its scans still to be traced; raises what `simulate` raises."""
    from lslam.simulation.lidar_models import lidar_named
    from lslam.simulation.scenarios import simulate
    from lslam.simulation.sensors import GnssModel

    scenario = scenario_named(scene.scenario, scene.settings)
    lidar = lidar_named(scene.lidar or scenario.lidar)
    return simulate(
        scenario, seed=seed, count=scene.scans, speed=scene.speed, motion_compensated=scene.compensated, imu=scene.imu,
        gnss=GnssModel(), lidar=lidar if scene.columns is None else replace(lidar, columns=scene.columns),
    )  # fmt: skip
