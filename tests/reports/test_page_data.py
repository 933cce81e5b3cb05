"""What the page's script is told, read back as it reads it."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lslam.core.config.outputs import EvalConfig
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.run_record import RunRecord
from lslam.evaluation.evaluate import evaluate
from lslam.evaluation.metric import Evaluation
from lslam.reports.html import render_report, with_new_map
from lslam.reports.page_data import cloud_data, scan_data
from lslam.reports.png import palette

MakeRecord = Callable[..., RunRecord]


def unpack(text: str, kind: str) -> np.ndarray[Any, Any]:
    return np.frombuffer(base64.b64decode(text), kind)


def data_of(page: str, name: str) -> dict[str, Any]:
    found = re.search(rf'<script type="application/json" id="{name}">(.*?)</script>', page, re.S)
    assert found
    data: dict[str, Any] = json.loads(found[1])
    return data


def scored(record: RunRecord) -> Evaluation:
    assert record.ground_truth is not None
    return evaluate(record.trajectory, record.ground_truth)


def test_every_scan_is_there_with_its_pose_and_error(make_record: MakeRecord) -> None:
    record = make_record(80, bad={7: ("bridged", "</script><b>"), 9: ("skipped", "empty")})
    record.results[20] = replace(record.results[20], degenerate=np.eye(6)[:1], posed_by="all-points")
    record.results[21] = replace(record.results[21], is_stationary=True)
    evaluation = scored(record)
    data = data_of(render_report(record, evaluation), "scans")
    stamps = int(data["first_stamp_ns"]) + unpack(data["stamps"], "<f8").astype(np.int64)
    assert np.array_equal(stamps, record.trajectory.stamps_ns)
    assert unpack(data["index"], "<i4").tolist() == list(range(80))
    positions = unpack(data["positions"], "<f4").reshape(-1, 3)
    np.testing.assert_allclose(positions, record.trajectory.positions, atol=1e-5)
    status = unpack(data["status"], "u1")
    words = [data["statuses"][code & 7] for code in status]
    assert {k: word for k, word in enumerate(words) if word != "registered"} == {
        7: "bridged", 9: "skipped", 21: "standing",
    }  # fmt: skip
    assert np.flatnonzero(status & data["flags"]["degenerate"]).tolist() == [20]
    assert data["posers"][unpack(data["posed_by"], "u1")[20]] == "all-points"
    assert data["reasons"] == {"7": "</script><b>", "9": "empty"}
    absolute = evaluation.ate[data["alignment"]]
    np.testing.assert_allclose(unpack(data["error"], "<f4"), np.linalg.norm(absolute.errors, axis=1), rtol=1e-6)
    np.testing.assert_allclose(unpack(data["truth_way"], "<f4"), evaluation.distance, rtol=1e-6)
    T = np.array(data["aligned"])
    np.testing.assert_allclose(positions @ T[:, :3].T + T[:, 3], absolute.aligned_positions, atol=1e-4)
    truth = unpack(data["truth"], "<f4").reshape(-1, 3)
    np.testing.assert_allclose(truth @ T[:, :3].T + T[:, 3], evaluation.gt_positions, atol=1e-4)


def test_scans_without_truth_have_no_error(make_record: MakeRecord) -> None:
    """Every other pose has a partner, by a clock that is 0.2 s late: errors stand at those, not beside them."""
    record = make_record(60)
    assert record.ground_truth is not None
    some = record.ground_truth.select(slice(10, 50, 2))
    truth = replace(some, stamps_ns=some.stamps_ns + 200_000_000)
    evaluation = evaluate(record.trajectory, truth, EvalConfig(time_offset=0.2))
    data = scan_data(record, evaluation)
    assert data is not None
    error = unpack(data["error"], "<f4")
    assert np.flatnonzero(np.isfinite(error)).tolist() == list(range(10, 50, 2))
    expected = np.linalg.norm(evaluation.ate[data["alignment"]].errors, axis=1)
    np.testing.assert_allclose(error[10:50:2], expected, rtol=1e-6)
    assert "error" not in (scan_data(record, None) or {})
    assert scan_data(replace(record, trajectory=record.trajectory.select(slice(0))), None) is None


def test_the_cloud_comes_back_within_half_a_step(make_record: MakeRecord) -> None:
    trajectory = make_record(50).trajectory
    rng = np.random.default_rng(5)
    points = rng.uniform((-300, 20, -2), (900, 1400, 30), (400, 3))
    data = cloud_data(ArrayCloud.of(points, np.arange(400)), trajectory)
    assert data is not None
    quanta = unpack(data["points"], "<i2").reshape(-1, 3)
    back = np.array(data["low"]) + np.array(data["step"]) * (quanta + 32768.0)
    order = np.linalg.norm(back[:, None] - points, axis=2).argmin(axis=1)
    assert sorted(order) == list(range(400))
    assert np.abs(np.corrcoef(order, np.arange(400))[0, 1]) < 0.1  # any first part is spread over all
    given = points[order]
    assert (np.abs(back - given) <= 0.501 * np.array(data["step"])).all()
    assert np.abs(back - given).max() < 0.011
    distances = np.linalg.norm(given[:, None] - trajectory.positions, axis=2)
    assert np.array_equal(unpack(data["nearest"], "<u2"), distances.argmin(axis=1))
    shades = unpack(data["intensity"], "u1")[np.argsort(order)]
    assert (np.diff(shades.astype(int)) >= 0).all()
    assert (shades[0], shades[-1]) == (0, 255)
    low, high = data["height"]
    assert np.mean(points[:, 2] < low) == pytest.approx(0.02, abs=0.01)
    assert np.mean(points[:, 2] > high) == pytest.approx(0.02, abs=0.01)


def test_colours_and_labels_stay_with_their_points() -> None:
    rng = np.random.default_rng(8)
    points, rgb = rng.uniform(0, 50, (300, 3)), rng.integers(0, 256, (300, 3)).astype(np.uint8)
    labels = np.repeat(np.array([40, 10, 71, 1, 2, 3, 4, 5, 6, 7], np.uint16), [100, 80, 50, 20, 15, 10, 9, 8, 5, 3])
    columns = {"red": rgb[:, 0], "green": rgb[:, 1], "blue": rgb[:, 2], "class": labels}
    data = cloud_data(ArrayCloud(points, None, columns))
    assert data is not None
    back = np.array(data["low"]) + np.array(data["step"]) * (unpack(data["points"], "<i2").reshape(-1, 3) + 32768.0)
    order = np.linalg.norm(back[:, None] - points, axis=2).argmin(axis=1)
    assert np.array_equal(unpack(data["rgb"], "u1").reshape(-1, 3), rgb[order])
    assert data["kinds"] == ["40", "10", "71", "1", "2", "3", "4", "others"]
    named = np.array(data["kinds"])[unpack(data["kind"], "u1")]
    expected = [str(label) if label not in (5, 6, 7) else "others" for label in labels[order]]
    assert named.tolist() == expected


def test_spacing_is_that_of_a_lattice_and_none_of_a_point() -> None:
    lattice = 0.2 * np.stack(np.meshgrid(np.arange(90), np.arange(70), [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    data = cloud_data(ArrayCloud.of(lattice))
    assert data is not None
    assert data["spacing"] == pytest.approx(0.2)
    alone = cloud_data(ArrayCloud.of([[1.0, 2.0, 3.0]]))
    assert alone is not None
    assert alone["spacing"] == 0


def test_points_that_are_alike_have_no_intensity(make_record: MakeRecord) -> None:
    trajectory = make_record(5).trajectory
    data = cloud_data(ArrayCloud.of(np.ones((4, 3)), np.ones(4)), trajectory)
    assert data is not None
    assert "intensity" not in data
    assert cloud_data(ArrayCloud.of(np.full((3, 3), np.nan)), trajectory) is None
    assert cloud_data(None, trajectory) is None


def test_a_new_map_brings_its_points_and_leaves_the_scans(make_record: MakeRecord) -> None:
    record = make_record(40)
    page = render_report(record, scored(record))
    points = np.random.default_rng(1).uniform(0, 20, (77, 3))
    renewed = with_new_map(page, replace(record, results=[], map_sample=ArrayCloud.of(points)))
    assert data_of(renewed, "cloud")["count"] == 77
    assert data_of(renewed, "scans") == data_of(page, "scans")
    assert with_new_map(renewed, record) == page


def test_colours_are_viridis() -> None:
    matplotlib = pytest.importorskip("matplotlib")
    expected = matplotlib.colormaps["viridis"](np.linspace(0, 1, 16))[:, :3]
    assert np.abs(palette() / 255 - expected).max() <= 0.5 / 255 + 1e-9
