"""The page as a reader, a browser and an attacker see it."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
import time
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from lslam.backend.loops.find_loops import FEW_POINTS, MOST_VIEWS
from lslam.core.errors import OutputError
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.constraint import LoopCandidate, LoopStage, Verdict
from lslam.core.types.run_record import PairView, RunRecord
from lslam.core.types.trajectory import Trajectory
from lslam.evaluation.evaluate import evaluate
from lslam.evaluation.metric import Evaluation
from lslam.reports.html import flatten, render_report, write_report

MakeRecord = Callable[..., RunRecord]
VOID = {"meta", "br", "link", "img", "hr", "input"}


class Strict(HTMLParser):
    """Fails on tags that do not nest; keeps the text, the tags and every address."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.handlers: list[str] = []
        self.scripts: list[tuple[str, str]] = []  # kind, content
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        if tag == "script":
            self.scripts.append((dict(attrs).get("type") or "", ""))
        self.addresses += [value or "" for name, value in attrs if name in ("href", "src", "xlink:href", "action")]
        self.handlers += [name for name, _ in attrs if name.startswith("on")]
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open, f"</{tag}> closes nothing"
        assert self.open.pop() == tag, f"</{tag}> crosses another tag"

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_data(self, data: str) -> None:
        if self.open[-1:] == ["script"]:
            kind, content = self.scripts[-1]
            self.scripts[-1] = (kind, content + data)
        else:
            self.text += data


def parse(page: str) -> Strict:
    parser = Strict()
    parser.feed(page)
    parser.close()
    assert parser.open == []
    return parser


def scored(record: RunRecord) -> Evaluation:
    assert record.ground_truth is not None
    return evaluate(record.trajectory, record.ground_truth)


def test_page_is_whole_and_alone(make_record: MakeRecord) -> None:
    record = make_record(90)
    page = render_report(record, scored(record))
    parsed = parse(page)
    assert parsed.tags.count("html") == parsed.tags.count("body") == parsed.tags.count("h1") == 1
    assert [kind for kind, _ in parsed.scripts] == ["application/json"] * 3 + [""]
    assert all(address.startswith("data:image/png;base64,") for address in parsed.addresses)
    assert len(parsed.addresses) == 1  # the map
    shown = re.sub(r"<script.*?</script>", "", page, flags=re.S).replace("data:image/png;base64,", "")
    assert not re.search(r"https?:|//[a-z]|@import|url\(", shown)
    # The one address in the script is the name of SVG.
    code = parsed.scripts[-1][1]
    assert set(re.findall(r"https?://[^\"]*", code)) == {"http://www.w3.org/2000/svg"}
    # One, of pages that are served; this page may connect to nobody.
    assert len(re.findall(r"\bfetch\(", code)) == 1
    assert "connect-src" not in page
    assert not re.search(r"XMLHttpRequest|WebSocket|import\(|\beval\b", code)


def test_no_script_but_the_page_s_own_may_run(make_record: MakeRecord) -> None:
    page = render_report(make_record(5), None)
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', page)
    assert policy
    digest = base64.b64encode(hashlib.sha256(parse(page).scripts[-1][1].encode()).digest()).decode()
    said = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-"
    assert html.unescape(policy[1]) == f"{said}{digest}'"


def test_what_counts_comes_first(make_record: MakeRecord) -> None:
    record = make_record(40, manifest={"status": "done", "identity": {"input": "d25e"}, "command": "lslam run drive"})
    page = render_report(record, scored(record))
    order = ["What went wrong", "Map", "Trajectory", "Errors against ground truth", "Time", "Input and decisions"]
    at = [page.index(f"<h2>{title}</h2>") for title in order]
    assert at == sorted(at)
    folded = re.findall(r"<details class=\"fold\">\s*<summary><h2>([^<]+)", page)
    assert folded == ["Time", "Registration", "Uncertainty", "Input and decisions"]
    assert page.index("identity.input") > page.index(">command<")


def test_every_chart_is_well_formed_and_inside_its_box(make_record: MakeRecord) -> None:
    record = make_record(90, bad={7: ("bridged", "too few inliers")})
    charts = re.findall(r"<svg viewBox=\"0 0 (\d+) (\d+)\" role.*?</svg>", render_report(record, scored(record)), re.S)
    pages = re.findall(r"<svg viewBox=\"0 0 \d+ \d+\" role.*?</svg>", render_report(record, scored(record)), re.S)
    assert len(charts) == len(pages) >= 13
    for (width, height), chart in zip(charts, pages, strict=True):
        root = ElementTree.fromstring(chart)
        for element in root.iter():
            assert "nan" not in "".join(element.attrib.values()).lower().replace("data:image", "")[:200]
            if element.tag == "text":
                assert 0 <= float(element.attrib["x"]) <= float(width)
                assert 0 <= float(element.attrib["y"]) <= float(height)
            if element.attrib.get("class", "").startswith("line"):
                numbers = np.array(re.findall(r"-?[\d.]+(?:e-?\d+)?", element.attrib["d"]), float).reshape(-1, 2)
                assert (numbers >= -0.1).all()
                assert (numbers <= [float(width) + 0.1, float(height) + 0.1]).all()


