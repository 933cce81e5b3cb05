"""Evaluations as JSON, tables and pictures: what is promised about each."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lslam.core.config.outputs import EvalConfig
from lslam.core.errors import OutputError, UsageError
from lslam.core.geometry import se3
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.evaluate import evaluate
from lslam.evaluation.metric import Evaluation
from lslam.evaluation.timing import StageTime, Timing
from lslam.reports import evaluations, picture

STAGE = StageTime(0.01, 0.02, 0.03, 0.011, 1.0)
TIMING = Timing("timing.csv", 150, STAGE, {"read": STAGE}, 0.1, 0)


def circle(radius: float = 25.0, noise: float = 0.0, count: int = 150) -> Trajectory:
    angle = np.linspace(0, 2 * np.pi, count)
    zero = np.zeros(count)
    step = np.full(count, 2 * np.pi * radius / count)
    twist = np.stack([step, zero, zero, zero, zero, np.gradient(angle)], axis=1)
    twist += noise * np.random.default_rng(0).normal(size=twist.shape) * [1, 1, 1, 0.1, 0.1, 0.1]
    poses = [np.eye(4)]
    for motion in se3.exp(twist[:-1]):
        poses.append(poses[-1] @ motion)
    return Trajectory(np.arange(count, dtype=np.int64) * 10**8, np.array(poses), source="gt.tum")


@pytest.fixture(scope="module")
def result() -> Evaluation:
    return evaluate(replace(circle(noise=0.01), source="runs/a/trajectory.tum"), circle())


@pytest.fixture(scope="module")
def unavailable() -> Evaluation:
    """A straight, short, unstamped pair: se3, drift and RPE in seconds are not available."""
    poses = np.tile(np.eye(4), (10, 1, 1))
    poses[:, 0, 3] = np.arange(10)
    line = Trajectory(np.arange(10, dtype=np.int64), poses, has_stamps=False, source="runs/b/trajectory.tum")
    return evaluate(line, line, EvalConfig(delta=("1scan", "10s")))


def strict(text: str) -> Any:
    def refuse(name: str) -> Any:
        raise AssertionError(f"{name} is not JSON")

    return json.loads(text, parse_constant=refuse)


def test_schema_of_one(result: Evaluation) -> None:
    document = strict(evaluations.to_json([result], [TIMING]))
    assert (document["schema"], document["version"]) == ("lslam-evaluation", 1)
    ate = result.ate["se3"].translation
    assert ate is not None
    assert document["ate"]["se3"]["rmse"] == ate.rmse
    assert document["ate"]["origin"]["recipe"].startswith("alignment origin")
    assert document["rpe"][0]["translation"]["n"] == document["rpe"][0]["n_pairs"] == 149
    assert document["kitti_drift"]["by_length"]["100"]["segments"] == document["kitti_drift"]["segments"]
    assert document["thesis1"]["thesis_rmse"] == result.scores["thesis1"].thesis_rmse
    assert document["thesis2"]["ate_mean"] == result.scores["thesis2"].ate_mean
    assert document["association"] == {
        "recipe": result.association, "matched": 150, "possible": 150, "time_offset_s": 0.0,
    }  # fmt: skip
    assert document["timing"]["stages"]["read"]["p95"] == 0.02
    for part in ("association", "kitti_drift", "thesis1", "thesis2"):
        assert document[part]["recipe"]
    np.testing.assert_allclose(document["ate"]["se3"]["T_gt_est"], result.ate["se3"].T_gt_est)


def test_what_is_not_available_is_null_and_said(unavailable: Evaluation) -> None:
    document = strict(evaluations.to_json([unavailable]))
    se3_part = document["ate"]["se3"]
    assert (se3_part["available"], se3_part["rmse"], se3_part["note"]) == (False, None, "n/a (collinear)")
    assert document["kitti_drift"]["translation_percent"] is None
    assert document["rpe"][1]["translation"]["rmse"] is None
    assert document["rpe"][1]["note"] == "n/a (no stamps)"
    assert document["timing"] is None


def test_several_are_a_list(result: Evaluation, unavailable: Evaluation) -> None:
    document = strict(evaluations.to_json([result, unavailable]))
    assert [d["estimate"] for d in document["evaluations"]] == ["runs/a/trajectory.tum", "runs/b/trajectory.tum"]


def test_text_table_names_every_recipe(result: Evaluation) -> None:
    text = evaluations.render([replace(result, words=("thesis",))], [TIMING])
    assert "thesis" not in evaluations.render([result], [TIMING])
    ate = result.ate["se3"].translation
    assert ate is not None
    assert f"{ate.rmse:.4g}" in text
    words = ["ATE se3 rmse", "ATE origin rmse", "RPE 1 scan, consecutive pairs", "RPE 10 m, all pairs", "KITTI drift"]
    words += ["thesis1", "thesis2", "nearest stamp", "matched 150 of 150", "Umeyama", "within 10 %", "time per scan"]
    for word in words:
        assert word in text, word
    assert max(len(line) for line in text.splitlines() if not line.startswith("  ")) < 120


def test_table_of_several_tells_them_apart(result: Evaluation, unavailable: Evaluation) -> None:
    pair = [result, replace(unavailable, scores=unavailable.scores | {"rpe": result.rpe})]
    text = evaluations.render(pair)
    assert text.splitlines()[1].startswith("estimate      a: runs/a/trajectory.tum")
    assert evaluations.short_names(["x/a.tum", "y/a.tum", "runs/b/trajectory.tum"]) == [
        "x/a.tum",
        "y/a.tum",
        "runs/b",
    ]
    assert evaluations.short_names(["a.tum", "a.tum"]) == ["1: a.tum", "2: a.tum"]
    assert "n/a (collinear)" in text
    for style in ("md", "csv", "tex"):
        lines = evaluations.render(pair, style=style).splitlines()
        assert len(lines) > 15
    rows = list(csv.reader(evaluations.render(pair, style="csv").splitlines()))
    assert {len(row) for row in rows} == {4}
    assert len({row[0] for row in rows}) == len(rows), "a label that stands alone names one row"
    markdown = evaluations.render(pair, style="md").splitlines()
    assert {line.count("|") for line in markdown if line.startswith("|")} == {5}
    assert any(line.startswith("- ATE alignment se3: ") for line in markdown), "numbers stand with their recipe"
    assert "\\%" in evaluations.render(pair, style="tex")
    with pytest.raises(ValueError, match="one of text"):
        evaluations.render(pair, style="html")


@pytest.mark.parametrize(("suffix", "magic"), [("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")])
def test_pictures(suffix: str, magic: bytes, result: Evaluation, unavailable: Evaluation, tmp_path: Path) -> None:
    path = tmp_path / f"plot.{suffix}"
    picture.write_plot(path, [result, replace(unavailable, scores=unavailable.scores | {"rpe": result.rpe})])
    content = path.read_bytes()
    assert content.startswith(magic)
    assert len(content) > 10_000
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_the_same_picture_twice(result: Evaluation, tmp_path: Path) -> None:
    for name in ("a.svg", "b.svg"):
        picture.write_plot(tmp_path / name, [result])
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()


def test_drift_over_one_length_is_said_and_not_drawn(result: Evaluation, tmp_path: Path) -> None:
    longer = evaluate(circle(radius=50.0, noise=0.01), circle(radius=50.0))
    for name, e in (("one.svg", result), ("three.svg", longer)):
        picture.write_plot(tmp_path / name, [e])
    one, three = ((tmp_path / name).read_text() for name in ("one.svg", "three.svg"))
    assert list(result.scores["kitti_drift"].by_length) == [100]
    assert f"{result.scores['kitti_drift'].by_length[100][0]:.3g} % over segments of 100 m" in one
    assert ">segment, m</text>" not in one
    assert ">segment, m</text>" in three


def test_pictures_that_cannot_be(result: Evaluation, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"ends with .png, .svg or .pdf"):
        picture.write_plot(tmp_path / "plot.bmp", [result])
    with pytest.raises(UsageError, match=r"plot.pn: a picture ends with .png"):
        picture.check_plot_path(tmp_path / "plot.pn")
    with pytest.raises(OutputError, match="cannot be written"):
        picture.write_plot(tmp_path / "none" / "plot.png", [result])
