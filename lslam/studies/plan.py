"""What is to be compared, checked before anything runs, and the folder a study of any kind is written to."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lslam.errors import OutputError, OutputExistsError, UsageError, cause
from lslam.studies.subjects import Subject
from lslam.studies.variants import Variant
from lslam.types.trajectory import Trajectory

RESULT = "compare.json"
SIMULATED = "simulated"
ONE_TRUTH = "--gt belongs to one recorded sequence: a scenario has its own, and several need one each"


@dataclass(frozen=True)
class Follow:
    """How a caller follows a study: on_start(stage, number of steps, unit), then on_step(note) per step."""

    on_start: Callable[[str, int, str], None] = lambda stage, total, unit: None
    on_step: Callable[[str], None] = lambda note: None


@dataclass(frozen=True)
class Plan:
    """What is to be compared.

    truth : replaces the ground truth of the only sequence; jobs : runs at once, with more than one times cannot be compared
    crop : (x, y, size) of the map crop, m, None to choose; overwrite : run everything anew; resume : keep finished runs, go
        on with the others
    data_root : where the IMU of a KITTI odometry sequence is looked for
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


def check_plan(plan: Plan) -> None:
    """Raise UsageError for what cannot be compared."""
    if not plan.variants:
        raise UsageError("no method is named")
    if not plan.subjects:
        raise UsageError("no sequence is named")
    if len(set(plan.seeds)) < len(plan.seeds) or not plan.seeds or min(plan.seeds) < 0:
        raise UsageError(f"--seeds {','.join(map(str, plan.seeds))}: different whole numbers from 0, for example 0,1,2")
    if plan.jobs < 1:
        raise UsageError(f"--jobs {plan.jobs}: at least one run at a time")
    if plan.truth is not None and (len(plan.subjects) > 1 or plan.subjects[0].scenario):
        raise UsageError(ONE_TRUTH)
    if plan.crop is not None and not plan.crop[2] > 0:
        raise UsageError(f"--crop: the size of {plan.crop[2]:g} m must be above 0")
    if plan.crop is not None and not all(v.config.map.write for v in plan.variants):
        raise UsageError("--crop needs maps, and map.write is off")


def claim(out: Path, mark: str, what: str, overwrite: bool, resume: bool) -> None:
    """Take the output folder, or say why not; the file `mark` tells `what` it is, and is the caller's to write.

    Raises OutputExistsError for a file, a folder of something else, or one that holds runs and neither `overwrite` nor `resume`
    is set; OutputError when it cannot be used.
    """
    if overwrite and resume:
        raise UsageError("--overwrite runs everything anew and --resume keeps what is finished: give one of them")
    if out.exists() and not out.is_dir():
        raise OutputExistsError(f"output {out} is a file; name a folder with --out")
    try:
        has_something = out.is_dir() and any(out.iterdir())
        if has_something and not (out / mark).is_file():
            raise OutputExistsError(f"output folder {out} is not a {what} of lslam; name another with --out")
        if has_something and not (overwrite or resume):
            raise OutputExistsError(
                f"output folder {out} exists; --resume keeps its finished runs, --overwrite runs all anew, or name "
                "another with --out"
            )
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"output folder {out} cannot be used: {cause(error)}") from None


def release(out: Path, mark: str) -> None:
    """Leave nothing behind when nothing was begun, so that the command can be given again."""
    with contextlib.suppress(OSError):
        inside = [path.name for path in out.iterdir()]
        if inside == [mark]:
            (out / mark).unlink()
            out.rmdir()