def test_values_and_recipes_stand_on_the_page(make_record: MakeRecord) -> None:
    record = make_record(90)
    evaluation = replace(scored(record), words=("thesis",))
    text = parse(render_report(record, evaluation)).text
    assert "thesis" not in parse(render_report(record, scored(record))).text
    for alignment in ("se3", "origin"):
        translation = evaluation.ate[alignment].translation
        assert translation is not None
        assert f"{translation.rmse:.3f}" in text
    assert "ATE rmse, se3" in text
    assert f"{evaluation.scores['kitti_drift'].translation_percent:.3f}" in text
    assert f"{evaluation.scores['thesis1'].thesis_rmse:.3f}" in text
    assert f"{evaluation.scores['thesis2'].ate_mean:.3f}" in text
    assert evaluation.rpe[1].name in text
    assert "90 of 90 poses matched" in text
    for title in ("Height", "Error per axis", "Error per angle", "Position uncertainty", "Residual", "Overlap"):
        assert title in text
    assert "roll" in text
    assert "lslam run drive" in text
    assert "sequence.format" in text
    assert "Nothing: all 90 scans were registered" in text


def test_what_went_wrong_is_said(make_record: MakeRecord) -> None:
    record = make_record(
        40,
        bad={5: ("bridged", "too few inliers: 12"), 9: ("skipped", "000009.bin is truncated")},
        problems=["2 of 40 scans were not registered"],
        manifest={"status": "degraded", "problems": ["2 of 40 scans were not registered"]},
    )
    record.results[20] = replace(record.results[20], degenerate=np.array([[0, 0.98, 0.2, 0, 0, 0]]))
    text = parse(render_report(record, None)).text
    for sentence in ("degraded", "too few inliers: 12", "000009.bin is truncated", "along y", "1 pose was degenerate"):
        assert sentence in text
    assert text.count("2 of 40 scans were not registered") == 1
    assert "Nothing: all" not in text


@pytest.mark.parametrize("status", ["diverged", "interrupted", "failed"])
def test_a_run_that_ended_badly_never_reads_as_flawless(make_record: MakeRecord, status: str) -> None:
    text = parse(render_report(make_record(10, manifest={"status": status}), None)).text
    assert f"The run ended as {status}" in text
    assert "Nothing: all" not in text


def test_names_cannot_inject(make_record: MakeRecord) -> None:
    evil = "<script>alert('x')</script>\"&"
    loop = LoopCandidate(0, 5, 1.0, 0.1, Verdict.REJECTED, LoopStage.GATE, evil)
    record = make_record(
        12,
        name=evil,
        loops=[loop],
        keyframe_scans=np.arange(12),
        bad={3: ("bridged", evil)},
        problems=[evil],
        manifest={"status": evil, evil: {"a": [evil]}},
    )
    for i, result in enumerate(record.results):
        record.results[i] = replace(result, stages={evil: 0.01, "read": 0.001})
    (record.folder / "config.toml").write_text(f"# {evil}\n</pre>")
    evaluation = replace(scored(record), estimate=evil, notes=[evil], association=evil)
    page = render_report(record, evaluation)
    parsed = parse(page)
    assert [kind for kind, _ in parsed.scripts] == ["application/json"] * 3 + [""]
    assert "alert" not in parsed.scripts[-1][1]
    assert json.loads(parsed.scripts[2][1])["reasons"] == {"3": evil}
    assert json.loads(parsed.scripts[1][1])["candidates"][0]["reason"] == evil
    assert parsed.handlers == []
    assert parsed.text.count("alert('x')") >= 8


def test_without_ground_truth_the_rest_stands(make_record: MakeRecord) -> None:
    text = parse(render_report(make_record(30, with_truth=False), None)).text
    assert "No ground truth is known" in text
    for title in ("Trajectory from above", "Colour by", "Time per scan", "Inliers", "Position uncertainty"):
        assert title in text
    assert "Error per axis" not in text
    assert "could not be compared" in parse(render_report(make_record(30), None)).text


def test_a_method_without_details_says_so(make_record: MakeRecord) -> None:
    record = make_record(30, with_details=False, with_map=False, manifest={}, method="kiss-icp")
    text = parse(render_report(record, None)).text
    assert "kiss-icp reports neither inliers" in text
    assert "kiss-icp gives no covariance" in text
    assert "No map was made" in text
    assert "recorded no manifest" in text


