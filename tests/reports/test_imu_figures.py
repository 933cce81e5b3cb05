"""Figures of the IMU: degrees and milliseconds, bands of three sigma, nothing of what is not estimated."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from conftest import MakeRecord

from lslam.core.types.imu import ImuDiagnostics, ImuState, ImuStream
from lslam.reports import html as module
from lslam.reports import svg
from lslam.reports.html import imu_figures


def state(k: int, is_calibrated: bool) -> ImuState:
    values = np.r_[np.full(3, 0.1), np.full(3, np.deg2rad(2.0)), 0.0, 0.0, -9.81, np.full(3, np.deg2rad(3.0)), 0.02]
    sigmas = np.r_[np.full(9, 0.01), np.full(3, np.deg2rad(0.5)), 0.001]
    if not is_calibrated:
        values[9:] = sigmas[9:] = np.nan
    return ImuState(values + 1e-4 * k, sigmas)


@pytest.mark.parametrize("is_calibrated", [False, True])
def test_states_are_drawn_in_their_units_with_bands(
    make_record: MakeRecord, monkeypatch: pytest.MonkeyPatch, is_calibrated: bool
) -> None:
    record = make_record(12)
    record.results[:] = [replace(r, imu=ImuDiagnostics(state(k, is_calibrated))) for k, r in enumerate(record.results)]
    drawn: dict[str, tuple[list[svg.Line], list[svg.Band]]] = {}
    chart = svg.line_chart

    def kept(lines: list[svg.Line], x: str, y: str, title: str, **given: object) -> str:
        drawn[title] = lines, list(given.get("bands", ()))  # type: ignore[call-overload]
        return chart(lines, x, y, title, **given)  # type: ignore[arg-type]

    monkeypatch.setattr(module.svg, "line_chart", kept)
    titles = [figure.title for figure in imu_figures(record)]
    calibrated = ["Mounting", "Clock offset"] if is_calibrated else []
    assert titles == ["Accelerometer bias", "Gyroscope bias", "Gravity", *calibrated]
    lines, bands = drawn["Gyroscope bias"]
    assert lines[0].y[0] == pytest.approx(2.0)
    assert bands[0].high[0] - lines[0].y[0] == pytest.approx(3 * np.rad2deg(0.01))
    if is_calibrated:
        assert drawn["Mounting"][0][1].y[0] == pytest.approx(3.0)
        assert drawn["Clock offset"][0][0].y[0] == pytest.approx(20.0)
        assert drawn["Clock offset"][1][0].low[0] == pytest.approx(17.0)


def test_readings_are_those_taken_while_the_scans_were(make_record: MakeRecord) -> None:
    stamps = 10_000_000 * np.arange(-50, 200, dtype=np.int64)
    accel = np.where((stamps < 0)[:, None], 99.0, 1.0) * np.ones((len(stamps), 3))
    record = replace(make_record(12), imu=ImuStream(stamps, accel, np.zeros_like(accel)))
    force, rate = imu_figures(record)
    assert (force.title, rate.title) == ("Specific force", "Angular rate")
    assert not re.search(r">(90|100)<", force.svg), "what was read before the first scan is not shown"
    assert imu_figures(make_record(12)) == []
