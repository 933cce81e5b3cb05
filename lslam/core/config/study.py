"""A study file: which runs a sensitivity study is made of, and what it is expected to find."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import BaseModel, Field, ValidationError, ValidationInfo, field_validator, model_validator

from lslam.core.config.config import explain, read_toml
from lslam.core.config.input import ScanRange, Section
from lslam.core.errors import ConfigError, nearest

Kind = Literal[
    "diverges_beyond",
    "holds_up_to",
    "best_between",
    "largest_between",
    "elbow_at",
    "good_from",
    "matters_little",
    "linear",
    "inverse",
    "product",
    "acts_only_on",
    "rises",
    "falls",
    "imu_lowers",
    "imu_flattens",
    "imu_steepens",
]
Quantity = Literal["translation", "angular", "time_per_scan", "total_time", "efficiency", "total_efficiency"]

# Smallest and largest number of `values` of each kind.
_COUNTS: dict[str, tuple[int, int]] = {
    "diverges_beyond": (1, 1),
    "holds_up_to": (1, 1),
    "best_between": (2, 2),
    "largest_between": (2, 2),
    "elbow_at": (1, 1),
    "good_from": (1, 1),
    "matters_little": (1, 1),
    "linear": (0, 1),
    "inverse": (0, 1),
    "product": (0, 1),
    "acts_only_on": (0, 0),
    "rises": (0, 0),
    "falls": (0, 0),
    "imu_lowers": (0, 0),
    "imu_flattens": (0, 0),
    "imu_steepens": (0, 0),
}
_LAWS = ("linear", "inverse", "product")


class ExpectedFinding(Section):
    """One `[[finding]]` of a study file.

    Kinds and their `values`, in the unit of the studied parameter unless said otherwise:
    diverges_beyond v : the last value that works is v; holds_up_to v : nothing diverges up to v
    best_between low, high : the best value of `of` lies there; largest_between low, high : its largest one; on either side
        some value is worse
    elbow_at v : just below v the error rises; good_from v : from v on it does not, and below it does somewhere
    matters_little r : the largest `of` is less than r times the smallest
    linear, inverse, product [r2] : total time is a x + b, a / x, a y / x with at least this R2 (0.95), and no other of them
        fits as well
    acts_only_on : of all stages of registration the parameter changes the time of `stages` only
    rises, falls : `of` is larger, or smaller, over the upper half of the values than over the lower half
    imu_lowers, imu_flattens, imu_steepens : with the IMU `of` is smaller than without, or its slope over the values is smaller,
        or larger

    What differs by less than the seeds scatter is undecided.
    """

    text: str = Field(min_length=1, description="the finding in one sentence")
    kind: Kind = Field(description="what is expected, which says how it is judged")
    values: tuple[float, ...] = Field((), description="numbers of the kind, for example the two ends of a range")
    of: Quantity = Field("efficiency", description="what is best, largest or matters little")
    parameter: str = Field("", description="of several studied one at a time, the one it speaks of")
    method: str = Field("", description="judge runs of this method or preset only; empty: every one")
    imu: bool | None = Field(None, description="judge runs with, or without, the IMU only")
    at: dict[str, float] = Field(
        {}, description="of a two-way study: judge at these values of the other parameter only"
    )
    stages: tuple[str, ...] = Field((), description="acts_only_on: names of stages")
    source: str = Field("", description="where it is stated")

    @model_validator(mode="after")
    def _fit_kind(self) -> Self:
        """Raise ValueError for values or stages that do not fit the kind."""
        least, most = _COUNTS[self.kind]
        if not least <= len(self.values) <= most:
            wanted = f"{least}" if least == most else f"{least} or {most}"
            raise ValueError(f"finding {self.kind} takes {wanted} values, not {len(self.values)}")
        if len(self.values) == 2 and self.values[0] > self.values[1]:
            raise ValueError(f"finding {self.kind}: {self.values[0]:g} must not lie above {self.values[1]:g}")
        if self.kind == "matters_little" and self.values[0] <= 1:
            raise ValueError(f"finding matters_little: the ratio {self.values[0]:g} must lie above 1")
        if self.kind in _LAWS and any(not 0 < value <= 1 for value in self.values):
            raise ValueError(f"finding {self.kind}: R2 of {self.values[0]:g} must lie between 0 and 1")
        if (self.kind == "acts_only_on") != bool(self.stages):
            raise ValueError("finding acts_only_on names its stages, and no other kind does")
        return self


Value = bool | int | float | str
Point = dict[str, Value]
# Decimals of a range's values: 0.1 + 0.2 shall be 0.3.
_DIGITS = 12
# Values of a range, and points of a grid: each is a run at least, and a study of more would never end.
MOST_VALUES, MOST_POINTS = 10_000, 100_000
# The errors that a study may be judged by.
StudyMetric = Literal["ate_se3", "ate_origin", "thesis_rmse"]


class Range(Section):
    """Values from `start` to `stop`, both included, `step` apart or `num` of them."""

    start: int | float = Field(description="first value")
    stop: int | float = Field(description="last value, reached when a step falls on it")
    step: int | float | None = Field(None, gt=0, description="distance of two values")
    num: int | None = Field(None, ge=2, description="number of values, instead of a step")
    log: bool = Field(False, description="equal ratios instead of equal distances, with `num`")

    @model_validator(mode="after")
    def _check(self) -> Range:
        """Raise ValueError for an empty, ambiguous or too long range."""
        if self.stop < self.start:
            raise ValueError(f"the range from {self.start} to {self.stop} is empty: stop lies below start")
        if (self.step is None) == (self.num is None):
            raise ValueError(f"the range from {self.start} to {self.stop} needs a step or num, one of them")
        if self.log and (self.num is None or self.start <= 0):
            raise ValueError(f"the range from {self.start} to {self.stop}: log needs num and a start above 0")
        if not self._is_short():
            raise ValueError(f"the range from {self.start} to {self.stop} has more than {MOST_VALUES} values")
        return self

    def _is_short(self) -> bool:
        """Whether the range has at most `MOST_VALUES` values, computed without building it."""
        if self.num is not None:
            return self.num <= MOST_VALUES
        assert self.step is not None
        try:
            return (self.stop - self.start) / self.step < MOST_VALUES
        except OverflowError:
            return False

    def values(self) -> tuple[int | float, ...]:
        """All values, ascending; integers when both ends are.

        >>> Range(start=0.1, stop=0.3, step=0.1).values()
        (0.1, 0.2, 0.3)
        >>> Range(start=1, stop=100, num=3, log=True).values()
        (1, 10, 100)
        """
        if self.step is not None:
            count = math.floor((self.stop - self.start) / self.step + 1e-9) + 1
            values = [self.start + k * self.step for k in range(count)]
        else:
            assert self.num is not None
            shares = [k / (self.num - 1) for k in range(self.num)]
            if self.log:
                values = [self.start * (self.stop / self.start) ** share for share in shares]
            else:
                values = [self.start + (self.stop - self.start) * share for share in shares]
        values = [round(value, _DIGITS) for value in values]
        is_whole = isinstance(self.start, int) and isinstance(self.stop, int)
        return tuple(int(value) if is_whole and value == int(value) else value for value in values)


class StudySequence(ScanRange):
    """A recording (`path`) or a scenario that is simulated once per seed, and which scans of it are used."""

    path: str = Field("", description="a recording: what `lslam run` takes")
    scenario: str = Field("", description="or a scenario: a name of `lslam simulate --list` or a .toml file")
    lidar: str | None = Field(None, description="scenario: the sensor, absent: the scenario's")
    columns: int | None = Field(None, ge=16, le=8192, description="scenario: firings per scan, absent: the sensor's")
    scans: int | None = Field(None, ge=1, description="scenario: scans, absent: all of its way, or as many as are used")
    speed: float | None = Field(None, gt=0, description="scenario: m/s, absent: the scenario's")
    compensated: bool | None = Field(None, description="scenario: scans without motion in them, absent: the scenario's")
    imu: str = Field("icm20948", description="scenario: the IMU that rides along")
    settings: tuple[str, ...] = Field((), description='scenario: what else to change, "world.relief=1"')

    @model_validator(mode="after")
    def _check(self) -> StudySequence:
        """Raise ValueError unless exactly one of path and scenario is set, and for a scenario's keys with a path."""
        if bool(self.path) == bool(self.scenario):
            raise ValueError("a sequence is a path or a scenario: give one of them")
        more = ", ".join(sorted(self.model_fields_set - {"path", "scenario", *ScanRange.model_fields}))
        if self.path and more:
            raise ValueError(f"{more} belong to a scenario: the recording {self.path} is as it is")
        return self

    @property
    def name(self) -> str:
        """What the user called it."""
        return self.path or self.scenario


