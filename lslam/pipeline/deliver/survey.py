"""A finished run, or a merge of several, as it is delivered: drives, coordinates, surveyed points; and sentences about it."""

from __future__ import annotations

import csv
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

from lslam.backend.control_points import control_residuals
from lslam.backend.manual import read_control_points, require_instants
from lslam.core import __version__
from lslam.core.arrays import Floats
from lslam.core.errors import InputError, RunFailedError, UsageError, input_errors
from lslam.core.geometry import geodesy, noise, se3
from lslam.core.printable import count_of, first_of, with_decimals
from lslam.core.types.gnss import OutputCrs
from lslam.core.untrusted import MISFIT
from lslam.io.formats.text_tables import utc_of
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.maps.georeference import LocalFrame, Projection, in_crs
from lslam.pipeline.map_files import georeference_of, read_json
from lslam.pipeline.merge_runs import sessions_of
from lslam.pipeline.rebuild import EarlierRun, covariances_of, read_run, results_of
from lslam.pipeline.run_folder import MANIFEST, SESSIONS, require_run

DELIVERABLE = ("done", "degraded")
# Surveys of one mark differ by less, two marks by more.
SAME_MARK_M = 0.05
# Of a length. Grids that states survey in are true to 1 in 1,000, web maps to no bound.
MOST_SCALE_ERROR = 0.01
TITLE = "Delivery of a LiDAR survey by lslam"
_WIDTH = 100


@dataclass(frozen=True)
class SurveyedPoints:
    """Surveyed points beside the final poses.

    kind : `used` ones held the run, those `kept out` check it; names : where each was stated
    places : (N, 3) as surveyed; residuals : (N, 3) surveyed minus solved; both easting, northing, height, m
    """

    kind: Literal["used", "kept out"]
    names: list[str]
    stamps_ns: list[int]
    places: Floats
    residuals: Floats

    @property
    def rms(self) -> tuple[float, float]:
        """Root mean square of the residuals, m, horizontally and vertically."""
        squares = (self.residuals**2).mean(axis=0)
        return float(np.sqrt(squares[0] + squares[1])), float(np.sqrt(squares[2]))

    @property
    def worst(self) -> tuple[float, float]:
        """Largest residuals, m, horizontally and vertically."""
        return float(np.hypot(*self.residuals.T[:2]).max()), float(np.abs(self.residuals[:, 2]).max())


@dataclass(frozen=True)
class Survey:
    """Contents of a folder to deliver.

    drives : the run by the name of its sequence, or the sessions of a merge, all in one world
    frame : from that world to the delivered coordinates; points : surveyed ones, those that held the run first
    """

    folder: Path
    manifest: Mapping[str, Any]
    drives: Mapping[str, EarlierRun]
    frame: Projection | LocalFrame
    points: tuple[SurveyedPoints, ...] = ()

    @property
    def name(self) -> str:
        """Names of the drives, the first of many."""
        return first_of(list(self.drives))

    @property
    def status(self) -> str:
        """How the run ended."""
        return str(self.manifest.get("status", "unknown"))

    @property
    def problems(self) -> list[str]:
        """What the run says went wrong."""
        return [str(problem) for problem in self.manifest.get("problems", ())]

    def covariances(self, run: EarlierRun) -> Floats | None:
        """(N, 6, 6) of the poses of a drive about the axes of the delivered coordinates, m2 and rad2; None where unknown."""
        known = covariances_of(run)
        return None if known is None else noise.rotate(known, self.frame.carry(np.eye(4))[0, :3, :3])

    @property
    def sigmas(self) -> Floats:
        """(N, 2) one standard deviation of each known position, m: horizontally, where it is largest, and of the height."""
        found = [C for run in self.drives.values() if (C := self.covariances(run)) is not None]
        C = np.concatenate([np.zeros((0, 6, 6)), *found])
        C = C[np.isfinite(C).all((1, 2))]
        variances = np.column_stack([np.linalg.eigvalsh(C[:, :2, :2])[:, -1], C[:, 2, 2]])
        return np.asarray(np.sqrt(np.maximum(variances, 0.0)))


