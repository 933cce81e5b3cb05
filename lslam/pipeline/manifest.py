"""manifest.json: input, decisions, outcome and cost of a run."""

from __future__ import annotations

import hashlib
import platform
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from copy import copy
from dataclasses import asdict
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import perf_counter
from typing import Any

from lslam.core import __version__
from lslam.core.config import Config
from lslam.core.errors import InterruptedRunError
from lslam.core.extras import plugin_versions
from lslam.core.stopping import is_interrupt
from lslam.core.types.run_record import RunRecord
from lslam.core.types.scan import Span
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import Sequence
from lslam.core.types.warned import Warnings
from lslam.maps.colour import ColourCounts
from lslam.reports.facts import describe

SCHEMA = 1
# Share of the scans that may leave a direction open before the run counts as degraded.
MOST_DEGENERATE = 0.1
# Those whose version may change a byte of a result.
LIBRARIES = ("numpy", "numba", "llvmlite", "scipy", "gtsam", "kiss-icp", "shapely", "pyproj", "laspy", "lazrs")


class Manifest:
    """Facts collected during a run; `as_dict` gives the content of the file at any moment.

    outcome : done, degraded (a scan was bridged or skipped, or input was dropped, replaced or refused), diverged or
        interrupted
    reading : options besides its path that the sequence was opened with: topics, extrinsics
    truth_file : of ground truth that replaces the recording's own
    unscored : reason why existing ground truth gave no score, else empty
    deskew : treatment of the motion within a scan, `describe_deskew`
    pose_time : where in a sweep the stamps of scans lie, to which poses belong: scan_start, scan_middle or scan_end
    world : where the coordinates begin and whether z is up
    imu, wheels : their use, empty without `--imu` and `--wheels`; keyframes : their number and size
    graph, georeference : results of the back end and position on the Earth, empty without
    refinement : reduction of the planes' thickness, empty without refinement
    localization : how the drive was found in a prior map and how many scans were registered on it, empty without one
    identity : digests that a run and its resumption share; resumed_after_scans : number of scans at each resumption
    posed_by : number of scans by source of their pose: the method, a fallback, the motion prior
    segments : of a run that lost its map on the way, each with its connection to the others
    integrity : numbers of pairs of scans that checked the motion independently, of conclusive ones, and of alerts
    problems : faults of this run, in addition to those of the recording; warnings : those of its log, listed after them, without
        effect on the outcome
    last : final content of the file
    """

    def __init__(self, command: str, sequence: Sequence, config: Config) -> None:
        self.command, self.sequence, self.config = command, sequence, config
        self.deskew = self.world = "not decided yet"
        self.pose_time = Span().instant
        self.started = datetime.now(UTC)
        self.reading: dict[str, str] = {}
        self.truth_file = ""
        self.timings: dict[str, float] = {}
        self.problems: list[str] = []
        self.unscored = ""
        self.warnings = Warnings()
        self.counts: dict[str, int] = {}
        self.posed_by: dict[str, int] = {}
        self.integrity: dict[str, int] = {}
        self.segments: list[dict[str, Any]] = []
        self.map_points: int | None = None
        self.map_colour: ColourCounts | None = None
        self.imu: dict[str, Any] = {}
        self.wheels: dict[str, Any] = {}
        self.keyframes: dict[str, Any] = {}
        self.graph: dict[str, Any] = {}
        self.refinement: dict[str, Any] = {}
        self.georeference: dict[str, Any] = {}
        self.localization: dict[str, Any] = {}
        self.identity: dict[str, str] = {}
        self.resumed_after_scans: list[int] = []
        self.last: dict[str, Any] = {}
        self._ended = ""

    @property
    def outcome(self) -> str:
        """Outcome of the run if nothing else goes wrong."""
        return self._ended or ("degraded" if self.problems or self.sequence.problems else "done")

    @contextmanager
    def time(self, name: str) -> Iterator[None]:
        """Context that adds the duration of its block, s, to the timings."""
        began = perf_counter()
        try:
            yield
        finally:
            self.timings[name] = self.timings.get(name, 0.0) + perf_counter() - began

    def judge(self, results: list[ScanResult], scans: int, diverges: bool) -> None:
        """Count the results of the `scans` and derive the outcome of the run; diverges : whether its odometry did."""
        self.counts = {"scans": len(results)} | {
            status: sum(r.status == status for r in results) for status in ("ok", "bridged", "skipped")
        }
        self.counts["standing"] = sum(r.is_stationary for r in results)
        self.counts["degenerate"] = sum(len(r.degenerate) > 0 for r in results)
        self.counts["fallback"] = sum(r.status == "ok" and bool(r.posed_by) for r in results)
        self.posed_by = dict(Counter(r.poser(self.config.odometry.method) for r in results))
        self._judge_degenerate(results)
        bad = [r for r in results if r.status != "ok"]
        if bad:
            self.problems.append(
                f"{len(bad)} of {len(results)} scans were not registered, their poses are interpolated or predicted, "
                f"the first is scan {bad[0].index}: {bad[0].reason}"
            )
        if diverges:
            self._ended = "diverged"
        elif len(results) < scans:
            self.interrupt(f"interrupted after {len(results)} of {scans} scans")

    def _judge_degenerate(self, results: list[ScanResult]) -> None:
        """Add a problem if many scans leave a direction unobservable: there the motion prior drifts."""
        weak = [r for r in results if len(r.degenerate)]
        if len(weak) > MOST_DEGENERATE * len(results):
            self.problems.append(
                f"{len(weak)} of {len(results)} scans left a direction open, which the motion prior decided, "
                f"the first is scan {weak[0].index}: {describe(weak[0].degenerate)}"
            )

    def take_over(self, record: RunRecord) -> None:
        """Add the problems of the record, and the reason why known ground truth gave no score."""
        self.problems += record.problems
        self.unscored = record.no_score_reason

    def interrupt(self, where: str) -> None:
        """Mark the run as ended early by request."""
        self._ended = "interrupted"
        # What ended the run is said before what was noticed on the way.
        self.problems.insert(0, where)

    def word_for(self, error: BaseException) -> str:
        """Status of a run that ended with `error`."""
        return "interrupted" if isinstance(error, InterruptedRunError) or is_interrupt(error) else "failed"

    def conclude(self) -> dict[str, Any]:
        """Manifest of the finished run, kept as `last`."""
        self.last = self.as_dict(self.outcome)
        return self.last

    def as_dict(self, status: str, why: str = "") -> dict[str, Any]:
        """Manifest as plain values."""
        s = self.sequence
        problems = [*s.problems, *self.problems]
        has_camera = s.calibration.T_cam0_lidar is not None
        return {
            "schema": SCHEMA,
            "status": status,
            **({"why": why} if why else {}),
            "problems": [*problems, *self.warnings.beyond([*problems, why])],
            **({"unscored": self.unscored} if self.unscored else {}),
            "command": self.command,
            "lslam": __version__,
            **({"ground_truth": self.truth_file} if self.truth_file else {}),
            **self._sections("identity"),
            "method": self.config.odometry.method,
            "sequence": {
                "name": s.name,
                "path": str(s.path),
                "format": s.kind,
                **({"reading": self.reading} if self.reading else {}),
                "scans": len(s),
                "rate_hz": s.rate_hz,
                "motion_compensated": s.motion_compensated,
                **({"point_times": choice.facts()} if (choice := getattr(s, "clock_choice", None)) is not None else {}),
                "decisions": list(s.notes),
                "problems": list(s.problems),
            },
            "frames": {
                "world": self.world,
                "trajectory.tum": "T_world_lidar",
                "trajectory_kitti.txt": "camera 0 (Tr is known)" if has_camera else "LiDAR (no Tr is known)",
                "pose_time": self.pose_time,
                "deskew": self.deskew,
                "covariances.npz": "covariances: of the poses in the world; registration: against the local map (NaN: none); "
                "both (N, 6, 6) of t' = t + d[:3], R' = exp(d[3:]) R in world axes, m2 and rad2",
            },
            **self._sections("imu", "wheels"),
            "counts": dict(self.counts),
            **self._sections(
                "posed_by", "integrity", "segments", "resumed_after_scans", "keyframes", "graph", "refinement"
            ),
            **self._sections("georeference", "localization"),
            **({"map_points": self.map_points} if self.map_points is not None else {}),
            **({"map_colour": asdict(self.map_colour)} if self.map_colour is not None else {}),
            "timings": {name: round(seconds, 3) for name, seconds in self.timings.items()},
            "peak_memory_mb": peak_memory_mb(),
            "started": self.started.isoformat(timespec="seconds"),
            "written": datetime.now(UTC).isoformat(timespec="seconds"),
            "machine": machine_facts(),
        }

    def _sections(self, *names: str) -> dict[str, Any]:
        """Copies of the sections that are set."""
        return {name: copy(value) for name in names if (value := getattr(self, name))}


