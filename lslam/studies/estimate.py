"""Duration of a study, estimated from its finished runs, or from short pilot runs at a few points of its parameters."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.errors import RunFailedError
from lslam.core.printable import lasting
from lslam.io.readers import open_sequence
from lslam.studies.grid import Job
from lslam.studies.jobs import Local
from lslam.studies.results import Results
from lslam.studies.results_csv import FINAL, read_state
from lslam.studies.runner import StudyProgress
from lslam.studies.study_runs import write_study_report
from lslam.studies.subjects import drive_of, scans_of_run, simulate_once
from lslam.studies.variants import Variant

# Scans of the shorter and the longer pilot: what they differ by is what scans cost, the rest what a run costs by itself.
_SHORT, _LONG = 12, 36
# Scans of a recording that are simulated for pilots from the first one used, at most.
_MOST_SCANS = 160


@dataclass(frozen=True)
class Guess:
    """Estimated seconds of everything, of which `around_s` before and after the runs; pilots : runs behind it."""

    seconds: float
    pilots: int
    around_s: float = 0.0

    @property
    def text(self) -> str:
        """Text of the estimate."""
        return lasting(self.seconds)


@dataclass(frozen=True)
class _PilotRecording:
    """Recording for pilots; `whole` : scans of the study's recording; simulation_s : time to simulate all its scans, s."""

    path: Path
    scans: int
    whole: int
    simulation_s: float


@dataclass(frozen=True)
class _Pilot:
    """Pilot run of the first `scans` used scans of a recording."""

    job: Job
    scans: int


@dataclass(frozen=True)
class _Group:
    """Runs that differ only in parameters and seeds.

    names : of their variants; X : (names, K) where they lie; at : those with pilots; pilots : a short and a long one each
    """

    members: list[Job]
    recording: _PilotRecording
    names: list[str]
    X: Floats
    at: list[int]
    pilots: list[list[_Pilot]]


def extrapolate(jobs: Sequence[Job], rest: Sequence[Job], variants: dict[str, Variant], at_once: int) -> Guess | None:
    """Time for the `rest` of a study's `jobs`, s, `at_once` in parallel, from times of finished runs; None without any.

    A run is expected to last as long as the mean of its sequence and method, or of all runs where none of these is finished.
    """
    seconds: dict[object, list[float]] = {}
    for job in jobs:
        state = read_state(job.state_file)
        if state is not None and state.status in FINAL and state.digest == job.digest:
            seconds.setdefault(_kind(job, variants), []).append(state.seconds)
    every = [one for group in seconds.values() for one in group]
    if not every:
        return None
    return Guess(sum(float(np.mean(seconds.get(_kind(job, variants), every))) for job in rest) / at_once, 0)


