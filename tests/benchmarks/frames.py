"""Frames of lslam on the stack between `lslam run` and the normal equations of a scan.

    python tests/benchmarks/frames.py [icp loam fast-lio2]

The stack is that of the last scan, and of the first, which is registered again on the map of later ones; calls before may be
of kernels that are warmed up.
"""

from __future__ import annotations

import contextlib
import io
import sys
import tempfile
from pathlib import Path
from types import FrameType

import lslam
from lslam.cli.main import main as lslam_main
from lslam.odometry.frontend.windows import first_pose
from lslam.registration.optimiser import optimise

PACKAGE = Path(lslam.__file__).parent
SAMPLE = PACKAGE.parent / "sample_data"
# Nothing but the registration of scans enters the optimiser.
ALONE = ["--no-loops", "--set", "odometry.integrity=false", "--set", "map.write=false", "--set", "report.html=false"]
LOOK_BACK = first_pose.__code__


def last_stacks(words: list[str]) -> dict[str, list[str]]:
    """`file:function` of the frames of lslam, outermost first, when its main thread last entered the optimiser."""
    last: dict[str, list[str]] = {}

    def look(frame: FrameType | None, event: str, _: object) -> None:
        if event != "call" or frame is None or frame.f_code is not optimise.__code__:
            return
        stack, which = [], "the last scan"
        while frame is not None:
            path = Path(frame.f_code.co_filename)
            if path.is_relative_to(PACKAGE):
                stack.insert(0, f"{path.relative_to(PACKAGE)}:{frame.f_code.co_qualname}")
            if frame.f_code is LOOK_BACK:
                which = "the first scan"
            frame = frame.f_back
        last[which] = stack

    sys.argv = ["lslam", *words]
    sys.setprofile(look)
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        lslam_main()
    sys.setprofile(None)
    return last


def main() -> None:
    for method in sys.argv[1:] or ["icp", "loam", "fast-lio2"]:
        with tempfile.TemporaryDirectory() as out:
            words = ["run", str(SAMPLE), "--out", f"{out}/run", "--method", method, "--imu", "--count", "30", "--quiet"]
            last = last_stacks([*words, *ALONE])
        for which, stack in last.items():
            print(f"{method}, {which}: {len(stack)} frames", *stack, sep="\n  ")


if __name__ == "__main__":
    main()
