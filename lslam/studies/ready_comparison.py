"""Comparisons that ship with lslam: what a thesis compared, on drives of ours, beside what it prints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field, ValidationError

from lslam.core.arrays import Floats
from lslam.core.config import load_config
from lslam.core.config.config import explain, read_package_files
from lslam.core.config.input import Section
from lslam.core.errors import ConfigError, InputError, UsageError, nearest
from lslam.core.geometry import geodesy, se2
from lslam.core.printable import file_safe, significant
from lslam.core.types.comparison import RunScore, Table
from lslam.core.untrusted import parse_toml
from lslam.evaluation.thesis import RPY, Judgement, difficulty, judge_number, judge_order, judge_time, median_and_worst
from lslam.io.formats.osm_buildings import read_buildings
from lslam.io.formats.osm_files import write_osm
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers import find_folder, open_sequence
from lslam.io.readers.kitti_raw import start_on_earth
from lslam.simulation.osm_extract import EXACT, PERTURBED, MapFaults, draw_perturbation, osm_from_buildings, perturb
from lslam.studies.grid import Cell
from lslam.studies.variants import Imu, Variant, find_variants

Of = Literal["before", "after", "percent", "max", "angular", "angular_max", "prior", "time", "ate", "rpe"]


class Quantity(NamedTuple):
    """What people read, the key of a run's values, by what it is multiplied, and the key by whose value it is divided."""

    label: str
    key: str
    times: float = 1.0
    per: str = ""

    def of(self, values: Mapping[str, float]) -> float:
        """The number of a run; inf where a value is unknown."""
        value, whole = values.get(self.key, inf), values.get(self.per, inf) if self.per else 1.0
        return self.times * value / whole if whole < inf else inf


QUANTITIES: dict[str, Quantity] = {
    "before": Quantity("rmse before the graph, m", "odometry.thesis_rmse"),
    "after": Quantity("rmse after the graph, m", "thesis_rmse"),
    "percent": Quantity("rmse after the graph, % of length", "thesis_rmse", 100, "path"),
    "max": Quantity("largest error, m", "thesis_max"),
    "angular": Quantity("angular rmse, deg", "thesis_angular"),
    "angular_max": Quantity("largest angular error, deg", "thesis_angular_max"),
    "prior": Quantity("error of the first guess", "prior_norm"),
    "time": Quantity("time per scan, s", "time.mean", 1e-3),
    "ate": Quantity("planar ATE, m", "planar_ate"),
    "rpe": Quantity("planar RPE, m", "planar_rpe"),
}
# Of them, what says how hard a drive was.
HARDNESS: tuple[Of, ...] = ("angular", "angular_max")
# Of which a thesis prints no number.
FURTHER = (
    *(Quantity(f"{axis}, m", f"thesis_{axis}") for axis in "xyz"),
    *(Quantity(f"{axis}, deg", f"thesis_{axis}") for axis in RPY),
    Quantity("share of inliers", "inlier_share"),
)
# Kept of the runs: what they wrote for people is not read here.
_ALWAYS = ("map.write=false", "report.html=false", "eval.metrics=['thesis']")
MAPS = "maps"
HARD = "-hard"
# Between a system and the map that it is given.
ON = "@"
# deg; so far off the heading at the start may be.
START_HEADING_DEG = 5.0


class MapKind(Section):
    """How wrong a map is: m of the whole, m and deg of each house, at most; or as `lslam simulate` perturbs it; or a file."""

    offset_m: float = Field(0.0, ge=0)
    house_m: float = Field(0.0, ge=0)
    house_deg: float = Field(0.0, ge=0)
    is_as_simulated: bool = False
    file: str = ""


class ThesisNumbers(Section):
    """Numbers of one table of a thesis, by method."""

    sequence: str
    of: Of
    source: str
    values: dict[str, float]


class Claim(Section):
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


class OwnRecording(Section):
    """The recording of the thesis, below a folder of the user; `settings` are those of the comparison there."""

    sequence: str
    settings: tuple[str, ...]


