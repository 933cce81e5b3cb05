"""What a person says of a run on its page: pairs of scans and control points, in two files that `lslam graph` reads.

And the process of `lslam graph` that makes a new run of them.
"""

from __future__ import annotations

import contextlib
import csv
import io
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from contextvars import copy_context
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from lslam.backend.keyframes.store import KeyframeStore, mounted_up
from lslam.backend.loops.find_loops import verify_pairs, view_pair
from lslam.backend.manual import keyframe_pairs, read_control_points, read_named_pairs, stamp_of
from lslam.core.errors import InputError, OutputError, OutputExistsError, UsageError, cause
from lslam.core.geometry.crs_names import crs_name, parse_crs
from lslam.core.types.constraint import Instant, NamedPair
from lslam.core.types.scan_result import ScanResult
from lslam.io.formats.atomic import write_text
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.pipeline.rebuild import read_run, results_of
from lslam.pipeline.run_folder import KEYFRAMES
from lslam.reports.page_data import judgement, pair_data

EDITS, POINTS = "edits.csv", "points.csv"
MOST_POINTS = 12_000  # points of a scan's surroundings on the page, at most
MOST_LINES = 30  # lines of the child that are kept
PATIENCE_S = 20.0  # for a child that was asked to stop


class Pair(BaseModel):
    """A row of edits.csv."""

    model_config = ConfigDict(extra="forbid")
    scan_a: int = Field(ge=0)
    scan_b: int = Field(ge=0)
    verdict: Literal["known", "forbidden"]
    x_m: FiniteFloat = 0.0
    y_m: FiniteFloat = 0.0
    within_m: FiniteFloat | None = Field(None, gt=0)


class Point(BaseModel):
    """A row of points.csv."""

    model_config = ConfigDict(extra="forbid")
    scan: int = Field(ge=0)
    x: FiniteFloat
    y: FiniteFloat
    z: FiniteFloat
    sigma: FiniteFloat = Field(gt=0)
    crs: str
    sigma_z: FiniteFloat | None = Field(None, gt=0)
    lidar_x: FiniteFloat = 0.0
    lidar_y: FiniteFloat = 0.0
    lidar_z: FiniteFloat = 0.0


class Edits(BaseModel):
    """All corrections of a run."""

    model_config = ConfigDict(extra="forbid")
    pairs: list[Pair] = Field(max_length=5000)
    points: list[Point] = Field(max_length=5000)


class Corrections:
    """Corrections of a run that a person enters on its page, and views of its scans registered on each other.

    Raises InputError for a run that cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.run = read_run(folder)
        self._results = results_of(self.run)
        self._lock = threading.Lock()

    @cached_property
    def _store(self) -> KeyframeStore:
        """Keyframes of the run at odometry's poses, as loop search used them; raises InputError when the run kept none."""
        store = KeyframeStore(self.folder / KEYFRAMES)
        if not len(store):
            raise InputError(f"{self.folder} kept no keyframes: run the sequence again, with its loops")
        path = self.folder / "trajectory_odometry.tum"
        if path.is_file():  # where the loops were looked for
            odometry = read_trajectory(path, "tum")
            poses = dict(zip(odometry.stamps_ns.tolist(), odometry.poses, strict=True))
            store.keyframes = [
                replace(k, T_world_lidar=poses.get(k.stamp_ns, k.T_world_lidar)) for k in store.keyframes
            ]
        return store

    def edits(self, words: object = None) -> dict[str, Any]:
        """The present corrections: those of the run folder, else those that its graph was made with; `words` is ignored."""
        config, pairs, points = self.run.config, [], []
        if path := self._before(EDITS, config.loops.file):
            for pair in read_named_pairs(path):
                scans = {"scan_a": self._scan(pair.first), "scan_b": self._scan(pair.second)}
                place = dict(zip(("x_m", "y_m"), pair.place.tolist(), strict=True))
                pairs.append(Pair(**scans, **place, verdict=pair.verdict, within_m=pair.within))
        if path := self._before(POINTS, config.graph.control):
            for point in read_control_points(path):
                values = dict(zip("xyz", point.position.tolist(), strict=True))
                seen = dict(zip(("lidar_x", "lidar_y", "lidar_z"), point.point_lidar.tolist(), strict=True))
                crs, sigmas = crs_name(point.epsg, point.height_epsg), point.sigma.tolist()
                spread = {"sigma": sigmas[0], "sigma_z": sigmas[2] if sigmas[2] != sigmas[0] else None}
                points.append(Point(scan=self._scan(point.at), crs=crs, **values, **spread, **seen))
        return Edits(pairs=pairs, points=points).model_dump()

    def save(self, document: Any) -> dict[str, Any]:
        """Validate and write both files, none without rows; returns their numbers of rows. UsageError if invalid, OutputError."""
        try:
            edits = Edits.model_validate(document)
            for point in edits.points:
                parse_crs(point.crs)
        except ValidationError as error:
            first = error.errors()[0]
            raise UsageError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None
        known = {result.index for result in self._results}
        for scan in [*(n for pair in edits.pairs for n in (pair.scan_a, pair.scan_b)), *(p.scan for p in edits.points)]:
            if scan not in known:
                raise UsageError(f"scan {scan} is none of the run's, which are {min(known)} to {max(known)}")
        with self._lock:
            _write(self.folder / EDITS, Pair, edits.pairs)
            _write(self.folder / POINTS, Point, edits.points)
        return {"pairs": len(edits.pairs), "points": len(edits.points)}

    def arguments(self) -> list[str]:
        """Command-line arguments for `lslam graph` that name the existing files. Raises UsageError without any."""
        flags = {"--loops": self.folder / EDITS, "--control": self.folder / POINTS}
        words = [word for flag, path in flags.items() if path.is_file() for word in (flag, str(path))]
        if not words:
            raise UsageError("nothing was corrected: say known or forbidden of a pair, or give a point its coordinates")
        return words

    def pair(self, words: Mapping[str, str]) -> dict[str, Any]:
        """Register two scans, numbers `a` and `b` in `words`, as `lslam graph` registers a known pair; their view and verdict.

        Raises UsageError where they are not of the run, or share one keyframe.
        """
        numbers = [self._result(words.get(name, "")).index for name in "ab"]
        older, newer = (Instant(f"scan {number}", scan=number) for number in numbers)
        named = NamedPair(older, newer, "known")
        store, config = self._store, self.run.config
        with self._lock:  # one at a time: each takes a core
            found = keyframe_pairs([named], self._results, store.keyframes)
            if not found.known:
                raise UsageError(
                    f"scans {numbers[0]} and {numbers[1]} belong to one keyframe: choose two that lie apart"
                )
            known = found.known[0]
            poses = np.stack([k.T_world_lidar for k in store.keyframes])
            size = config.keyframes.submap_size
            up = mounted_up(store, poses, config.preprocess)
            (candidate,) = verify_pairs(store, [known], config.loops, config.registration, size, up=up)
            at = {result.stamp_ns: k for k, result in enumerate(self._results)}
            scans = [at[store.keyframes[k].stamp_ns] for k in (known.a, known.b)]
            T = self.run.trajectory.poses[scans[0]]
            view = view_pair(store, candidate, T, size, MOST_POINTS)
        return {**pair_data(view), "scans": [self._results[k].index for k in scans], **judgement(candidate)}

    def _before(self, name: str, other: str) -> Path | None:
        """File `name` of the run folder, else the file `other`; None if neither exists."""
        path = self.folder / name
        if path.is_file():
            return path
        return Path(other) if other and Path(other).is_file() else None

    def _scan(self, instant: Instant) -> int:
        """The number of the scan nearest to an instant. Raises InputError for one that the run does not have."""
        if instant.scan is not None:
            return self._result(str(instant.scan)).index
        stamps = np.array([result.stamp_ns for result in self._results])
        return self._results[int(np.abs(stamps - stamp_of(instant, self._results)).argmin())].index

    def _result(self, text: str) -> ScanResult:
        """Result of the scan with the number in `text`. Raises UsageError without one."""
        known = {str(result.index): result for result in self._results}
        if text not in known:
            raise UsageError(f"scan {text or '?'} is none of the run's, which are {min(known)} to {max(known)}")
        return known[text]


