"""A study's runs before they are tied to a recording: every method at every point, and what runs beside."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

from lslam.config.study import Point, StudyConfig
from lslam.errors import ConfigError, UsageError
from lslam.printable import file_safe
from lslam.studies.variants import WITH_IMU, Variant, find_variants

# One thread: a run then keeps one core busy, as many go at once as there are cores, and times mean the same. Keyframes go
# with the run that made them, so they are not packed.
_ALWAYS = (
    "input.threads=1", "keyframes.deflate=0", "map.write=false", "map.write_features=false", "report.html=false",
)  # fmt: skip


@dataclass(frozen=True)
class Contender:
    """A variant of a study, named so that folders differ, and what it stands for."""

    variant: Variant
    method: str
    parameters: Point
    is_beside: bool = False

    @property
    def uses_imu(self) -> bool:
        """Whether it is to use the IMU."""
        return self.variant.config.imu.use


def contenders(study: StudyConfig, settings: Sequence[str] = ()) -> list[Contender]:
    """All of a study; `settings` ("a.b=v") beat what the study says, but not its parameters.

    Raises ConfigError or UsageError naming the parameter, the value and the nearest known key; UsageError for unknown methods.
    """
    common = [*_ALWAYS, *settings_of(study.config), *settings]
    found: list[Contender] = []
    taken: set[str] = set()
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
            name = free_name("-".join([variant.name, *values]), taken)
            method = variant.name.removesuffix(WITH_IMU)
            found.append(Contender(replace(variant, name=name, without=""), method, point))
    for variant in find_variants(study.beside, None, common, study.imu) if study.beside else []:
        named = replace(variant, name=free_name(f"beside-{variant.name}", taken), without="")
        found.append(Contender(named, variant.name.removesuffix(WITH_IMU), {}, is_beside=True))
    return found


def free_name(name: str, taken: set[str]) -> str:
    """The name as a folder's, with a number when one in `taken` has it; it is taken then.

    >>> taken = {"icp"}
    >>> free_name("icp", taken), free_name("icp", taken)
    ('icp-2', 'icp-3')
    """
    plain = file_safe(name)
    free = next(made for k in count(1) if (made := plain if k == 1 else f"{plain}-{k}") not in taken)
    taken.add(free)
    return free


def settings_of(sections: dict[str, dict[str, Any]]) -> list[str]:
    """Sections of a study file as settings "a.b=v"."""
    return [
        s for section, values in sections.items() for s in _setting({f"{section}.{k}": v for k, v in values.items()})
    ]


def _setting(values: dict[str, Any]) -> list[str]:
    """As `--set` takes them: JSON's values are TOML's."""
    return [f"{key}={json.dumps(value)}" for key, value in values.items()]