class StudyConfig(Section):
    """Runs of a study: sequences x seeds x methods x points of the parameters, and methods beside at their own values."""

    name: str = Field(min_length=1, pattern=r"^[\w.+ -]+$", description="of the study and its folder")
    summary: str = Field("", description="what is studied, in a line")
    sequences: tuple[StudySequence, ...] = Field(min_length=1, description="recordings and scenarios")
    methods: tuple[str, ...] = Field(min_length=1, description="methods, presets or configuration files")
    beside: tuple[str, ...] = Field((), description="likewise, run once at their own values")
    imu: Literal["off", "on", "both"] = Field("off", description="without the IMU, with it, or each method both ways")
    seeds: tuple[int, ...] = Field((0,), min_length=1, description="of simulations, and of methods that draw")
    metric: StudyMetric = Field("ate_se3", description="the error it judges by, m")
    grid: Literal["full", "one-way"] = Field(
        "full", description="all combinations of the parameters' values, or one parameter at a time"
    )
    parameters: dict[str, Range | tuple[Value, ...]] = Field(
        min_length=1, description="by configuration key: a list of values or a range {start, stop, step | num, log}"
    )
    config: dict[str, dict[str, Any]] = Field({}, description="sections that hold for all runs, over the presets")
    finding: tuple[ExpectedFinding, ...] = Field((), description="what is expected")

    @field_validator("parameters", mode="before")
    @classmethod
    def _flatten(cls, tree: Any) -> Any:
        """Join nested tables: TOML reads `input.skip_frames = [...]` as a table in a table."""
        if not isinstance(tree, dict):
            return tree
        flat: dict[str, Any] = {}
        for name, inner in tree.items():
            if "." not in name and isinstance(inner, dict):
                flat |= {f"{name}.{key}": values for key, values in inner.items()}
            else:
                flat[name] = inner
        return flat

    @field_validator("parameters")
    @classmethod
    def _has_values(
        cls, parameters: dict[str, Range | tuple[Value, ...]], info: ValidationInfo
    ) -> dict[str, Range | tuple[Value, ...]]:
        """Raise ValueError for a parameter without values, with duplicates, or that a sequence sets itself."""
        for sequence in info.data.get("sequences", ()):
            for key in sequence.own:
                if f"input.{key}" in parameters:
                    raise ValueError(f"input.{key} is studied, and sequence {sequence.name} has a {key} of its own")
        for key, values in parameters.items():
            listed = values.values() if isinstance(values, Range) else values
            if not listed:
                raise ValueError(f"{key} has no values: list at least one")
            if len(set(listed)) < len(listed):
                raise ValueError(f"{key} has a value twice")
        return parameters

    @field_validator("seeds")
    @classmethod
    def _differ(cls, seeds: tuple[int, ...]) -> tuple[int, ...]:
        """Raise ValueError for duplicate or negative seeds."""
        return distinct_seeds(seeds)

    @field_validator("finding")
    @classmethod
    def _speak_of_runs(cls, findings: tuple[ExpectedFinding, ...], info: ValidationInfo) -> tuple[ExpectedFinding, ...]:
        """Raise ValueError for a finding about a key or a method that is not studied."""
        keys, words = info.data.get("parameters", {}), info.data.get("methods", ())
        labels = [Path(word).stem if word.endswith(".toml") else word for word in words]
        for finding in findings:
            for name, known in (
                (finding.parameter, keys),
                (finding.method, labels),
                *((key, keys) for key in finding.at),
            ):
                if name and known and name not in known:
                    raise ValueError(
                        f"{finding.text!r} speaks of {name!r}, which is not studied; {nearest(name, known)}"
                    )
        return findings

    @model_validator(mode="after")
    def _ends(self) -> StudyConfig:
        """Raise ValueError for a study of too many combinations of parameters."""
        counts = [len(v.values() if isinstance(v, Range) else v) for v in self.parameters.values()]
        count = sum(counts) if self.grid == "one-way" else math.prod(counts)
        if count > MOST_POINTS:
            raise ValueError(f"the parameters have {count:,} combinations, more than {MOST_POINTS:,}: vary fewer")
        return self

    def points(self) -> list[Point]:
        """Values of the studied parameters, a point per run of a method."""
        lists = {key: v.values() if isinstance(v, Range) else v for key, v in self.parameters.items()}
        if self.grid == "one-way":
            return [{key: value} for key, values in lists.items() for value in values]
        return [dict(zip(lists, values, strict=True)) for values in product(*lists.values())]


