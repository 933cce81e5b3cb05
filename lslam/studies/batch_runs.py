"""Runs of a batch, from a file or from lines of `lslam run`."""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lslam.core.config import Config
from lslam.core.config.study import BatchConfig, BatchJob, parse_batch
from lslam.core.errors import InputError, UsageError
from lslam.core.printable import file_safe, toml_text
from lslam.core.types.sequence import Sequence as Recording
from lslam.core.types.trajectory import Trajectory
from lslam.pipeline.resume import imu_digest, input_digest, listing_digest
from lslam.studies.grid import Cell, Job, cells_of, expand, label_of, run_folder
from lslam.studies.jobs import ExpandedStudy, check_same
from lslam.studies.options import BATCH, OutputOptions
from lslam.studies.subjects import unique_labels
from lslam.studies.variants import WITH_IMU, Variant, find_variants, free_name, settings_of


@dataclass(frozen=True)
class RunLine:
    """One `lslam run` with its options resolved; words : of its command line; folder : None to choose."""

    words: str
    cell: Cell
    config: Config
    folder: Path | None = None


def opened_line(
    words: str, sequence: Recording, config: Config, truth: Trajectory | None, folder: Path | None, **reading: Any
) -> RunLine:
    """Run of a recording that is open, with its ground truth and the options `reading` that it was opened with.

    Raises InputError when its files cannot be listed.
    """
    digest = input_digest(sequence, truth) + _reading_digest(reading)
    imu = imu_digest(sequence) if config.imu.use else ""
    path = sequence.path.absolute()
    return RunLine(
        words, Cell(file_safe(sequence.name), path, None, digest, truth, imu, reading=reading), config, folder
    )


def listed_line(words: str, path: Path, config: Config, folder: Path | None, **reading: Any) -> RunLine:
    """Run of a recording in storage, which only the run itself opens. Raises InputError when its files cannot be listed."""
    digest = listing_digest(path) + _reading_digest(reading)
    return RunLine(words, Cell(label_of(path), path, None, digest, reading=reading), config, folder)


def refused_line(words: str, path: Path, config: Config, folder: Path | None, refusal: str) -> RunLine:
    """Run of an unreadable recording: it will fail with `refusal`."""
    return RunLine(words, Cell(label_of(path), path, None, _reading_digest({}), refusal=refusal), config, folder)


def _reading_digest(reading: Mapping[str, Any]) -> str:
    """Digest of the options that a recording is opened with."""
    return hashlib.sha256(repr(sorted(reading.items())).encode()).hexdigest()


def expand_batch(batch: BatchConfig, output: OutputOptions, settings: Sequence[str] = ()) -> ExpandedStudy:
    """All runs of a batch file; `settings` ("a.b=v") override it.

    Unreadable recordings give runs that will fail.

    Raises ConfigError, UsageError or InputError for methods and scenarios that make no sense, and when no recording can be
    read; OutputExistsError when it is to go on in the folder of another list.
    """
    text = toml_text(batch.model_dump(mode="json", exclude_none=True, exclude_defaults=True))
    check_same(output, BATCH, text, _names)
    jobs: list[Job] = []
    found: dict[str, Variant] = {}
    names: set[str] = set()
    parts: list[tuple[list[Cell], list[Variant], BatchJob]] = []
    for entry in batch.jobs:
        common = [*settings_of(batch.config), *settings_of(entry.config), *settings]
        # One method with two configurations is two folders.
        variants = [
            replace(variant, name=free_name(variant.name, names), without="")
            for variant in find_variants(entry.methods, None, common, entry.imu)
        ]
        cells = cells_of(entry.sequences, entry.seeds, variants, output, settings, may_fail=True)
        parts.append((cells, variants, entry))
        found |= {variant.name: variant for variant in variants}
    every = [cell for cells, _, _ in parts for cell in cells]
    labels = iter(unique_labels([c.sequence for c in every], [None if c.scene else c.path for c in every]))
    for cells, variants, entry in parts:
        own = [replace(cell, sequence=next(labels)) for cell in cells]
        jobs += expand(own, variants, entry.seeds, output.out, output.command)
    _check_readable(jobs)
    return ExpandedStudy("batch", BATCH, text, jobs, found)


def _check_readable(jobs: Sequence[Job]) -> None:
    """Raise InputError when no recording of the jobs can be read, with the reason of the first."""
    if jobs and all(job.refusal for job in jobs):
        raise InputError(jobs[0].refusal)


def expand_lines(lines: Sequence[RunLine], output: OutputOptions) -> ExpandedStudy:
    """All runs of a list of lines; those without a folder of their own are numbered in `output.out`.

    Raises UsageError for two lines that name one folder, OutputExistsError
    when they are to go on in the folder of a list that has none of them.
    """
    text = toml_text({"lines": [line.words for line in lines]})
    check_same(output, BATCH, text, _names)
    jobs: list[Job] = []
    variants: dict[str, Variant] = {}
    owners: dict[Path, int] = {}
    labels = unique_labels([line.cell.sequence for line in lines], [line.cell.path for line in lines])
    for number, (line, label) in enumerate(zip(lines, labels, strict=True), 1):
        config = line.config
        method = config.odometry.preset or config.odometry.method
        name = f"{number:03d}-{file_safe(method)}{WITH_IMU if config.imu.use else ''}"
        variants[name] = Variant(name, config, method)
        seed = config.preprocess.seed
        folder = run_folder(output.out, label, name, seed) if line.folder is None else line.folder
        if owners.setdefault(folder.resolve(), number) != number:
            raise UsageError(
                f"run {owners[folder.resolve()]} and run {number} of the batch are both to be written to {folder}: give each "
                "an --out of its own"
            )
        cell = replace(line.cell, sequence=label, data_root=output.data_root)
        jobs.append(cell.job(name, seed, config, folder, line.words))
    _check_readable(jobs)
    return ExpandedStudy("batch", BATCH, text, jobs, variants)


def _names(tree: dict[str, Any]) -> list[str]:
    """Names of the content of BATCH: its lines, or each recording and scenario of its jobs with each method."""
    lines = tree.get("lines")
    if isinstance(lines, list) and lines:
        return [str(line) for line in lines]
    return [
        f"{sequence.path or sequence.scenario} {method}"
        for job in parse_batch(tree, BATCH).jobs
        for sequence in job.sequences
        for method in job.methods
    ]


def run_words(text: str) -> list[tuple[int, list[str]]]:
    """Number and words after `lslam run` of each line; empty lines and comments are none. Raises UsageError naming a line.

    >>> run_words("# tonight\\nlslam run seq07 --imu\\n\\nseq08\\n")
    [(2, ['seq07', '--imu']), (4, ['seq08'])]
    """
    lines = []
    for number, line in enumerate(text.splitlines(), 1):
        try:
            words = shlex.split(line, comments=True)
        except ValueError as error:
            raise UsageError(f"line {number}: {error}") from None
        if words[:2] == ["lslam", "run"]:
            words = words[2:]
        if words:
            lines.append((number, words))
    return lines
