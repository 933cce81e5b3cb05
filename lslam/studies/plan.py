"""Plan of a comparison, checked before anything runs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from lslam.core.errors import UsageError

if TYPE_CHECKING:
    from lslam.core.types.trajectory import Trajectory
    from lslam.studies.grid import Cell
    from lslam.studies.ready_comparison import ReadyComparison
    from lslam.studies.subjects import Subject
    from lslam.studies.variants import Variant

ONE_TRUTH = "--gt belongs to one recorded sequence: a scenario has its own, and several need one each"


@dataclass(frozen=True)
class Plan:
    """Sequences, methods and options of a comparison.

    truth : replaces the ground truth of the only sequence; jobs : runs at once, with more than one times cannot be compared
    crop : (x, y, size) of the map crop, m, None to choose; overwrite : run everything anew; resume : keep finished runs, go
        on with the others
    data_root : where the IMU of a KITTI odometry sequence is looked for
    ready : that ships with lslam, which this is
    """

    subjects: tuple[Subject, ...]
    variants: tuple[Variant, ...]
    seeds: tuple[int, ...]
    out: Path
    jobs: int = 1
    truth: Trajectory | None = None
    crop: tuple[float, float, float] | None = None
    overwrite: bool = False
    resume: bool = False
    data_root: Path | None = None
    command: str = ""
    ready: ReadyComparison | None = None

    def fitted(self, cell: Cell) -> Sequence[Variant]:
        """The variants as they run on the recording of a cell."""
        return self.variants if self.ready is None else self.ready.fitted(self.variants, cell, self.out)


def check_plan(plan: Plan) -> None:
    """Raise UsageError for a plan that cannot be run."""
    if not plan.variants:
        raise UsageError("no method is named")
    if not plan.subjects:
        raise UsageError("no sequence is named")
    check_numbers(plan.seeds, plan.jobs, plan.crop)
    if plan.truth is not None and (len(plan.subjects) > 1 or plan.subjects[0].scenario):
        raise UsageError(ONE_TRUTH)
    if plan.crop is not None and not all(v.config.map.write for v in plan.variants):
        raise UsageError("--crop needs maps, and map.write is off")


def check_numbers(seeds: Sequence[int], jobs: int, crop: tuple[float, float, float] | None) -> None:
    """Raise UsageError for numbers of a plan that are out of range."""
    if len(set(seeds)) < len(seeds) or not seeds or min(seeds) < 0:
        raise UsageError(f"--seeds {','.join(map(str, seeds))}: different whole numbers from 0, for example 0,1,2")
    if jobs < 1:
        raise UsageError(f"--jobs {jobs}: at least one run at a time")
    if crop is not None and not crop[2] > 0:
        raise UsageError(f"--crop: the size of {crop[2]:g} m must be above 0")