def read_survey(folder: Path, crs: OutputCrs | None, check: Path | None = None, takes_any: bool = False) -> Survey:
    """Read a finished run or merge in `folder` for delivery.

    crs : coordinates to deliver in, None for those of the run; check : file of points that the run did not use
    takes_any : also read a run that diverged or was interrupted
    Raises RunFailedError: such a run is not to be delivered. UsageError: the run is not georeferenced, heights in `crs` are
    unavailable, or a check point was used by the run. InputError: a file is missing or damaged.
    """
    require_run(folder)
    manifest = read_json(folder / MANIFEST)
    why = "" if (status := str(manifest.get("status", "unknown"))) in DELIVERABLE else f"it is {status}"
    if any(part.get("frame") for part in manifest.get("segments", ())):
        why = why or "scans of it lie in a frame of their own, at no known place"
    if why and not takes_any:
        raise RunFailedError(
            f"{folder} is no result to hand over, {why}: run the sequence again, or take it as it is with --anyway"
        )
    drives = _drives(folder, manifest)
    first = next(iter(drives.values()))
    if not all(len(run.trajectory) for run in drives.values()):
        raise InputError(f"{folder} has a trajectory without a pose: run the sequence again")
    if first.georeference is None:
        if crs is not None or check is not None:
            flag = "--check" if crs is None else "--geoid" if crs.epsg is None else "--crs"
            raise UsageError(
                f"{flag}: {folder} is not georeferenced: run the sequence with --gnss or "
                "--georeference where it has satellite fixes, or with --osm MAP --origin LAT,LON, or give it points: lslam graph "
                f"{folder} --control points.csv; without {flag} it is delivered in local coordinates"
            )
        world = manifest.get("frames", {}).get("world", "LiDAR at the first scan")
        return Survey(folder, manifest, drives, LocalFrame(f"local coordinates, m: {world}"))
    projection = Projection(in_crs(first.georeference, crs))
    projection.check()
    _, scale = projection.convergence_and_scale
    if abs(scale - 1) > MOST_SCALE_ERROR:
        raise UsageError(
            f"--crs {projection.name}: lengths in it are {scale:.3g} times those on the ground here, which is no plane for a "
            "survey; leave --crs out for that of the run, or name one made for this place"
        )
    survey = Survey(folder, manifest, drives, projection)
    control = _control(survey, projection)
    points = [] if control is None else [control]
    if check is not None:
        points.append(_check_points(survey, projection, check, control))
    return replace(survey, points=tuple(points))


def _drives(folder: Path, manifest: Mapping[str, Any]) -> dict[str, EarlierRun]:
    """The run in a folder by its name, or the sessions of a merge at their merged poses; InputError where one is missing."""
    sessions = sessions_of(folder)
    if sessions is None:
        run = read_run(folder)
        return {run.name: run}
    georeference, drives = georeference_of(manifest.get("georeference")), {}
    for name, source in sessions.items():
        if not source.is_dir():
            raise InputError(f"{folder} was merged from {source}, which is gone: put it back, or merge the runs again")
        run, trajectory = read_run(source), read_trajectory(folder / SESSIONS / f"{name}.tum", "tum")
        if not np.array_equal(run.trajectory.stamps_ns, trajectory.stamps_ns):
            raise InputError(f"{source} has other scans than {folder} was merged from: merge the runs again")
        drives[name] = replace(run, folder=folder, trajectory=trajectory, georeference=georeference)
    return drives


def _control(survey: Survey, projection: Projection) -> SurveyedPoints | None:
    """Control points of control.csv; None without any, InputError if the file has no positions."""
    path = survey.folder / "control.csv"
    if not path.is_file():
        return None
    with input_errors(path, *MISFIT, as_what="a table of control points"):
        with path.open(newline="", encoding="utf-8") as stream:
            rows = list(csv.DictReader(stream))
        if rows and "lat_deg" not in rows[0]:
            raise InputError(
                f"{path} is of an earlier lslam and has no places: make it anew with lslam graph {survey.folder}"
            )
        names, stamps = [row["point"] for row in rows], [int(row["stamp_ns"]) for row in rows]
        places, residuals = (
            np.array([[float(row[column]) for column in columns] for row in rows])
            for columns in (("lat_deg", "lon_deg", "height_m"), ("east_m", "north_m", "up_m"))
        )
    return _points("used", names, stamps, places, residuals, projection) if rows else None


