"""The variants of a study: methods by name, configurations by their preset, at every point of the studied parameters."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any, Literal, get_args

from lslam.core.config import Config, load_config
from lslam.core.config.config import known_presets
from lslam.core.config.study import Point, StudyConfig
from lslam.core.errors import ConfigError, UsageError, nearest
from lslam.core.printable import file_safe
from lslam.odometry import Coupling, coupling_of, known_methods
from lslam.pipeline.check import check_config

log = logging.getLogger("lslam")

Imu = Literal["off", "on", "both"]
WITH_IMU = "+imu"
# Methods that bring their own preprocessing and so never draw by `preprocess.seed`.
DRAW_NOTHING = ("kiss-icp", "small-gicp", "open3d-gicp", "loam-odom", "loam", "floam", "lego-loam")

# One thread: a run then keeps one core busy, as many go at once as there are cores, and times mean the same.
_ALWAYS = (
    "input.threads=1",
    "map.write=false",
    "map.write_features=false",
    "report.html=false",
)


@dataclass(frozen=True)
class Variant:
    """Resolved configuration of a comparison, study or batch.

    name : for tables and folders, unique; method : of the method or preset, without its IMU
    without : name of the same variant without the IMU, where `both` were asked for
    parameters : what a study varies, by configuration key; empty beside a study (`is_beside`)
    """

    name: str
    config: Config
    method: str
    without: str = ""
    parameters: Point = field(default_factory=dict)
    is_beside: bool = False

    @property
    def uses_imu(self) -> bool:
        """Whether it is to use the IMU."""
        return self.config.imu.use

    @property
    def draws(self) -> bool:
        """Whether its runs depend on `preprocess.seed`."""
        return self.config.preprocess.downsample == "random" and self.config.odometry.method not in DRAW_NOTHING

    def with_seed(self, seed: int) -> Config:
        """The configuration with another random seed for everything that the method draws."""
        return self.config.model_copy(update={"preprocess": self.config.preprocess.model_copy(update={"seed": seed})})


def find_variants(
    names: Sequence[str], path: Path | None = None, settings: Iterable[str] = (), imu: Imu | None = None
) -> list[Variant]:
    """One variant per name of a method, name of a preset or TOML file, over the configuration that the others make.

    imu : `both` makes two of each, the second with the IMU and named `icp+imu`; `on` only that one, `off` only the other;
        None leaves it to the configuration. A tightly coupled method is one variant by its own name, with the IMU always

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
        wanted: tuple[bool | None, ...] = {"off": (False,), "on": (True,), "both": (False, True), None: (None,)}[imu]
        for uses in wanted:
            more = [] if uses is None else [f"imu.use={str(uses).lower()}"]
            config = load_config(path, [*settings, setting, *more])
            check_config(config)
            coupling = coupling_of(config.odometry.method)
            if coupling is Coupling.TIGHT:
                if uses is False:
                    log.info("%s is an estimate of points and IMU: it runs with the IMU only", label)
                variants.append(Variant(label, config, label))
                break
            if uses and coupling is Coupling.NONE and imu == "both":
                log.info("%s predicts by itself: it runs without the IMU only", label)
                continue
            called = label + WITH_IMU if uses else label
            variants.append(Variant(called, config, label, label if uses and imu == "both" else ""))
    return variants


def _meaning(name: str) -> tuple[str, str]:
    """Label and setting of a method's or preset's name; raises UsageError for an unknown one."""
    if name in known_methods():
        return name, f"odometry.method={json.dumps(name)}"
    presets = known_presets()
    if name in presets or name.endswith(".toml"):
        return name if name in presets else Path(name).stem, f"odometry.preset={json.dumps(name)}"
    raise UsageError(f"no method or preset {name!r}; {nearest(name, [*known_methods(), *presets])}")


def study_variants(study: StudyConfig, settings: Sequence[str] = ()) -> list[Variant]:
    """All variants of a study, one per method and point of its parameters.

    settings : "a.b=v", which override the study's settings, but not its parameters
    Raises ConfigError or UsageError naming the parameter, the value and the nearest known key; UsageError for unknown methods.
    """
    common = [*_ALWAYS, *settings_of(study.config), *settings]
    found: list[Variant] = []
    names: set[str] = set()
    for point in study.points():
        said = ", ".join(f"{key} = {value}" for key, value in point.items())
        try:
            variants = find_variants(study.methods, None, [*common, *_setting(point)], study.imu)
        except (ConfigError, UsageError) as error:
            what = str(error)
            for setting in _setting(point):
                what = what.removeprefix(f"--set {setting}: ")
            raise type(error)(f"study {study.name}, {said}: {what}") from None
        for variant in variants:
            values = (f"{key.partition('.')[2]}_{value}" for key, value in point.items())
            name = free_name("-".join([variant.name, *values]), names)
            found.append(replace(variant, name=name, without="", parameters=point))
    for variant in find_variants(study.beside, None, common, study.imu) if study.beside else []:
        name = free_name(f"beside-{variant.name}", names)
        found.append(replace(variant, name=name, without="", is_beside=True))
    for variant in found:
        _check_metric(study, variant.config.eval.align)
    return found


def _check_metric(study: StudyConfig, align: Sequence[str]) -> None:
    """Raise UsageError when the study's metric needs an alignment that is not evaluated."""
    alignment = study.metric.removeprefix("ate_")
    if alignment != study.metric and alignment not in align:
        raise UsageError(
            f"study {study.name} judges by {study.metric}, and eval.align has {', '.join(align)} only: add {alignment}, or give "
            "another `metric`"
        )


def free_name(name: str, names: set[str]) -> str:
    """The name as a folder name that is not in `names`, with a number appended if necessary; it is added to `names`.

    >>> names = {"icp"}
    >>> free_name("icp", names), free_name("icp", names)
    ('icp-2', 'icp-3')
    """
    plain = file_safe(name)
    free = next(made for k in count(1) if (made := plain if k == 1 else f"{plain}-{k}") not in names)
    names.add(free)
    return free


def settings_of(sections: dict[str, dict[str, Any]]) -> list[str]:
    """Sections of a study file as settings "a.b=v"."""
    return [
        s for section, values in sections.items() for s in _setting({f"{section}.{k}": v for k, v in values.items()})
    ]


def _setting(values: dict[str, Any]) -> list[str]:
    """Values of a section as "key=value", as `--set` takes them."""
    return [f"{key}={json.dumps(value)}" for key, value in values.items()]
