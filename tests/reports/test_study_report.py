"""The report of a study written from rows of known truth: files, tables, page; failures appear."""

from __future__ import annotations

import csv
import io
import re
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread
from reported_study import SHARE, SKIP, row, study_rows

from lslam.core.config.study import ExpectedFinding
from lslam.core.types.study import StudyResult, StudyRow
from lslam.evaluation.sensitivity import evaluate_study
from lslam.reports.picture import COLOURS
from lslam.reports.study_figures import StudyFigure, study_figures
from lslam.reports.study_table import means_grid, study_tables, timing_notes, write_study_files


@pytest.fixture(scope="module")
def rows() -> list[StudyRow]:
    return study_rows()


@pytest.fixture(scope="module")
def results(rows: list[StudyRow]) -> list[StudyResult]:
    finding = ExpectedFinding(text="holds <up> to 5", kind="holds_up_to", values=(5,), source="figure 5.16")
    return evaluate_study(rows, [finding, finding.model_copy(update={"values": (8.0,), "method": "icp"})])


@pytest.fixture(scope="module")
def figures(results: list[StudyResult]) -> dict[str, StudyFigure]:
    return {figure.name: figure for figure in study_figures(results[0])}


@pytest.fixture(scope="module")
def folder(rows: list[StudyRow], results: list[StudyResult], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("study") / "report"
    write_study_files(out, results, rows, "Skipped & counted")
    return out


def test_every_figure_is_written_as_png_and_svg(folder: Path) -> None:
    names = {path.stem for path in (folder / "figures").glob("*.png")}
    figures = ("errors", "zoom", "times", "stages", "law", "efficiency")
    assert names == {f"skip-open-skip_frames-{name}" for name in figures}
    for name in names:
        assert (folder / "figures" / f"{name}.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
        ET.fromstring((folder / "figures" / f"{name}.svg").read_text())


def test_every_point_lies_where_its_curve_is_drawn_and_says_what_it_is(figures: dict[str, StudyFigure]) -> None:
    for name in ("errors", "times", "stages", "law", "efficiency"):
        drawn = np.rint(255 * imread(io.BytesIO(figures[name].png), format="png")[..., :3])
        height, width = drawn.shape[:2]
        colours = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in COLOURS])
        for x, y, text in figures[name].points:
            column, line = round(x * width - 0.5), round(y * height - 0.5)
            around = drawn[max(line - 2, 0) : line + 3, max(column - 2, 0) : column + 3].reshape(-1, 3)
            assert np.abs(around[:, None] - colours).max(axis=2).min() < 60, (name, text)
    texts = {point.text for point in figures["errors"].points}
    assert {"loam+imu, input.skip_frames 3, rmse of translation 0.5 ± 0 m", "icp, input.skip_frames 6, lost"} <= {
        text.replace("more than half of the runs lost", "lost") for text in texts
    }
    assert len(texts) == 2 * (8 + 5 + 3) - 3  # a cross is in both plots
    assert "icp, map, input.skip_frames 2, time per scan 40 ms" in {p.text for p in figures["stages"].points}
    assert "loam+imu, input.skip_frames 4, total time 10 s" in {p.text for p in figures["law"].points}


def test_keys_of_one_name_in_two_sections_have_figures_of_their_own(tmp_path: Path) -> None:
    keys = ("registration.inlier_distance", "imu.inlier_distance")
    rows = [row(v, 0, "icp", parameters={key: v}) for key in keys for v in (1.0, 2.0, 3.0)]
    write_study_files(tmp_path, evaluate_study(rows), rows, "two")
    assert {f.name for f in (tmp_path / "figures").glob("*-errors.png")} == {
        f"skip-open-{key}-errors.png" for key in keys
    }


def test_figures_show_what_they_are_named_after(figures: dict[str, StudyFigure]) -> None:
    text = {name: figure.svg.decode() for name, figure in figures.items()}
    assert "rmse of translation, m" in text["errors"]
    assert {"kiss-icp, beside", "icp", "loam+imu"} <= set(re.findall(r">([^<>]+)</text>", text["errors"]))
    # icp is lost somewhere, so the zoom is of the other.
    assert "loam+imu" in text["zoom"]
    assert ">icp<" not in text["zoom"]
    assert "loam+imu: T = 40 / skip_frames s, R2 1.000" in text["law"]
    # Five values of icp make no law.
    assert "icp: T" not in text["law"]
    assert {"scan", "map"} <= set(re.findall(r">(\w+)</text>", text["stages"]))
    assert ">read<" not in text["stages"]
    assert "figure 5.20" in figures["efficiency"].caption


