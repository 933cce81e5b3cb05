"""The IMU over time: what its filter knew, with bands, and what it read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.reports import svg
from lslam.reports.plots import Figure
from lslam.types.imu import XYZ
from lslam.types.run_record import RunRecord

Floats = NDArray[np.float64]

TIME = "s since the first scan"
BAND_SIGMAS = 3.0


@dataclass(frozen=True)
class _Course:
    """A figure of some of `IMU_STATES`: those from `begin` to before `end`, times `factor`."""

    title: str
    y_label: str
    begin: int
    end: int
    factor: float = 1.0
    names: tuple[str, ...] = XYZ
    recipe: str = "IMU axes."


_COURSES = (
    _Course("Accelerometer bias", "bias, m/s²", 0, 3),
    _Course("Gyroscope bias", "bias, deg/s", 3, 6, 180 / np.pi),
    _Course("Gravity", "gravity, m/s²", 6, 9, recipe="World axes: what moves is a world that registration turned."),
    _Course("Mounting", "rotation vector, deg", 9, 12, 180 / np.pi, recipe="From the IMU's axes to those that were given."),
    _Course("Clock offset", "to add to the IMU's stamps, ms", 12, 13, 1e3, ("offset",), ""),
)  # fmt: skip


def imu_figures(record: RunRecord) -> list[Figure]:
    """States of the IMU after each scan with their bands, then its readings; empty without an IMU."""
    known = [(r.stamp_ns, r.imu.state) for r in record.results if r.imu.state is not None]
    figures = []
    if known:
        seconds = _seconds(np.array([stamp for stamp, _ in known], np.int64), record)
        values, sigmas = (np.stack([getattr(state, what) for _, state in known]) for what in ("values", "sigmas"))
        for course in _COURSES:
            part = slice(course.begin, course.end)
            figures.append(_course(course, seconds, course.factor * values[:, part], course.factor * sigmas[:, part]))
    return [figure for figure in [*figures, *_readings(record)] if figure.svg]


def _course(course: _Course, seconds: Floats, values: Floats, sigmas: Floats) -> Figure:
    lines, bands = [], []
    for k, name in enumerate(course.names):
        style = f"s{k + 1}"
        lines.append(svg.Line(name, seconds, values[:, k], style))
        reach = BAND_SIGMAS * sigmas[:, k]
        bands.append(svg.Band(seconds, values[:, k] - reach, values[:, k] + reach, style))
    chart = svg.line_chart(lines, TIME, course.y_label, course.title, zero=False, bands=bands, by="time")
    legend = tuple((line.style, line.label) for line in lines) if len(lines) > 1 else ()
    return Figure(course.title, chart, legend, f"{course.recipe} Band: {BAND_SIGMAS:g} sigma.".strip())


def _readings(record: RunRecord) -> list[Figure]:
    """What the recording's IMU says, as it stands there, while the scans were taken."""
    imu = record.imu
    if imu is None or not record.results:
        return []
    first, last = record.results[0].stamp_ns, record.results[-1].stamp_ns
    during = (imu.stamps_ns >= first) & (imu.stamps_ns <= last)
    seconds = _seconds(imu.stamps_ns[during], record)
    recipe = "As recorded, in IMU axes; of a long recording the least and the largest of each stretch."
    figures = []
    for title, y_label, values in (
        ("Specific force", "as recorded (m/s² if it is right)", imu.accel[during]),
        ("Angular rate", "as recorded (rad/s if it is right)", imu.gyro[during]),
    ):
        lines = [svg.Line(name, seconds, values[:, k], f"s{k + 1}") for k, name in enumerate(XYZ)]
        chart = svg.line_chart(lines, TIME, y_label, title, by="time")
        figures.append(Figure(title, chart, tuple((line.style, line.label) for line in lines), recipe))
    return figures


def _seconds(stamps_ns: NDArray[np.int64], record: RunRecord) -> Floats:
    return np.asarray((stamps_ns - record.results[0].stamp_ns) * 1e-9)