class ReadyComparison(Section):
    """A comparison with what a thesis prints of it.

    systems : settings of further systems: each on all `maps`, or where there are none on drives of which a number is printed
    further : what is said below the table of FURTHER; without it there is none
    """

    summary: str
    methods: tuple[str, ...]
    imu: Imu
    sequences: tuple[str, ...]
    seeds: tuple[int, ...]
    settings: tuple[str, ...] = ()
    quick: Quick
    recording: OwnRecording | None = None
    maps: dict[str, MapKind] = Field(default_factory=dict)
    systems: dict[str, tuple[str, ...]] = Field(default_factory=dict)
    numbers: tuple[ThesisNumbers, ...]
    further: str = ""
    claims: tuple[Claim, ...] = ()

    def variants(self, settings: Sequence[str]) -> list[Variant]:
        """The methods and the further systems, these on each map, `settings` over all."""
        common = [*_ALWAYS, *self.settings, *settings]
        variants = find_variants(self.methods, None, common, self.imu)
        for name, own in self.systems.items():
            config = load_config(None, [*common, *own])
            variants += [Variant(name + mark, config, name) for mark in [ON + kind for kind in self.maps] or [""]]
        return variants

    def on_recording(self, data_root: Path) -> ReadyComparison:
        """The comparison on the thesis' own recording, on the one OSM file in `data_root`.

        Raises UsageError where there is none of this comparison; InputError with a sentence for each thing that is missing.
        """
        if self.recording is None:
            raise UsageError("--data-root: what this comparison compares is not public; it simulates its drives")
        word, missing, maps = self.recording.sequence, [], sorted(data_root.expanduser().glob("*.osm"))
        folder = data_root / "sequences" / word
        try:
            folder = find_folder(word, data_root)
            word = file_safe(open_sequence(folder).name)
        except InputError as error:
            missing.append(f"no scans: {error}.")
        try:
            start_on_earth(folder, data_root)
        except InputError as error:
            missing.append(f"no place and heading at the start: {error}.")
        if len(maps) != 1:
            fetch = f"lslam osm fetch --along {self.recording.sequence} --data-root {data_root} --out {data_root / 'town.osm'}"
            missing.append(f"no map: one *.osm is wanted in {data_root}, not {len(maps)}; `{fetch}` makes it.")
        if missing:
            raise InputError("\n".join(missing))
        of_recording = {
            "sequences": (self.recording.sequence,),
            "settings": self.recording.settings,
            "maps": {"osm": MapKind(file=str(maps[0].absolute()))},
            "quick": self.quick.model_copy(update={"sequences": (self.recording.sequence,)}),
            "numbers": tuple(p.model_copy(update={"sequence": word}) for p in self.numbers),
        }
        return self.model_copy(update=of_recording)

    def variants_on(self, variants: Sequence[Variant], cell: Cell, out: Path) -> list[Variant]:
        """The variants with the map of a simulated drive, its place and heading; drift is drawn by the drive's seed."""
        if not self.maps:
            return [v for v in variants if v.name not in self.systems or self._of(cell.sequence, v.name)]
        start, heading_deg = start_on_earth(cell.path, cell.data_root) if cell.seed is None else _start_of(cell)
        place = {"origin": tuple(start.tolist()), "heading_deg": heading_deg}
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
        """Map file of a kind for a cell: exact, as simulated, given, or with random errors, which is written below `out`."""
        errors = self.maps[kind]
        if errors == MapKind():
            return cell.path / EXACT
        if errors.file:
            return Path(errors.file)
        if errors.is_as_simulated:
            return cell.path / PERTURBED
        path = out / MAPS / f"{cell.sequence}-{cell.seed}-{kind}.osm"
        origin = _world_of(cell)[1]
        exact = read_buildings(cell.path / EXACT, origin)[1].buildings
        none = {"simplify_share": 0.0, "merge_share": 0.0, "missing": 0.0, "new": 0.0}
        turn = float(np.radians(errors.house_deg))
        faults = MapFaults(errors.offset_m, 1.0, errors.house_m, 1.0, turn, **none)
        perturbation = draw_perturbation(exact, faults, np.random.default_rng(cell.seed))
        path.parent.mkdir(parents=True, exist_ok=True)
        write_osm(path, osm_from_buildings(perturb(exact, perturbation), origin, None))
        return path

    def beside(self, runs: Sequence[RunScore]) -> tuple[Table, ...]:
        """The tables of numbers, of what is stated and of what is measured only, of the runs that there are."""
        return self._numbers(runs), self._statements(runs), self._further(runs)

    def _numbers(self, runs: Sequence[RunScore]) -> Table:
        """Table of the thesis's numbers, ours, and the verdict on each."""
        rows = []
        for sequence, method in dict.fromkeys((run.sequence, run.method) for run in runs):
            printed = {of: value for of, value, _ in self._of(sequence, method)}
            ours = {of: list(_values(runs, sequence, method, QUANTITIES[of]).values()) for of in (*printed, *HARDNESS)}
            hardness = difficulty([(printed.get(of), ours[of]) for of in HARDNESS])
            limit = next((run.limit for run in runs if (run.sequence, run.method) == (sequence, method)), None)
            for of, number, source in self._of(sequence, method):
                judgement = judge_time(ours[of], limit) if of == "time" else judge_number(number, ours[of], hardness)
                theirs = (sequence, method, QUANTITIES[of].label, f"{number:g}")
                rows.append((*theirs, _median_and_worst(ours[of]), hardness, judgement.verdict, judgement.why, source))
        header = ("sequence", "method", "quantity", "thesis", "ours", "ours was", "verdict", "why", "source")
        recipe = (
            "ours: median / worst over seeds; reproduced: within a factor of two of a run; refuted: all runs are off to one side "
            "and ours was as hard by rms and maximum of the angular error; undecided otherwise; times are of another machine: "
            "they are judged by the limit alone"
        )
        return Table("beside the thesis, number by number", header, tuple(rows), recipe)

    def _further(self, runs: Sequence[RunScore]) -> Table:
        """Table of quantities for which the thesis prints no number."""
        rows = [
            (
                sequence,
                method,
                *(_median_and_worst(list(_values(runs, sequence, method, each).values())) for each in FURTHER),
            )
            for sequence, method in dict.fromkeys((run.sequence, run.method) for run in runs)
            if self.further
        ]
        header = ("sequence", "method", *(each.label for each in FURTHER))
        return Table("of which the thesis prints no number", header, tuple(rows), self.further)

    def _of(self, sequence: str, method: str) -> list[tuple[Of, float, str]]:
        """Numbers printed of a method on a drive, or on the clean twin of a hard one: quantity, number, source."""
        plain, system = sequence.removesuffix(HARD), method.split(ON)[0]
        return [(p.of, p.values[system], p.source) for p in self.numbers if p.sequence == plain and system in p.values]

    def _number(self, sequence: str, method: str, of: str) -> float | None:
        """Number printed for the quantity `of` of a method on a drive; None where none is printed."""
        return next((value for kind, value, _ in self._of(sequence, method) if kind == of), None)

    def _statements(self, runs: Sequence[RunScore]) -> Table:
        """Table of the thesis's orderings of methods, with the verdict by runs of equal seed."""
        rows = []
        scores = list(dict.fromkeys((run.sequence, run.method) for run in runs))
        for claim in self.claims:
            for sequence, method in scores:
                if method.split(ON)[0] != claim.left:
                    continue
                kind = method.removeprefix(claim.left)
                right = claim.right + kind if (sequence, claim.right + kind) in scores else claim.right
                a, b = (self._number(sequence, name, claim.of) for name in (method, right))
                if a is None or b is None or (sequence, right) not in scores:
                    continue
                ours, theirs = (_values(runs, sequence, name, QUANTITIES[claim.of]) for name in (method, right))
                pairs = [(ours[seed], theirs[seed]) for seed in ours if seed in theirs]
                judgement = judge_order(a < b, pairs)
                if claim.of == "time" and any(not r.is_timed_alone for r in runs if r.sequence == sequence):
                    judgement = Judgement("undecided", f"{judgement.why}; runs shared the machine")
                rows.append(
                    (claim.text, sequence + kind, f"{a / b:.2f}", judgement.verdict, judgement.why, claim.source)
                )
        header = ("the thesis", "drive", "its ratio", "verdict", "here", "source")
        recipe = (
            "stated: decided where all seeds say the same, five or more of them, by a twentieth or more in the median"
        )
        return Table("beside the thesis, system against system", header, tuple(rows), recipe)


