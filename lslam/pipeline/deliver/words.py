"""Sentences about a survey: how accurate it is and who says so, in which coordinates, what went wrong, and how it was made."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from lslam.core import __version__
from lslam.core.printable import count_of, with_decimals
from lslam.io.formats.text_tables import utc_of
from lslam.maps.georeference import Projection
from lslam.pipeline.deliver.survey import FINISHED, Survey
from lslam.pipeline.deliver.tables import precision_note

TITLE = "Delivery of a LiDAR survey by lslam"
_WIDTH = 100


def accuracy(survey: Survey) -> list[str]:
    """What was measured of the accuracy, by points kept out and by those that were used, and the internal precision."""
    by_kind = {points.kind: points for points in survey.points}
    said = []
    if (kept := by_kind.get("kept out")) is not None:
        said.append(
            f"Measured at {count_of(len(kept.names), 'check point')} that the run did not use: RMS {_pair(kept.rms)}, "
            f"largest {_pair(kept.worst)}."
        )
    else:
        said.append("Accuracy was not measured: no check point was kept out of the run.")
    if (used := by_kind.get("used")) is not None:
        said.append(
            f"{count_of(len(used.names), 'control point')} held the run: residuals of RMS {_pair(used.rms)}, largest "
            f"{_pair(used.worst)}. They say how well the trajectory follows these points, not how accurate it is elsewhere."
        )
        facts = survey.manifest.get("graph", {}).get("control_points", {})
        if facts.get("redundancy") == 0 or facts.get("height_redundancy") == 0:
            said.append("So few points have no redundancy: nothing but odometry checks them.")
    said += _fixes(survey)
    if len(sigmas := survey.sigmas):
        middle, worst = np.median(sigmas, axis=0), sigmas.max(axis=0)
        said.append(
            f"One standard deviation by the covariances, {precision_note(survey)}: {_pair(middle)} in the median, {_pair(worst)} "
            "at most. Systematic errors are not in it."
        )
    else:
        said.append("No covariances are known of these poses: nothing is said of their precision.")
    return said


def _pair(values: Any) -> str:
    return f"{with_decimals(float(values[0]), 3)} m horizontally, {with_decimals(float(values[1]), 3)} m vertically"


def _fixes(survey: Survey) -> list[str]:
    """Sentence about satellite fixes, where a run has used some."""
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
    """When the recording was made, as a date and a year with decimals; or that nobody knows."""
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
    """What a user of the data must know: how the run ended, and why."""
    if survey.status == "done":
        return ["The run ended as done.", *survey.problems]
    warning = ": this is no finished result, and was delivered on request (--anyway)"
    return [f"The run is {survey.status}{'' if survey.status in FINISHED else warning}.", *survey.problems]


def making(survey: Survey) -> list[str]:
    """Input, method, version and command."""
    manifest, scans = survey.manifest, sum(len(run.trajectory) for run in survey.drives.values())
    run = next(iter(survey.drives.values()))
    registered = sum(status == "ok" for one in survey.drives.values() for status in one.statuses)
    length = sum(float(one.trajectory.path_lengths[-1]) for one in survey.drives.values())
    return [
        f"Recording: {survey.name}; {count_of(scans, 'scan')}, {registered} registered; {length:.1f} m of way.",
        f"Method: {run.config.odometry.method}, lslam {manifest.get('lslam', 'of unknown version')}; "
        f"{count_of(int(manifest.get('graph', {}).get('loops', 0)), 'loop closure')}.",
        *([f"Processed: {str(manifest['written'])[:10]}."] if "written" in manifest else []),
    ]


def readme(survey: Survey, files: Mapping[str, str], notes: Sequence[str], command: str) -> str:
    """README.txt: files by name with what they are, and all of the above; notes : what is missing, and why."""
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
    return textwrap.wrap(text, _WIDTH, break_long_words=False, break_on_hyphens=False)