def _check_points(survey: Survey, projection: Projection, path: Path, control: SurveyedPoints | None) -> SurveyedPoints:
    """Points of `path`, with residuals, to check one run; raises UsageError for a merge, or if one is also in `control`."""
    if len(survey.drives) > 1:
        raise UsageError(
            f"--check: {survey.folder} is a merge, whose scans have no numbers of their own: check one of its runs"
        )
    (run,) = survey.drives.values()
    points, results = read_control_points(path), results_of(run)
    require_instants([point.at for point in points], np.array([r.index for r in results]), run.trajectory.stamps_ns)
    off = control_residuals(points, results, projection.georeference, projection.georeference.geoid)
    names, stamps = [point.at.source for point in points], [one.stamp_ns for one in off]
    places, residuals = np.stack([one.place for one in off]), np.stack([one.residual for one in off])
    result = _points("kept out", names, stamps, places, residuals, projection)
    for name, place in zip(names, result.places, strict=True):
        if control is not None and (np.linalg.norm(control.places[:, :2] - place[:2], axis=1) < SAME_MARK_M).any():
            raise UsageError(
                f"--check: {name} is a control point that held the run: it checks nothing; leave it out of one file"
            )
    return result


def _points(
    kind: Literal["used", "kept out"],
    names: list[str],
    stamps: list[int],
    places: Floats,
    off: Floats,
    projection: Projection,
) -> SurveyedPoints:
    """Surveyed points from places (N, 3) lat, lon (deg), height (m), and residuals `off` (N, 3) east, north, up, m."""
    there = projection.georeference
    enu = geodesy.to_local(places, there.origin)
    stated, solved = (projection.apply(se3.apply(se3.inverse(there.T_enu_world), at)) for at in (enu, enu - off))
    return SurveyedPoints(kind, names, stamps, stated, stated - solved)


def accuracy(survey: Survey) -> list[str]:
    """Sentences on the accuracy at check and control points, of satellite fixes, and on the precision by covariances."""
    by_kind = {points.kind: points for points in survey.points}
    sentences = []
    if (check := by_kind.get("kept out")) is not None:
        sentences.append(
            f"Measured at {count_of(len(check.names), 'check point')} that the run did not use: RMS {_pair(check.rms)}, "
            f"largest {_pair(check.worst)}."
        )
    else:
        sentences.append("Accuracy was not measured: no check point was kept out of the run.")
    if (control := by_kind.get("used")) is not None:
        sentences.append(
            f"{count_of(len(control.names), 'control point')} held the run: residuals of RMS {_pair(control.rms)}, largest "
            f"{_pair(control.worst)}. They say how well the trajectory follows these points, not how accurate it is elsewhere."
        )
        facts = survey.manifest.get("graph", {}).get("control_points", {})
        if facts.get("redundancy") == 0 or facts.get("height_redundancy") == 0:
            sentences.append("So few points have no redundancy: nothing but odometry checks them.")
    sentences += _fixes(survey)
    if len(sigmas := survey.sigmas):
        middle, worst = np.median(sigmas, axis=0), sigmas.max(axis=0)
        sentences.append(
            f"One standard deviation by the covariances, {precision_note(survey)}: {_pair(middle)} in the median, {_pair(worst)} "
            "at most. Systematic errors are not in it."
        )
    else:
        sentences.append("No covariances are known of these poses: nothing is said of their precision.")
    return sentences


def precision_note(survey: Survey) -> str:
    """Sentence on what the standard deviations of the poses are relative to."""
    georeference = next(iter(survey.drives.values())).georeference
    is_absolute = georeference is not None and georeference.is_in_graph
    return "internal precision " + ("in the delivered coordinates" if is_absolute else "relative to the first pose")


def _pair(values: Any) -> str:
    """Horizontal and vertical number, m, as text."""
    return f"{with_decimals(float(values[0]), 3)} m horizontally, {with_decimals(float(values[1]), 3)} m vertically"


def _fixes(survey: Survey) -> list[str]:
    """Sentence on satellite fixes and their residuals, if the run used some."""
    facts = survey.manifest.get("georeference", {})
    if not (facts.get("fixes") and facts.get("used")):
        return []
    how = "held the run" if facts["method"] == "graph" else "placed the finished trajectory"
    rms = [float(facts.get(name, "nan")) for name in ("rmse_horizontal", "rmse_vertical")]
    return [f"{facts['used']} of {facts['fixes']} satellite fixes {how}; the antenna is RMS {_pair(rms)} from them."]