def _write(path: Path, kind: type[BaseModel], rows: Sequence[BaseModel]) -> None:
    """Write the rows as CSV; optional columns are included only if used. Without rows the file is removed."""
    if not rows:
        path.unlink(missing_ok=True)
        return
    names = [name for name, about in kind.model_fields.items() if about.is_required()]
    if any(set(row.model_dump(exclude_defaults=True)) - set(names) for row in rows):
        names = list(kind.model_fields)
    text = io.StringIO()
    table = csv.DictWriter(text, names, extrasaction="ignore", lineterminator="\n")
    table.writeheader()
    table.writerows(row.model_dump() for row in rows)
    write_text(path, text.getvalue())


class GraphJob:
    """Child process of `lslam graph`, with the arguments `words` after the run; `out` is its new folder."""

    def __init__(self, run: Path, words: list[str]) -> None:
        """Start the process. Raises OutputError when that fails."""
        self.out = next_folder(run)
        command = [sys.executable, "-m", "lslam", "graph", str(run), *words, "--out", str(self.out)]
        self._is_asked = False
        self._said: deque[str] = deque(maxlen=MOST_LINES)
        try:
            self._child = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                errors="replace",
                start_new_session=True,  # what the terminal sends comes from the server alone
            )
        except OSError as error:
            raise OutputError(f"lslam graph cannot be started: {cause(error)}") from None
        self._reader = threading.Thread(target=copy_context().run, args=(self._read,), name="lslam-graph", daemon=True)
        self._reader.start()

    @property
    def is_running(self) -> bool:
        """Whether it is not over."""
        return self._child.poll() is None

    def state(self) -> dict[str, Any]:
        """State of the child (`running`, `done`, `stopped` or `failed`), its folder, and its last lines of output."""
        code = self._child.poll()
        if code is not None:
            self._reader.join(PATIENCE_S)
        # Asked before it heeds signals, it dies of one.
        word = "running" if code is None else "done" if code == 0 else "stopped" if self._is_asked else "failed"
        return {"state": word, "out": self.out.name, "said": list(self._said)}

    def stop(self) -> None:
        """Terminate the child (SIGTERM), and kill it if it does not end in time."""
        if self.is_running:
            self._is_asked = True
            self._child.terminate()
            try:
                self._child.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                self._child.kill()
                self._child.wait()

    def _read(self) -> None:
        """Collect the child's lines of output, in a thread."""
        assert self._child.stderr is not None
        with contextlib.suppress(ValueError):
            for line in self._child.stderr:
                self._said.append(line.rstrip().removeprefix("INFO: "))


def next_folder(run: Path) -> Path:
    """RUN-graph beside the run, or the first of RUN-graph-2, ... that is free. Raises OutputExistsError when none is free."""
    named = run.resolve()
    for number in range(1, 1000):
        folder = named.with_name(f"{named.name}-graph" + (f"-{number}" if number > 1 else ""))
        if not folder.exists():
            return folder
    raise OutputExistsError(f"{named}-graph to {named}-graph-999 exist: remove some of them")
