"""Comparisons that ship with lslam: what a thesis compared, on drives of ours, beside what it prints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, ValidationError

from lslam.core.config import load_config
from lslam.core.config.config import explain, shipped
from lslam.core.config.section import Section
from lslam.core.errors import ConfigError, UsageError, nearest
from lslam.core.geometry import geodesy, se2
from lslam.core.printable import significant
from lslam.core.types.arrays import Floats
from lslam.core.types.comparison import RunScore, Table
from lslam.core.untrusted import parse_toml
from lslam.evaluation.beside import difficulty, judge_number, judge_order, spread
from lslam.io.formats.osm_buildings import read_buildings
from lslam.io.formats.osm_files import write_osm
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.simulation.osm_extract import EXACT, PERTURBED, osm_from_buildings
from lslam.simulation.osm_perturb import MapFaults, draw_perturbation, perturb
from lslam.studies.grid import Cell
from lslam.studies.variants import Imu, Variant, find_variants

Of = Literal["before", "after", "angular", "ate", "rpe"]
# Key of a run's values, and what people read.
QUANTITIES: dict[str, tuple[str, str]] = {
    "before": ("odometry.thesis_rmse", "rmse before the graph, m"),
    "after": ("thesis_rmse", "rmse after the graph, m"),
    "angular": ("thesis_angular", "angular rmse, deg"),
    "ate": ("planar_ate", "planar ATE, m"),
    "rpe": ("planar_rpe", "planar RPE, m"),
}
# Kept of the runs: what they wrote for people is not read here.
_ALWAYS = ("map.write=false", "report.html=false", "keyframes.deflate=0", "eval.metrics=['thesis']")
MAPS = "maps"
HARD = "-hard"
# Between a system and the map that it is given.
ON = "@"
# deg; so far off the heading at the start may be.
START_HEADING_DEG = 5.0


class MapKind(Section):
    """How wrong a map is: m of the whole, m and deg of each house, at most; or as `lslam simulate` perturbs it."""

    offset_m: float = Field(0.0, ge=0)
    house_m: float = Field(0.0, ge=0)
    house_deg: float = Field(0.0, ge=0)
    perturbed: bool = False


class Printed(Section):
    """Numbers of one table of a thesis, by method."""

    sequence: str
    of: Of
    source: str
    values: dict[str, float]


class Stated(Section):
    """That one system does better than another, as the printed numbers of both say, drive by drive."""

    text: str
    left: str
    right: str
    of: Of
    source: str


class Quick(Section):
    """What `--quick` runs."""

    sequences: tuple[str, ...]
    seeds: tuple[int, ...]


class ReadyComparison(Section):
    """A comparison with what a thesis prints of it.

    on_map : settings of the systems that take a map, each run on all `maps`
    """

    summary: str
    methods: tuple[str, ...]
    imu: Imu
    sequences: tuple[str, ...]
    seeds: tuple[int, ...]
    settings: tuple[str, ...] = ()
    quick: Quick
    maps: dict[str, MapKind] = Field(default_factory=dict)
    on_map: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    printed: tuple[Printed, ...]
    stated: tuple[Stated, ...] = ()

    def variants(self, settings: Sequence[str]) -> list[Variant]:
        """The methods, and the systems of `on_map` on each map, `settings` over all."""
        common = [*_ALWAYS, *self.settings, *settings]
        variants = find_variants(self.methods, None, common, self.imu)
        for name, own in self.on_map.items():
            config = load_config(None, [*common, *own])
            variants += [Variant(f"{name}{ON}{kind}", config, name) for kind in self.maps]
        return variants

    def fitted(self, variants: Sequence[Variant], cell: Cell, out: Path) -> list[Variant]:
        """The variants with the map of a simulated drive, its place and heading; drift is drawn by the drive's seed."""
        if not self.maps:
            return list(variants)
        T_enu_world, origin = _world_of(cell)
        first = T_enu_world @ read_trajectory(cell.path / "truth" / "trajectory.tum").poses[0]
        start = geodesy.from_local(first[None, :3, 3], origin)[0]
        place = {
            "origin": tuple(start.tolist()),
            "heading_deg": 90.0 - float(np.degrees(se2.of_se3(first[None])[0, 2])),
        }
        on_map = []
        for variant in variants:
            config = variant.config
            debug = config.debug.model_copy(update={"drift_seed": cell.seed or 0})
            if kind := variant.name.partition(ON)[2]:
                extract = str(self._map(kind, cell, out))
                osm = config.osm.model_copy(
                    update={**place, "extract": extract, "start_heading_deg": START_HEADING_DEG}
                )
                config = config.model_copy(update={"osm": osm})
            on_map.append(replace(variant, config=config.model_copy(update={"debug": debug})))
        return on_map

    def _map(self, kind: str, cell: Cell, out: Path) -> Path:
        errors = self.maps[kind]
        if errors == MapKind():
            return cell.path / EXACT
        if errors.perturbed:
            return cell.path / PERTURBED
        path = out / MAPS / f"{cell.sequence}-{cell.seed}-{kind}.osm"
        origin = _world_of(cell)[1]
        exact = read_buildings(cell.path / EXACT, origin)[1].buildings
        none = {"simplified": 0.0, "merged": 0.0, "missing": 0.0, "new": 0.0}
        turn = float(np.radians(errors.house_deg))
        faults = MapFaults(errors.offset_m, 1.0, errors.house_m, 1.0, turn, **none)
        perturbation = draw_perturbation(exact, faults, np.random.default_rng(cell.seed))
        path.parent.mkdir(parents=True, exist_ok=True)
        write_osm(path, osm_from_buildings(perturb(exact, perturbation), origin, None))
        return path

    def beside(self, runs: Sequence[RunScore]) -> tuple[Table, Table]:
        """The tables of numbers and of what is stated, of the runs that there are."""
        return self._numbers(runs), self._statements(runs)

    def _numbers(self, runs: Sequence[RunScore]) -> Table:
        rows = []
        for sequence, method in dict.fromkeys((run.sequence, run.method) for run in runs):
            for of, printed, source in self._of(sequence, method):
                values, angular = (list(_values(runs, sequence, method, each).values()) for each in (of, "angular"))
                hardness = difficulty(self._printed(sequence, method, "angular"), angular)
                judgement = judge_number(printed, values, hardness)
                ours = " / ".join(map(_text, spread(values)))
                theirs = (sequence, method, QUANTITIES[of][1], f"{printed:g}")
                rows.append((*theirs, ours, hardness, judgement.verdict, judgement.why, source))
        header = ("sequence", "method", "quantity", "thesis", "ours", "ours was", "verdict", "why", "source")
        recipe = (
            "ours: median / worst over seeds; reproduced: within a factor of two of a run; refuted: all runs are off to one side "
            "and ours was as hard by the angular error; undecided otherwise"
        )
        return Table("beside the thesis, number by number", header, tuple(rows), recipe)

    def _of(self, sequence: str, method: str) -> list[tuple[Of, float, str]]:
        """What is printed of a method on a drive, or on the clean twin of a hard one: quantity, number, source."""
        plain, system = sequence.removesuffix(HARD), method.split(ON)[0]
        return [(p.of, p.values[system], p.source) for p in self.printed if p.sequence == plain and system in p.values]

    def _printed(self, sequence: str, method: str, of: str) -> float | None:
        return next((value for kind, value, _ in self._of(sequence, method) if kind == of), None)

    def _statements(self, runs: Sequence[RunScore]) -> Table:
        rows = []
        scores = list(dict.fromkeys((run.sequence, run.method) for run in runs))
        for stated in self.stated:
            for sequence, method in scores:
                if method.split(ON)[0] != stated.left:
                    continue
                kind = method.removeprefix(stated.left)
                right = stated.right + kind if (sequence, stated.right + kind) in scores else stated.right
                a, b = (self._printed(sequence, name, stated.of) for name in (method, right))
                if a is None or b is None:
                    continue
                ours, theirs = (_values(runs, sequence, name, stated.of) for name in (method, right))
                pairs = [(ours[seed], theirs[seed]) for seed in ours if seed in theirs]
                judgement = judge_order(a < b, pairs)
                rows.append(
                    (stated.text, sequence + kind, f"{a / b:.2f}", judgement.verdict, judgement.why, stated.source)
                )
        header = ("the thesis", "drive", "its ratio", "verdict", "here", "source")
        recipe = "stated: decided where all seeds say the same, five or more of them"
        return Table("beside the thesis, system against system", header, tuple(rows), recipe)