def distinct_seeds(seeds: tuple[int, ...]) -> tuple[int, ...]:
    """The seeds; raises ValueError when one is there twice or below 0."""
    if len(set(seeds)) < len(seeds) or min(seeds, default=0) < 0:
        raise ValueError("different whole numbers from 0 are needed")
    return seeds


def read_study(path: Path) -> StudyConfig:
    """The study of a file. Raises InputError when it cannot be read, ConfigError naming the key and the nearest known one."""
    return parse_study(read_toml(path, "study"), str(path), path.stem)


def parse_study(tree: dict[str, Any], where: str, name: str) -> StudyConfig:
    """The study of a TOML tree read from `where`; `name` is its name if the tree has none. Raises ConfigError."""
    check_keys(tree, StudyConfig, where)
    for sequence in tables(tree.get("sequences")):
        check_keys(sequence, StudySequence, f"{where}: sequences")
    try:
        return StudyConfig.model_validate({"name": name, **tree})
    except ValidationError as error:
        raise ConfigError(explain(error, where)) from None


def tables(value: Any) -> Sequence[dict[str, Any]]:
    """The tables (dictionaries) in a list, empty for another value. Other items are left to validation, which reports them."""
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


def check_keys(tree: dict[str, Any], model: type[BaseModel], where: str) -> None:
    """Raise ConfigError for a key that `model` does not have, naming the nearest one."""
    for key in tree:
        if key not in model.model_fields:
            raise ConfigError(f"{where}: unknown key {key!r}; {nearest(key, model.model_fields)}")