def estimate(
    jobs: Sequence[Job],
    variants: dict[str, Variant],
    at_once: int,
    progress: StudyProgress | None = None,
    own_s: float = 0.0,
) -> Guess:
    """Time for `jobs` with `at_once` together; pilots and their report go to a temporary folder.

    own_s : time of the caller until here, s, which recurs in the study

    Raises RunFailedError naming a pilot that fails, and the errors of simulating.
    """
    progress = progress or StudyProgress()
    seconds, warming_s, start_s = 0.0, 0.0, 0.0
    pilots: list[Job] = []
    with tempfile.TemporaryDirectory(prefix="lslam-pilots-") as folder:
        places = _places(jobs, Path(folder), progress)
        groups = [_group(members, places[members[0].sequence], variants) for members in _groups(jobs, variants)]
        # Kernels are kept on disk once compiled: the study will find those that these runs compile.
        _run([group.pilots[0][0] for group in groups], Path(folder) / "compile", progress)
        for number, group in enumerate(groups):
            began = time.monotonic()
            first = [group.pilots[0][1], *(pilot for pair in group.pilots for pilot in pair)]
            run, times = _run(first, Path(folder) / str(number), progress)
            start_s = max(start_s, time.monotonic() - began - sum(times))
            pilots += run
            warming_s += max(times[0] - times[2], 0.0)
            seconds += _seconds(group, *_costs(group.pilots, times[1:]))
        simulation_s = sum(places[job.sequence].simulation_s for job in _to_simulate(jobs))
        report_s = _report_s(Path(folder), pilots, variants)
    # One simulation already keeps two cores busy.
    simulation_s /= max(1, at_once // 2)
    around_s = own_s + start_s + report_s
    return Guess(around_s + simulation_s + warming_s + seconds / at_once, len(pilots), around_s)


def _group(members: list[Job], recording: _PilotRecording, variants: dict[str, Variant]) -> _Group:
    """Group of runs with its pilots."""
    names = list(dict.fromkeys(job.method for job in members))
    first = {job.method: job for job in members}
    X = _coordinates([variants[name] for name in names])
    at = _pilot_points(X)
    return _Group(members, recording, names, X, at, [_pilots(first[names[k]], recording) for k in at])


def _seconds(group: _Group, base: Floats, per_scan: Floats) -> float:
    """Time for all runs of the group, s, extrapolated from its pilots."""
    first = {job.method: job for job in group.members}
    seconds = 0.0
    for name, cost in zip(group.names, _interpolate(group.X, group.X[group.at], base, per_scan), strict=True):
        scans = scans_of_run(group.recording.whole, first[name].config.input)
        seconds += sum(job.method == name for job in group.members) * float(cost[0] + cost[1] * scans)
    return seconds


def _groups(jobs: Sequence[Job], variants: dict[str, Variant]) -> list[list[Job]]:
    """Groups of runs that differ only in parameters and seeds."""
    groups: dict[object, list[Job]] = {}
    for job in jobs:
        groups.setdefault(_kind(job, variants), []).append(job)
    return list(groups.values())


def _kind(job: Job, variants: dict[str, Variant]) -> object:
    """Key of a run's group: everything but parameters and seeds."""
    c = variants[job.method]
    return job.sequence, c.method, c.uses_imu, c.is_beside


def _to_simulate(jobs: Sequence[Job]) -> list[Job]:
    """One job per scene that is not simulated yet."""
    return list({job.path: job for job in jobs if job.scene is not None and not job.path.is_dir()}.values())


def _places(jobs: Sequence[Job], folder: Path, progress: StudyProgress) -> dict[str, _PilotRecording]:
    """Recordings for pilot runs by sequence, simulated in `folder` where missing, with the seconds of a whole simulation."""
    places: dict[str, _PilotRecording] = {}
    for job in jobs:
        if job.sequence in places:
            continue
        if job.scene is None or job.path.is_dir():
            scans = len(open_sequence(job.path))
            places[job.sequence] = _PilotRecording(job.path, scans, scans, 0.0)
            continue
        whole = len(drive_of(job.scene, job.seed))
        start = max(other.config.input.start for other in jobs if other.sequence == job.sequence)
        part = replace(job.scene, scans=min(whole, start + _MOST_SCANS))
        began = time.monotonic()
        path = simulate_once(part, job.seed, folder, progress)
        assert part.scans is not None
        places[job.sequence] = _PilotRecording(path, part.scans, whole, (time.monotonic() - began) * whole / part.scans)
    return places


def _coordinates(points: Sequence[Variant]) -> Floats:
    """(P, K) studied values scaled to 0..1; a value that is no number gives its place in the list."""
    columns = []
    for key in points[0].parameters:
        values = [point.parameters.get(key, 0) for point in points]
        if not all(isinstance(value, (int, float)) for value in values):
            values = [list(dict.fromkeys(values)).index(value) for value in values]
        x = np.array(values, np.float64)
        columns.append((x - x.min()) / max(float(np.ptp(x)), 1e-12))
    return np.column_stack(columns) if columns else np.zeros((len(points), 0))


def _pilot_points(X: Floats) -> list[int]:
    """Indices of the points nearest to the corners and the middle, without repetitions."""
    places = [*product((0.0, 1.0), repeat=X.shape[1]), (0.5,) * X.shape[1]]
    return list(dict.fromkeys(int(np.argmin(np.sum((X - np.array(place)) ** 2, axis=1))) for place in places))


def _pilots(job: Job, recording: _PilotRecording) -> list[_Pilot]:
    """Short and long pilot of each chosen point."""
    most = scans_of_run(recording.scans, job.config.input)
    long = min(_LONG, most)
    pilots = []
    for scans in (max(1, min(_SHORT, long // 2)), long):
        config = job.config.model_copy(update={"input": job.config.input.model_copy(update={"count": scans})})
        pilots.append(_Pilot(replace(job, path=recording.path, config=config, scene=None), scans))
    return pilots


def _run(pilots: Sequence[_Pilot], folder: Path, progress: StudyProgress) -> tuple[list[Job], list[float]]:
    """The jobs and seconds of each, in one process; the first includes loading. Raises RunFailedError without a result."""
    jobs = [replace(p.job, folder=folder / f"{k}-{p.scans}") for k, p in enumerate(pilots)]
    Local(title="pilot runs").run(jobs, progress, lambda job: None)
    seconds = []
    for job in jobs:
        state = read_state(job.state_file)
        if state is None or state.status not in FINAL:
            reason = "it left no result" if state is None else state.reason
            raise RunFailedError(f"a pilot run of {job.name} failed, so the time is not known: {reason}")
        seconds.append(state.seconds)
    return jobs, seconds


def _report_s(folder: Path, pilots: Sequence[Job], variants: dict[str, Variant]) -> float:
    """Time of a report, s, measured on the pilots."""
    results = Results("pilots", folder, pilots, variants)
    results.add(pilots)
    began = time.monotonic()
    write_study_report(folder, results.rows)
    return time.monotonic() - began


def _costs(pairs: Sequence[Sequence[_Pilot]], times: Sequence[float]) -> tuple[Floats, Floats]:
    """(P,) s per run and (P,) s per scan of the pairs of pilots."""
    t = np.array(times).reshape(len(pairs), 2)
    n = np.array([[pilot.scans for pilot in pair] for pair in pairs], np.float64)
    per_scan = (t[:, 1] - t[:, 0]) / np.maximum(n[:, 1] - n[:, 0], 1)
    # A pause of the machine may hide what scans cost, but they are never free.
    per_scan = np.maximum(per_scan, 0.3 * t[:, 1] / n[:, 1])
    return np.maximum(t[:, 1] - per_scan * n[:, 1], 0), per_scan


def _interpolate(X: Floats, pilots: Floats, base: Floats, per_scan: Floats) -> Floats:
    """(N, 2) costs at points X, linear in the studied values and clipped to the range of the pilots, at (P, K)."""
    values = np.column_stack([base, per_scan])
    ones = [np.column_stack([np.ones(len(x)), x]) for x in (pilots, X)]
    costs = ones[1] @ np.linalg.lstsq(ones[0], values, rcond=None)[0]
    return np.asarray(np.clip(costs, values.min(axis=0), values.max(axis=0)))