def _world_of(cell: Cell) -> tuple[Floats, Floats]:
    """T_enu_world (4, 4) of a simulated drive, and latitude, longitude (deg) and height (m) of its origin."""
    world = parse_toml((cell.path / "truth" / "world.toml").read_text(encoding="utf-8"))
    return np.array(world["T_enu_world"]), np.array(world["origin_lat_lon_alt"])


def _values(runs: Sequence[RunScore], sequence: str, method: str, of: str) -> dict[int, float]:
    """A quantity by seed; inf of a run that failed."""
    key = QUANTITIES[of][0]
    return {
        run.seed: run.values.get(key, inf) if run.is_usable else inf
        for run in runs
        if (run.sequence, run.method) == (sequence, method)
    }


def _text(value: float) -> str:
    return "failed" if value == inf else significant(value)


def comparison_names() -> tuple[str, ...]:
    """Names of the comparisons that ship with lslam."""
    return tuple(sorted(shipped("lslam.studies", "comparisons")))


def find_comparison(name: str) -> ReadyComparison:
    """The ready comparison of that name. Raises UsageError with the nearest name for what is none."""
    if name not in comparison_names():
        raise UsageError(f"no ready comparison {name!r}; {nearest(name, comparison_names())}")
    try:
        return ReadyComparison.model_validate(parse_toml(shipped("lslam.studies", "comparisons")[name]))
    except ValidationError as error:
        raise ConfigError(explain(error, f"comparison {name!r}")) from None
