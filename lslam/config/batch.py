"""A batch file: runs of many sequences and configurations."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError, field_validator

from lslam.config.load import explain
from lslam.config.preset_files import read_toml
from lslam.config.section import Section
from lslam.config.study import StudySequence, check_keys, distinct_seeds, tables
from lslam.errors import ConfigError


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
        """A word is a recording."""
        is_list = isinstance(sequences, (list, tuple))
        return [{"path": s} if isinstance(s, str) else s for s in sequences] if is_list else sequences

    @field_validator("seeds")
    @classmethod
    def _differ(cls, seeds: tuple[int, ...]) -> tuple[int, ...]:
        return distinct_seeds(seeds)


class BatchConfig(Section):
    """All of a batch file."""

    config: dict[str, dict[str, Any]] = Field({}, description="sections that hold for all runs, over the presets")
    jobs: tuple[BatchJob, ...] = Field(min_length=1, description="what is run")


def read_batch(path: Path) -> BatchConfig:
    """The batch of a file. Raises InputError when it cannot be read, ConfigError naming the key and the nearest known one."""
    return parse_batch(read_toml(path, "batch"), str(path))


def parse_batch(tree: dict[str, Any], where: str) -> BatchConfig:
    """The batch of a TOML tree found in `where`; raises ConfigError as `read_batch`."""
    check_keys(tree, BatchConfig, where)
    for job in tables(tree.get("jobs")):
        check_keys(job, BatchJob, f"{where}: jobs")
        for sequence in tables(job.get("sequences")):
            check_keys(sequence, StudySequence, f"{where}: jobs: sequences")
    try:
        return BatchConfig.model_validate(tree)
    except ValidationError as error:
        raise ConfigError(explain(error, where)) from None
