"""The contenders of a study: methods by name, and whole configurations by the name or file of their preset."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from lslam.config import Config, load_config
from lslam.config.preset_files import known_presets
from lslam.errors import UsageError, nearest
from lslam.odometry import known_methods
from lslam.pipeline.check import check_config

log = logging.getLogger("lslam")

Imu = Literal["off", "on", "both"]
WITH_IMU = "+imu"
# They predict by themselves whatever the IMU says: run with it they would be the same run twice.
PREDICT_THEMSELVES = ("kiss-icp",)
# Methods that bring their own preprocessing and so never draw by `preprocess.seed`.
DRAW_NOTHING = ("kiss-icp", "small-gicp", "open3d-gicp", "loam-odom", "loam", "floam", "lego-loam")


@dataclass(frozen=True)
class Variant:
    """name : of the method or preset, for tables and folders; config : resolved, all of it.

    without : name of the same contender without the IMU, where `both` were asked for
    """

    name: str
    config: Config
    without: str = ""

    @property
    def draws(self) -> bool:
        """Whether its runs depend on `preprocess.seed`."""
        return self.config.preprocess.downsample == "random" and self.config.odometry.method not in DRAW_NOTHING

    def with_seed(self, seed: int) -> Config:
        """The same configuration with another seed of what it draws."""
        return self.config.model_copy(update={"preprocess": self.config.preprocess.model_copy(update={"seed": seed})})


def find_variants(
    names: Sequence[str], path: Path | None = None, settings: Iterable[str] = (), imu: Imu | None = None
) -> list[Variant]:
    """One variant per name of a method, name of a preset or TOML file, over the configuration that the others make.

    imu : `both` makes two of each, the second with the IMU and named `icp+imu`; `on` only that one, `off` only the other;
        None leaves it to the configuration

    Raises UsageError for an empty list, an unknown name (with the nearest one) or a name given twice, ConfigError and
    InputError as `load_config`.
    """
    if not names:
        raise UsageError(f"--methods is empty; known: {', '.join(known_methods())}")
    if imu not in (None, *get_args(Imu)):
        raise UsageError(f"--imu {imu}: {', '.join(get_args(Imu))}")
    settings = list(settings)
    variants: list[Variant] = []
    labels: set[str] = set()
    for name in names:
        label, setting = _meaning(name)
        if label in labels:
            raise UsageError(f"--methods names {label!r} twice")
        labels.add(label)
        for uses in {"off": (False,), "on": (True,), "both": (False, True), None: (None,)}[imu]:
            more = [] if uses is None else [f"imu.use={str(uses).lower()}"]
            config = load_config(path, [*settings, setting, *more])
            check_config(config)
            if uses and config.odometry.method in PREDICT_THEMSELVES and imu == "both":
                log.info("%s predicts by itself: it runs without the IMU only", label)
                continue
            called = label + WITH_IMU if uses else label
            variants.append(Variant(called, config, label if uses and imu == "both" else ""))
    return variants


def _meaning(name: str) -> tuple[str, str]:
    """Label and setting of a name."""
    if name in known_methods():
        return name, f"odometry.method={json.dumps(name)}"
    presets = known_presets()
    if name in presets or name.endswith(".toml"):
        return name if name in presets else Path(name).stem, f"odometry.preset={json.dumps(name)}"
    raise UsageError(f"no method or preset {name!r}; {nearest(name, [*known_methods(), *presets])}")
