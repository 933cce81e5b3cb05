"""Subjects of a study: recordings on disk, and scenarios that are simulated once per seed."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from lslam.core import __version__
from lslam.core.config import Config
from lslam.core.config.input import AS_CONFIGURED, InputConfig, ScanRange
from lslam.core.errors import InputError, OutputExistsError, UsageError, nearest
from lslam.core.printable import file_safe
from lslam.io.readers import find_folder, open_sequence
from lslam.simulation.scenario_files import find_scenario, scenario_names
from lslam.studies.runner import StudyProgress

if TYPE_CHECKING:
    from lslam.simulation.scenarios import SimulatedDrive


@dataclass(frozen=True)
class Scene:
    """Scenario with the options of `lslam simulate`; None keeps the scenario's own value.

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
    """Digest of all parameters that determine the bytes of the recording, without making it.

    Raises UsageError, ConfigError or InputError for a scenario that is none.
    """
    scenario = find_scenario(scene.scenario, scene.settings)
    content = {
        "scenario": scenario.model_dump(mode="json"),
        "scene": {**asdict(scene), "scenario": ""},
        "seed": seed,
        "lslam": __version__,
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def scene_folder(scene: Scene, seed: int, parent: Path) -> Path:
    """Sequence folder of the recording below `parent`, existing or not."""
    plain = scene == Scene(scene.scenario, scene.scans) and not scene.scenario.endswith(".toml")
    mark = "" if plain else f"-{scene_digest(scene, seed)[:8]}"
    return parent / f"{scene.name}-{seed}{'' if scene.scans is None else f'-{scene.scans}'}{mark}" / "sequences" / "00"


def simulate_once(scene: Scene, seed: int, parent: Path, progress: StudyProgress | None = None) -> Path:
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
    progress = progress or StudyProgress()
    progress.on_start(f"simulating {scene.name}, seed {seed}", len(drive), "scans", 1)
    try:
        record(drive, folder, on_scan=lambda _: progress.on_step(""), resume=True)
    except OutputExistsError:
        record(drive, folder, overwrite=True, on_scan=lambda _: progress.on_step(""))
    return sequence


def drive_of(scene: Scene, seed: int) -> SimulatedDrive:
    """Simulated drive whose scans are still to be made. Raises what `simulate` raises."""
    from lslam.simulation.lidar_models import find_lidar
    from lslam.simulation.scenarios import simulate
    from lslam.simulation.sensors import GnssModel

    scenario = find_scenario(scene.scenario, scene.settings)
    lidar = find_lidar(scene.lidar or scenario.lidar)
    return simulate(
        scenario,
        seed=seed,
        count=scene.scans,
        speed=scene.speed,
        motion_compensated=scene.compensated,
        imu=scene.imu,
        gnss=GnssModel(),
        lidar=lidar if scene.columns is None else replace(lidar, columns=scene.columns),
    )


log = logging.getLogger("lslam")


@dataclass(frozen=True)
class Subject:
    """A recording (`path`) or a scenario (`scenario`); `label` names it in tables and folders and is unique in a study.

    range : which of its scans are used, over the configuration
    """

    label: str
    path: Path | None = None
    scenario: str | None = None
    range: ScanRange = AS_CONFIGURED


def find_subjects(
    words: Iterable[str], data_root: Path | None = None, ranges: Mapping[str, ScanRange] | None = None
) -> list[Subject]:
    """Subjects by the user's words, in that order: paths and names of recordings, else names of scenarios.

    ranges : which scans are used, by word, over the configuration
    Raises UsageError for what is named twice, InputError for what is neither, or cannot be opened.
    """
    subjects: list[Subject] = []
    for word in words:
        subject = replace(_find(word, data_root), range=(ranges or {}).get(word, AS_CONFIGURED))
        if any((s.path, s.scenario) == (subject.path, subject.scenario) for s in subjects):
            raise UsageError(f"sequence {word!r} is named twice: a comparison needs it once")
        subjects.append(subject)
    names = unique_labels([s.label for s in subjects], [s.path for s in subjects])
    return [replace(subject, label=name) for subject, name in zip(subjects, names, strict=True)]


def _find(word: str, data_root: Path | None) -> Subject:
    """Recording or scenario called `word`; a recording precedes a scenario of the same name. Raises InputError for neither."""
    is_scenario = word in scenario_names()
    try:
        # Absolute, but links kept: `sequences/07` may be one, and its poses lie beside the link.
        path = Path(os.path.abspath(find_folder(word, data_root)))
    except InputError as error:
        if is_scenario:
            return Subject(word, scenario=word)
        raise InputError(f"{error}; no scenario either, {nearest(word, scenario_names())}") from None
    if is_scenario:
        log.warning(
            "%s is a recording in %s and also a scenario: the recording is taken; rename it for the scenario",
            word,
            path,
        )
    return Subject(file_safe(open_sequence(path).name), path=path)


def unique_labels(labels: Sequence[str], paths: Sequence[Path | None]) -> list[str]:
    """One distinct label per path of a recording; None for a simulation.

    Equal names are distinguished by the part of their paths in which all differ, or by a number.
    """
    groups: dict[str, list[Path | None]] = {}
    for label, path in zip(labels, paths, strict=True):
        if path not in groups.setdefault(label, []):
            groups[label].append(path)
    out = {(label, places[0]): label for label, places in groups.items()}
    used_labels = set(groups)
    for label, places in groups.items():
        if len(places) < 2:
            continue
        parts = [((path and path.parts) or ("simulated",))[::-1] for path in places]
        columns = [[file_safe(part) for part in column] for column in zip(*parts, strict=False)]
        names = next((c for c in columns if len(set(c)) == len(c)), [str(k + 1) for k in range(len(places))])
        for path, name in zip(places, names, strict=True):
            own = f"{label}-{name}"
            while own in used_labels:
                own += "-2"
            used_labels.add(own)
            out[label, path] = own
    return [out[label, path] for label, path in zip(labels, paths, strict=True)]


def scans_of_run(scans: int, config: InputConfig) -> int:
    """Number of scans of a recording that a run uses.

    >>> scans_of_run(20, InputConfig(start=1, skip_frames=4)), scans_of_run(20, InputConfig(count=3))
    (5, 3)
    """
    left = len(range(config.start, scans, config.skip_frames))
    return left if config.count is None else min(left, config.count)


def with_range(config: Config, own: ScanRange) -> Config:
    """Configuration with the range of scans of one sequence."""
    return config.model_copy(update={"input": config.input.model_copy(update=own.own)}) if own.own else config


def check_range(name: str, own: ScanRange, scans: int) -> None:
    """Raise UsageError when a sequence of so many scans ends before the requested range."""
    if own.own and own.last >= scans:
        said = ", ".join(f"{key} = {value}" for key, value in own.own.items())
        raise UsageError(f"sequence {name} has {scans} scans: {said} goes beyond its end")


def count_scans(configs: Iterable[InputConfig]) -> int | None:
    """Scans a simulation must have for all of these `start`, `count` and `skip_frames`; None is all it has by itself."""
    counts = [None if c.count is None else c.start + (c.count - 1) * c.skip_frames + 1 for c in configs]
    limits = [scans for scans in counts if scans is not None]
    return max(limits) if len(limits) == len(counts) else None
