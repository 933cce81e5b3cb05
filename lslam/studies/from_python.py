"""Comparison of methods from Python, like `lslam compare`."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from lslam.core.types.comparison import Comparison
from lslam.reports import compare_table
from lslam.reports.picture import as_html
from lslam.studies import compare as compared
from lslam.studies.output import COMPARISON, require_free
from lslam.studies.plan import Plan
from lslam.studies.subjects import find_subjects
from lslam.studies.variants import Imu, find_variants


@dataclass(frozen=True)
class Compared:
    """Result of `compare`: all numbers, and the folder of the runs with the page `compare.html`."""

    comparison: Comparison
    folder: Path

    def table(self, style: str = "text") -> str:
        """Tables as `text`, `md`, `csv` (a row per run) or `tex`."""
        return compare_table.render(self.comparison, style)

    def __str__(self) -> str:
        """Tables as text."""
        return self.table()

    def _repr_html_(self) -> str:
        return as_html(self.table())


def compare(
    sequences: Iterable[str | Path],
    methods: Iterable[str],
    *,
    seeds: Iterable[int] = (0,),
    out: str | Path | None = None,
    jobs: int = 1,
    imu: Imu | None = None,
    settings: Iterable[str] = (),
    overwrite: bool = False,
    resume: bool = False,
) -> Compared:
    """Run methods on the same sequences, and weigh them against each other.

    Parameters
    ----------
    sequences : recordings as `open_sequence` takes them, or names of scenarios, which are simulated once per seed
    methods : names of methods or presets, or TOML files; the first is the reference
    out : folder of all runs (default: runs/compare-TIME); jobs : runs at once, times are comparable with one only
    imu : `both` makes two of each, `on` and `off` one; settings : "map.voxel=0.1", of all runs

    Raises
    ------
    UsageError, InputError and OutputError as the command does.

    Notes
    -----
    Runs are processes of their own: in a script call it below ``if __name__ == "__main__":``.
    """
    folder = Path(out) if out is not None else Path("runs") / time.strftime("compare-%Y%m%d-%H%M%S")
    require_free(folder, COMPARISON, "comparison", overwrite, resume)
    plan = Plan(
        subjects=tuple(find_subjects([str(sequence) for sequence in sequences])),
        variants=tuple(find_variants(list(methods), None, list(settings), imu)),
        seeds=tuple(seeds),
        out=folder,
        jobs=jobs,
        overwrite=overwrite,
        resume=resume,
        command="lslam.compare",
    )
    return Compared(compared.compare(plan), folder)
