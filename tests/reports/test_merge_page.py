"""The page of merged runs: what its script is told, and what stands there without it."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from merged_sessions import sessions, ties, write

from lslam.reports.page_data import MOST_POSES


def told(page: Path, name: str) -> dict[str, Any]:
    found = re.search(rf'<script type="application/json" id="{name}">(.*?)</script>', page.read_text(), re.S)
    assert found
    data: dict[str, Any] = json.loads(found[1])
    return data


def unpacked(text: str, kind: str) -> np.ndarray[Any, Any]:
    return np.frombuffer(base64.b64decode(text), kind)


def test_the_script_knows_every_session_and_what_ties_them(tmp_path: Path) -> None:
    data = told(write(tmp_path / "report.html"), "sessions")
    for told_one, one in zip(data["sessions"], sessions(), strict=True):
        assert told_one["name"] == one.name
        np.testing.assert_allclose(unpacked(told_one["positions"], "<f4").reshape(-1, 3), one.after, atol=1e-5)
        assert unpacked(told_one["index"], "<i4").tolist() == one.scans.tolist()
    np.testing.assert_allclose(unpacked(data["ties"], "<f4").reshape(-1, 2, 3), ties(), atol=1e-5)
    assert data["tied"] == len(ties())


def test_every_point_belongs_to_the_session_that_came_nearest(tmp_path: Path) -> None:
    page = write(tmp_path / "report.html")
    cloud, views = told(page, "cloud"), sessions()
    q = unpacked(cloud["points"], "<i2").reshape(-1, 3)
    points = (np.array(cloud["low"]) + np.array(cloud["step"]) * (q + 32768.0))[::37]
    away = [np.linalg.norm(points[:, None] - view.after, axis=2).min(axis=1) for view in views]
    is_clear = np.abs(away[0] - away[1]) > 0.02
    found = unpacked(cloud["session"], "u1")[::37]
    assert is_clear.sum() > 1000
    assert np.array_equal(found[is_clear], np.argmin(away, axis=0)[is_clear])


def test_the_script_knows_where_the_sessions_were_before(tmp_path: Path) -> None:
    for told_one, one in zip(told(write(tmp_path / "report.html"), "sessions")["sessions"], sessions(), strict=True):
        np.testing.assert_allclose(unpacked(told_one["before"], "<f4").reshape(-1, 3), one.before, atol=1e-5)


def test_long_sessions_are_thinned_with_their_numbers(tmp_path: Path) -> None:
    one = told(write(tmp_path / "report.html", scans=2 * MOST_POSES + 1), "sessions")["sessions"][0]
    index = unpacked(one["index"], "<i4")
    assert len(index) <= MOST_POSES
    assert len(one["positions"]) * 3 // 4 == pytest.approx(12 * len(index), abs=3)
    assert set(np.diff(index).tolist()) == {3}


@pytest.mark.parametrize(("has_map", "shown"), [(True, ["Before"]), (False, ["After", "Before"])])
def test_trajectories_are_shown_once_on_the_map_or_without_one(tmp_path: Path, has_map: bool, shown: list[str]) -> None:
    page = write(tmp_path / "report.html", has_map=has_map, problems=["north is left out"]).read_text()
    assert re.findall(r"<h3>(\w+) the pose graph", page) == shown
    assert ('id="cloud"' in page) == has_map
    assert '<span class="badge degraded">degraded</span>' in page
    assert "North is left out." in page