def coordinates(survey: Survey) -> list[str]:
    """The coordinate reference system, its heights, the transformation and the epoch."""
    frame = survey.frame
    if not isinstance(frame, Projection):
        return [
            f"Local coordinates, m, not georeferenced: {frame.frame.partition(': ')[2]}. x and y have no relation to north, "
            "heights none to any datum."
        ]
    is_ellipsoidal = "ellipsoid" in frame.heights
    kind = "ellipsoidal heights, no geoid was applied" if is_ellipsoidal else "physical heights, by a geoid"
    return [
        f"{frame.name}: {frame.plane}.",
        f"{frame.heights[0].upper()}{frame.heights[1:]}: {kind}.",
        f"From WGS 84 by PROJ: {frame.operation}.",
        _north(frame),
        f"Epoch: {epoch(survey)}.",
        *([f"{frame.attribution[0].upper()}{frame.attribution[1:]}."] if frame.attribution else []),
    ]


def epoch(survey: Survey) -> str:
    """Date of the recording, also as a decimal year; or that it is unknown."""
    times = utc_of(next(iter(survey.drives.values())).trajectory.stamps_ns)
    if times is None:
        return "unknown, stamps of the recording are no Unix time"
    begin = datetime(times[0].year, 1, 1, tzinfo=UTC)
    share = (times[0] - begin) / (datetime(times[0].year + 1, 1, 1, tzinfo=UTC) - begin)
    return f"{times[0]:%Y-%m-%d}, {times[0].year + share:.2f}, when it was recorded"


def _north(projection: Projection) -> str:
    """Directions of grid north and true north, and the scale."""
    convergence, scale = projection.convergence_and_scale
    side = "east" if convergence > 0 else "west"
    return f"N is grid north, {abs(convergence):.3f} deg {side} of true north; scale of the grid {scale:.6f}."


def limits(survey: Survey) -> list[str]:
    """Sentences on how the run ended, and why, which a user of the data must know."""
    if survey.status == "done":
        return ["The run ended as done.", *survey.problems]
    warning = ": this is no finished result, and was delivered on request (--anyway)"
    return [f"The run is {survey.status}{'' if survey.status in DELIVERABLE else warning}.", *survey.problems]


def making(survey: Survey) -> list[str]:
    """Sentences on recording, method, version and date of the run."""
    manifest, scans = survey.manifest, sum(len(run.trajectory) for run in survey.drives.values())
    run = next(iter(survey.drives.values()))
    count = sum(status == "ok" for one in survey.drives.values() for status in one.statuses)
    length = sum(float(one.trajectory.path_lengths[-1]) for one in survey.drives.values())
    return [
        f"Recording: {survey.name}; {count_of(scans, 'scan')}, {count} registered; {length:.1f} m of way.",
        f"Method: {run.config.odometry.method}, lslam {manifest.get('lslam', 'of unknown version')}; "
        f"{count_of(int(manifest.get('graph', {}).get('loops', 0)), 'loop closure')}.",
        *([f"Processed: {str(manifest['written'])[:10]}."] if "written" in manifest else []),
    ]


def readme(survey: Survey, files: Mapping[str, str], notes: Sequence[str], command: str) -> str:
    """Text of README.txt: files with descriptions, and all sentences on the survey; notes : what is missing, and why."""
    sections: dict[str, Sequence[str]] = {
        "Coordinates": coordinates(survey),
        "Accuracy": accuracy(survey),
        "Limits": [*limits(survey), *notes],
        "How it was made": [
            *making(survey),
            f"Run by: {survey.manifest.get('command', 'unknown')}",
            f"Delivered on {datetime.now(UTC):%Y-%m-%d} with lslam {__version__} by: {command}",
        ],
    }
    lines = [TITLE, "=" * len(TITLE), ""]
    lines += [*_paragraph(f"Survey of {survey.name}. Every length is in metres."), "", "Files", "-----"]
    width = max(map(len, files))
    for name, about in files.items():
        lines += textwrap.wrap(about, _WIDTH, initial_indent=f"{name:<{width}}  ", subsequent_indent=" " * (width + 2))
    for heading, texts in sections.items():
        lines += ["", heading, "-" * len(heading), *(line for text in texts for line in _paragraph(text))]
    return "\n".join(lines) + "\n"


def _paragraph(text: str) -> list[str]:
    """Lines of a text, wrapped."""
    return textwrap.wrap(text, _WIDTH, break_long_words=False, break_on_hyphens=False)