@pytest.mark.parametrize("scans", [0, 1, 2, 3])
def test_very_short_runs(make_record: MakeRecord, scans: int) -> None:
    record = make_record(max(scans, 1))
    if scans == 0:
        empty = Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
        record = replace(record, results=[], trajectory=empty, ground_truth=None)
    parsed = parse(render_report(record, scored(record) if scans >= 3 else None))
    assert f"{scans} scans" in parsed.text


def test_standing_still_and_driving_straight(make_record: MakeRecord) -> None:
    record = make_record(20)
    still = replace(record.trajectory, poses=np.tile(np.eye(4), (20, 1, 1)))
    parse(render_report(replace(record, trajectory=still), None))
    straight = np.tile(np.eye(4), (20, 1, 1))
    straight[:, 0, 3] = np.arange(20)
    truth = replace(record.trajectory, poses=straight)
    evaluation = evaluate(truth, truth)
    text = parse(render_report(replace(record, trajectory=truth, ground_truth=truth), evaluation)).text
    assert "n/a (collinear)" in text
    assert "first poses coincide (origin)" in text


def test_values_that_are_not_finite_break_nothing(make_record: MakeRecord) -> None:
    record = make_record(30)
    poses = record.trajectory.poses.copy()
    poses[10:15, :3, 3] = np.nan
    results = [replace(r, rmse=np.inf, overlap=np.nan, covariance=np.full((6, 6), np.nan)) for r in record.results]
    results[4] = replace(results[4], stages={"read": np.nan}, covariance=None)
    image = np.full((5, 5), np.nan, np.float32)
    image[2, 2] = 3
    broken = replace(
        record,
        results=results,
        map_image=image,
        map_heights=np.full((5, 5), np.nan, np.float32),
        map_sample=ArrayCloud.of([[np.nan, 0, 0], [1, 2, np.inf], [1, 2, 3]], [np.nan, 1, 1]),
        trajectory=replace(record.trajectory, poses=poses),
        real_time_limit=0.0,
    )
    page = render_report(broken, None)
    parse(page)
    for chart in re.findall(r"<svg viewBox=\"0 0 \d+ \d+\" role.*?</svg>", page, re.S):
        assert not re.search(r"\b(nan|inf)\b", chart)


def test_written_whole_or_not_at_all(make_record: MakeRecord, tmp_path: Path) -> None:
    record = make_record(10)
    write_report(tmp_path / "report.html", record, None)
    assert (tmp_path / "report.html").read_text(encoding="utf-8").endswith("</html>\n")
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    with pytest.raises(OutputError, match=r"report\.html cannot be written"):
        write_report(tmp_path / "missing" / "report.html", record, None)


def test_same_record_same_bytes(make_record: MakeRecord) -> None:
    record = make_record(50)
    assert render_report(record, scored(record)) == render_report(record, scored(record))


def test_ten_thousand_scans_stay_quick_and_small(make_record: MakeRecord) -> None:
    """With as much of a map as a page takes, and a picture that no compression makes smaller."""
    record = make_record(10_000, bad=dict.fromkeys(range(0, 10000, 3), ("bridged", "too few inliers: 12 of 3000")))
    reason = "old to new and new to old differ by 0.05 m and 0.61 deg"
    record.loops = [
        LoopCandidate(k, k + 99, 9.0, 0.3, Verdict.REJECTED, LoopStage.AGREEMENT, reason) for k in range(4000)
    ]
    record.keyframe_scans = np.arange(0, 10_000, 2)
    cloud = np.random.default_rng(5).uniform(-60, 60, (FEW_POINTS, 3)).astype(np.float32)
    record.pair_views = [PairView(c, cloud, cloud, np.eye(4), np.eye(4)) for c in record.loops[:MOST_VIEWS]]
    rng = np.random.default_rng(0)
    record.map_image, record.map_heights = (
        rng.poisson(2.0, (1600, 1600)).astype(np.float32),
        rng.uniform(0, 9, (1600, 1600)),
    )
    record.map_sample = ArrayCloud.of(rng.uniform(0, 900, (150_000, 3)), rng.uniform(0, 1, 150_000))
    evaluation = scored(record)
    began = time.perf_counter()
    page = render_report(record, evaluation)
    assert time.perf_counter() - began < 15.0  # measured 2.4 s on a busy machine, the picture made twice
    assert len(page) < 6_000_000


def test_flatten_keeps_order_and_leaves_out_the_empty() -> None:
    tree = {"status": "done", "b": {"c": 1.23456789, "d": None, "e": True}, "a": [], "list": [1, "two"], "text": ""}
    assert flatten(tree) == [("b.c", ["1.23457"]), ("b.e", ["yes"]), ("list", ["1", "two"])]
