"""A sensitivity study: every method at every point of its parameters on every sequence and seed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from lslam.config.study import StudyConfig
from lslam.errors import RunFailedError
from lslam.printable import toml_text
from lslam.studies.engines import Engine
from lslam.studies.expanded import Expanded, Place, cells_of, check_same, make_runs
from lslam.studies.grid import expand
from lslam.studies.plan import Follow
from lslam.studies.points import contenders
from lslam.types.study import StudyRow

# The study as it was resolved; it makes the folder one of a study.
MARK = "study.toml"


@dataclass(frozen=True)
class Sweep:
    """What is to be studied where; settings : "a.b=v" over what the study says."""

    study: StudyConfig
    place: Place
    settings: tuple[str, ...] = ()


def expand_study(sweep: Sweep) -> Expanded:
    """All runs, checked before any begins; nothing is simulated or written.

    Raises ConfigError, UsageError or InputError for parameters, methods, recordings and scenarios that make no sense;
    OutputExistsError when it is to go on in the folder of another study.
    """
    study, place = sweep.study, sweep.place
    text = toml_text(study.model_dump(mode="json", exclude_none=True, exclude_defaults=True))
    check_same(place, MARK, "study", text, lambda tree: [str(tree.get("name"))])
    found = contenders(study, sweep.settings)
    cells = cells_of(study.sequences, study.seeds, found, place, sweep.settings)
    jobs = expand(cells, [c.variant for c in found], study.seeds, place.out, place.command)
    return Expanded(study.name, "study", MARK, text, jobs, {c.variant.name: c for c in found})


def run_sweep(
    sweep: Sweep,
    engine: Engine,
    follow: Follow | None = None,
    on_rows: Callable[[Sequence[StudyRow]], None] = lambda rows: None,
) -> list[StudyRow]:
    """Make every run of the study, as `make_runs`.

    Raises what `expand_study` and `make_runs` raise, and RunFailedError when all runs failed.
    """
    rows = make_runs(expand_study(sweep), sweep.place, engine, follow, on_rows)
    if rows and not any(row.is_usable for row in rows):
        raise RunFailedError(f"all {len(rows)} runs failed, the first one: {rows[0].reason}")
    return rows