def _world_of(cell: Cell) -> tuple[Floats, Floats]:
    """T_enu_world (4, 4) of a simulated drive, and latitude, longitude (deg) and height (m) of its origin."""
    world = parse_toml((cell.path / "truth" / "world.toml").read_text(encoding="utf-8"))
    return np.array(world["T_enu_world"]), np.array(world["origin_lat_lon_alt"])


def _start_of(cell: Cell) -> tuple[Floats, float]:
    """Latitude, longitude (deg), height (m) and heading (deg clockwise from north) of a simulated drive's first pose."""
    T_enu_world, origin = _world_of(cell)
    first = T_enu_world @ read_trajectory(cell.path / "truth" / "trajectory.tum").poses[0]
    return geodesy.from_local(first[None, :3, 3], origin)[0], 90.0 - float(np.degrees(se2.of_se3(first[None])[0, 2]))


def _values(runs: Sequence[RunScore], sequence: str, method: str, of: Quantity) -> dict[int, float]:
    """A quantity by seed; inf of a run that failed."""
    return {
        run.seed: of.of(run.values) if run.is_usable else inf
        for run in runs
        if (run.sequence, run.method) == (sequence, method)
    }


def _median_and_worst(values: Sequence[float]) -> str:
    """Median and worst value as text."""
    return " / ".join("failed" if value == inf else significant(value) for value in median_and_worst(values))


def comparison_names() -> tuple[str, ...]:
    """Names of the comparisons that ship with lslam."""
    return tuple(sorted(read_package_files("lslam.studies", "comparisons")))


def find_comparison(name: str) -> ReadyComparison:
    """The ready comparison of that name. Raises UsageError with the nearest name for what is none."""
    if name not in comparison_names():
        raise UsageError(f"no ready comparison {name!r}; {nearest(name, comparison_names())}")
    try:
        return ReadyComparison.model_validate(parse_toml(read_package_files("lslam.studies", "comparisons")[name]))
    except ValidationError as error:
        raise ConfigError(explain(error, f"comparison {name!r}")) from None