class BatchJob(Section):
    """One `[[jobs]]`: its sequences x methods x seeds."""

    sequences: tuple[StudySequence, ...] = Field(
        min_length=1, description="recordings (their paths or names, or tables as in a study) and scenarios (tables)"
    )
    methods: tuple[str, ...] = Field(("icp",), min_length=1, description="methods, presets or configuration files")
    imu: Literal["off", "on", "both"] = Field("off", description="without the IMU, with it, or each method both ways")
    seeds: tuple[int, ...] = Field((0,), min_length=1, description="of simulations, and of methods that draw")
    config: dict[str, dict[str, Any]] = Field({}, description="sections that hold for its runs, over the presets")

    @field_validator("sequences", mode="before")
    @classmethod
    def _name(cls, sequences: Any) -> Any:
        """Turn a text in the list of sequences into the table of a recording with that path."""
        is_list = isinstance(sequences, (list, tuple))
        return [{"path": s} if isinstance(s, str) else s for s in sequences] if is_list else sequences

    @field_validator("seeds")
    @classmethod
    def _differ(cls, seeds: tuple[int, ...]) -> tuple[int, ...]:
        """Raise ValueError for duplicate or negative seeds."""
        return distinct_seeds(seeds)


class BatchConfig(Section):
    """All of a batch file."""

    config: dict[str, dict[str, Any]] = Field({}, description="sections that hold for all runs, over the presets")
    jobs: tuple[BatchJob, ...] = Field(min_length=1, description="what is run")


def read_batch(path: Path) -> BatchConfig:
    """The batch of a file. Raises InputError when it cannot be read, ConfigError naming the key and the nearest known one."""
    return parse_batch(read_toml(path, "batch"), str(path))


def parse_batch(tree: dict[str, Any], where: str) -> BatchConfig:
    """The batch of a TOML tree read from `where`; raises ConfigError as `read_batch`."""
    check_keys(tree, BatchConfig, where)
    for job in tables(tree.get("jobs")):
        check_keys(job, BatchJob, f"{where}: jobs")
        for sequence in tables(job.get("sequences")):
            check_keys(sequence, StudySequence, f"{where}: jobs: sequences")
    try:
        return BatchConfig.model_validate(tree)
    except ValidationError as error:
        raise ConfigError(explain(error, where)) from None