def machine_facts() -> dict[str, str | None]:
    """Python, system, a digest of lslam's own code, versions of libraries, None where not installed, and of plug-ins."""
    return {
        "code": _code_digest(),
        "python": sys.version.split()[0],
        "platform": platform.platform(),
        **{name: _version(name) for name in LIBRARIES},
        **plugin_versions(),
    }


def describe_deskew(sequence: Sequence, config: Config, has_times: bool, how: str) -> tuple[str, bool]:
    """Treatment of the motion within a scan, in words, and whether distortion remains.

    has_times : whether the scans have per-point times; how : how the method deskews, in words, empty when it does not
    """
    if sequence.motion_compensated:
        return "none needed: the scans are motion compensated", False
    why = "is not known to be" if sequence.motion_compensated is None else "is not"
    if not has_times:
        return f"no deskew: the recording {why} motion compensated, and its points have no times", True
    if not config.preprocess.deskew:
        return "no deskew: preprocess.deskew is off", True
    return (how, False) if how else (f"no deskew: {config.odometry.method} takes each scan as one instant", True)


def peak_memory_mb() -> float | None:
    """Largest resident memory of this process so far, MB; None where the system does not report it."""
    # Linux's rusage begins with what the process had that started this one.
    with suppress(OSError, ValueError):
        lines = Path("/proc/self/status").read_text().splitlines()
        (peak_kb,) = [line.split()[1] for line in lines if line.startswith("VmHWM:")]
        return round(int(peak_kb) * 1024 / 1e6, 1)
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (1e6 if sys.platform == "darwin" else 1e3), 1)


@cache
def _code_digest() -> str:
    """Digest of the source files of lslam."""
    digest, package = hashlib.sha256(), Path(__file__).parents[1]
    for path in sorted(package.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:12]


@cache
def _version(name: str) -> str | None:
    """Version of an installed package; None where it is missing."""
    try:
        return version(name)
    except PackageNotFoundError:
        return None