def test_legends_lie_below_the_axes_and_within_the_picture(figures: dict[str, StudyFigure]) -> None:
    for name in ("errors", "zoom", "times", "efficiency"):
        texts = [t for t in ET.fromstring(figures[name].svg).iter("{http://www.w3.org/2000/svg}text") if t.get("y")]
        height = {text.text: float(text.get("y", "")) for text in texts}
        assert 250 < height[SKIP] + 10 < height["loam+imu"] < 302, name  # pt of 302.4, from above; a line is 9 high


def test_figures_are_the_same_bytes_again(figures: dict[str, StudyFigure], folder: Path) -> None:
    for name, figure in figures.items():
        assert (folder / "figures" / f"skip-open-skip_frames-{name}.svg").read_bytes() == figure.svg


def test_page_is_whole_escaped_and_needs_no_other_file(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    assert page.count("<img ") == 6
    assert not re.search(r'(?:src|href)="(?!data:)', page)
    assert "Skipped &amp; counted" in page
    assert "holds &lt;up&gt; to 5" in page
    assert '<span class="badge undecided">' not in page
    assert page.count('<span class="badge confirmed">') == 1
    assert page.count('<span class="badge refuted">') == 1
    assert '<span class="badge diverged">7 without a result</span>' in page
    assert "killed &amp; gone_by 100%" in page
    assert "lslam sweep STUDY --jobs 1" not in page


def test_page_says_when_times_cannot_be_compared(rows: list[StudyRow], tmp_path: Path) -> None:
    """Of runs that have a result."""
    some = [replace(r, is_timing_comparable=k == 1) for k, r in enumerate(rows[:4])]
    shared = [*some, replace(rows[-2], is_timing_comparable=False)]
    (note,) = timing_notes(shared)
    assert note.startswith("3 of 4 runs shared a core or ran on a cluster: times of this study cannot be compared")
    assert note.endswith("lslam sweep STUDY --out DIR"), "they were one at a time already"
    (advice,) = timing_notes([replace(r, at_once=2) for r in shared])
    assert advice.endswith("lslam sweep STUDY --jobs 1 --out DIR")
    write_study_files(tmp_path, evaluate_study(shared), shared, "study")
    assert note in (tmp_path / "report.html").read_text()
    assert timing_notes(rows) == []


def test_tables_hold_landmarks_laws_and_failures(results: list[StudyResult]) -> None:
    tables = {table.title: table for table in study_tables(results[0])}
    landmarks = {r[0]: r[1:] for r in tables["landmarks of input.skip_frames"].rows}
    assert landmarks["icp"] == ("6", "5", "1", "1 to 5", "1", "6/16")
    assert landmarks["loam+imu"] == ("nowhere", "-", "1", "1 to 8", "1", "0/16")
    laws = {r[0]: r[1:] for r in tables["laws of total time"].rows}
    assert laws["icp"][0] == "no law from 5 values, 6 are needed"
    assert laws["loam+imu"][0] == "T = 40 / skip_frames"
    assert tables["beside, at its own values"].rows[0][:3] == ("kiss-icp", "0", "0.250")
    failed = tables["7 runs without a result"].rows
    assert failed[-1] == ("loam+imu", "skip_frames 9", "0", "crashed", "killed & gone_by 100%")
    assert {r[3] for r in failed} == {"crashed", "diverged"}


def test_means_stand_in_all_tables_alike(folder: Path, results: list[StudyResult]) -> None:
    grid = list(csv.reader(io.StringIO((folder / "report.csv").read_text())))
    assert grid == means_grid(results)
    head, first = grid[0], grid[1]
    said = dict(zip(head, first, strict=True))
    assert (said["method"], said["value"], said["runs"], said["lost"]) == ("icp", "1", "2", "0")
    # 1 / (0.5 m x 2 deg x 0.1 s) and 1 / (0.5 m x 2 deg x 40 s).
    assert float(said["efficiency (1/(m deg s))"]) == pytest.approx(10)
    assert float(said["total_efficiency (1/(m deg s))"]) == pytest.approx(0.025)
    assert float(said["time_per_scan (ms)"]) == pytest.approx(100)
    text = (folder / "report.md").read_text()
    assert (
        "| icp | 1 | 0.500 ± 0.000 | 2.000 ± 0.000 | 100.0 ± 0.0 | 40.00 ± 0.00 | 12.5 ± 0.0 | 1.00 | 0.20 | 0/2 |"
        in text
    )
    assert "| loam+imu | 9 | - | - | - | - | - | - | - | 0/0 |" in text
    latex = (folder / "report.tex").read_text()
    assert latex.count(r"\begin{tabular}") == latex.count(r"\end{tabular}") == 6
    assert r"gone\_by 100\%" in latex


def test_study_of_two_parameters_draws_the_product_law_and_many_curves() -> None:
    shares = (0.1, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)
    rows = [
        row(v, 0, "icp", parameters={SKIP: v, SHARE: share}, total_time_s=152.2 * share / v)
        for share in shares
        for v in (1, 2, 4, 8, 16)
    ]
    results = evaluate_study(rows)
    svg = {figure.name: figure.svg.decode() for figure in study_figures(results[0])}
    assert "icp: T = 152.2 random_share / skip_frames s, R2 1.000" in svg["law"]
    assert all(f"random_share {share:g}" in svg["errors"] for share in shares)
    laws = next(table for table in study_tables(results[0]) if table.title == "laws of total time")
    assert laws.rows[0][:2] == ("icp", "T = 152.2 random_share / skip_frames")


def test_axes_and_columns_say_the_unit_of_the_key() -> None:
    (result,) = evaluate_study([row(v, 0, "icp", parameters={"map.voxel": v, SKIP: k}, total_time_s=v / k)
                                for v in (0.1, 0.2, 0.4) for k in (1, 2, 4)])  # fmt: skip
    svg = {figure.name: figure.svg.decode() for figure in study_figures(result)}
    assert svg["errors"].count(">map.voxel, m</text>") == svg["times"].count(">map.voxel, m</text>") == 2
    assert ">voxel 0.4 m</text>" in svg["law"]
    assert ">input.skip_frames</text>" in svg["law"]
    assert next(table for table in study_tables(result) if table.title == "means over seeds").header[1] == "voxel, m"


def test_panels_of_stages_reach_the_longest_of_all() -> None:
    rows = [
        row(v, 0, method, stages_ms={"scan": top, "map": 1.0})
        for v in (1, 2)
        for method, top in (("a", 10.0), ("b", 90.0))
    ]
    stages = {f.name: f for f in study_figures(evaluate_study(rows)[0])}["stages"].svg.decode()
    # The axis that both panels share has a tick near the larger of the two.
    assert any(float(tick) >= 80 for tick in re.findall(r">(\d+)</text>", stages))


@pytest.mark.parametrize(("smallest", "is_logarithmic"), [(0.5, False), (0.02, True)])
def test_errors_over_orders_of_magnitude_fill_a_logarithmic_axis(smallest: float, is_logarithmic: bool) -> None:
    rows = [row(k + 1, 0, "icp", thesis_rmse=smallest * (2.0 / smallest) ** (k / 4)) for k in range(5)]
    errors = ET.fromstring(next(iter(study_figures(evaluate_study(rows)[0]))).svg)
    # Equal ratios are equal distances on a logarithmic axis only; the first axes' points are drawn first.
    heights = [float(mark.get("y", "")) for mark in errors.iter("{http://www.w3.org/2000/svg}use") if _is_point(mark)][
        :5
    ]
    steps = -np.diff(heights)
    assert heights[0] - heights[-1] > 80
    assert bool(np.ptp(steps) < 0.01 * steps.max()) is is_logarithmic


def _is_point(mark: ET.Element) -> bool:
    """Whether it is a point of the first curve, in its colour."""
    return "#0072b2" in mark.get("style", "") and "stroke" in mark.get("style", "")


def test_words_are_ticks_of_their_own() -> None:
    rows = [row(1, 0, "icp", parameters={"preprocess.downsample": word}) for word in ("random", "grid", "voxel")]
    errors = next(iter(study_figures(evaluate_study(rows)[0]))).svg.decode()
    assert {"random", "grid", "voxel"} <= set(re.findall(r">(\w+)</text>", errors))


def test_study_whose_runs_all_failed_has_a_page_that_says_why(tmp_path: Path) -> None:
    rows = [row(v, 0, "icp", status="failed", reason="no scan could be read", thesis_rmse=float("nan")) for v in (1, 2)]
    write_study_files(tmp_path, evaluate_study(rows), rows, "dark")
    page = (tmp_path / "report.html").read_text()
    assert "No run of this study has a result to draw." in page
    assert page.count("no scan could be read") == 2
    assert not list((tmp_path / "figures").iterdir())
