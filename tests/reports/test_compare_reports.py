"""A comparison as text, CSV, LaTeX, JSON and page."""

from __future__ import annotations

import base64
import csv
import io
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from comparisons import comparison, drawing, row, walls
from point_writers import write_points
from scipy.spatial import cKDTree
from test_html import parse
from test_page_data import data_of, unpack

from lslam.core.config.outputs import EvalConfig
from lslam.core.types.comparison import SeedStatistics
from lslam.reports.compare_html import render_page, time_figure
from lslam.reports.compare_table import recipes, render, tables, to_document
from lslam.reports.png import Crop, choose_crops, crop_images
from lslam.studies.results import metrics_of


def test_one_row_per_method_with_spread_failures_and_words_for_what_is_missing(tmp_path: Path) -> None:
    main, pairs, differences, degraded, failures = tables(comparison(tmp_path))
    cells = [dict(zip(main.header, line, strict=True)) for line in main.rows]
    assert cells[0]["ATE se3, m"] == "0.100 ± 0.020"
    assert cells[1]["bridged/skipped/degenerate/recovered"] == "1.5/-/-/-"
    assert cells[2]["ATE se3, m"] == "no ground truth"
    assert cells[3]["ATE se3, m"] == "failed"
    assert [c["runs"] for c in cells] == ["2/2", "2/2, 1 degraded", "1/1", "0/1"]
    assert pairs.rows == (("kiss-icp", "icp", "1", "3.000", "0/0/2", "n too small"),)
    assert differences.rows[0][-2:] == ("1.500", "0.500")
    assert degraded.rows == (("drive", "kiss-icp", "0", "1 scan <bridged>"),)
    assert failures.rows == (("dark", "kiss-icp", "0", "crashed", "killed & gone_by 100%"),)


def test_scans_that_a_policy_posed_are_called_recovered_and_the_cell_a_mean_over_runs(tmp_path: Path) -> None:
    (line,) = [
        line for line in recipes(comparison(tmp_path)) if line.startswith("bridged/skipped/degenerate/recovered:")
    ]
    assert "mean over the runs of all seeds" in line
    assert "recovery policy or a fallback" in line
    (metric,) = [m for m in metrics_of([EvalConfig()], []) if m.key == "fallback"]
    assert metric.label == "recovered"


def test_the_best_of_several_methods_is_marked_per_sequence(tmp_path: Path) -> None:
    main = tables(comparison(tmp_path))[0]
    column = main.header.index
    assert {cell for cell in main.best if cell[1] in (column("ATE se3, m"), column("mean, ms"))} == {
        (0, column("ATE se3, m")), (0, column("mean, ms")),
    }  # fmt: skip
    assert not [cell for cell in main.best if cell[0] > 1]


def test_times_of_shared_machines_are_marked_and_never_best(tmp_path: Path) -> None:
    slow = row("drive", "b", {"time.mean": SeedStatistics(2.0, 0.0, 1)}, is_timed_alone=False)
    fast = row("drive", "a", {"time.mean": SeedStatistics(1.0, 0.0, 1)})
    main = tables(comparison(tmp_path, rows=(fast, slow)))[0]
    assert [line[main.header.index("mean, ms")] for line in main.rows] == ["1.0", "~2.0"]
    assert not main.best


def test_bars_and_table_show_the_same_number_and_name_it(tmp_path: Path) -> None:
    c = comparison(tmp_path)
    main, figure = tables(c)[0], time_figure(c, "drive")
    assert figure is not None
    shown = {line[1]: line[main.header.index("mean, ms")] for line in main.rows if line[0] == "drive"}
    assert dict(re.findall(r">([\w-]+): mean ([\d.]+) ms", figure.svg)) == shown == {"icp": "12.0", "kiss-icp": "40.0"}
    # A bar is as long as that number says.
    lengths = dict.fromkeys(shown, 0.0)
    rows = sorted({float(y) for y in re.findall(r'<rect [^>]*y="([\d.]+)"', figure.svg)})
    for y, width in re.findall(r'<rect [^>]*y="([\d.]+)" width="([\d.]+)"', figure.svg):
        lengths[list(shown)[rows.index(float(y))]] += float(width)
    assert lengths["kiss-icp"] / lengths["icp"] == pytest.approx(40.0 / 12.0, abs=0.02)
    assert any(line.startswith("ms: mean over scans") for line in recipes(c))
    assert figure.title.startswith("Mean")


def test_the_limit_crosses_bars_and_no_label(tmp_path: Path) -> None:
    figure = time_figure(comparison(tmp_path), "drive")
    assert figure is not None
    assert {style[0] for style, _ in figure.legend} == {"t"}, "stages have shades, and methods colours"
    (line,) = re.findall(r'class="limit" d="([^"]+)"', figure.svg)
    pieces = [(float(y), float(y) + float(dy)) for y, dy in re.findall(r"M[\d.]+ ([\d.]+)v([\d.]+)", line)]
    bars = sorted({float(y) for y in re.findall(r'<rect [^>]*y="([\d.]+)"', figure.svg)})
    labels = [float(y) for y in re.findall(r'class="label over"[^>]* y="([\d.]+)"', figure.svg)]
    assert len(pieces) == len(bars) == 2
    assert all(a < y < b for (a, b), y in zip(pieces, bars, strict=True))
    assert len(labels) == 2
    assert not [y for y in labels for a, b in pieces if a < y < b]


def test_a_narrow_terminal_gets_errors_and_times_apart(tmp_path: Path) -> None:
    c = comparison(tmp_path)
    whole = tables(c)[0]
    assert tables(c, whole.width)[0].header == whole.header
    errors, times = tables(c, whole.width - 1)[:2]
    assert (errors.title, times.title) == ("errors", "mean time per scan")
    assert [*errors.header, *times.header[2:]] == list(whole.header)


def test_csv_has_a_row_per_run_and_numbers_in_full(tmp_path: Path) -> None:
    rows = list(csv.DictReader(io.StringIO(render(comparison(tmp_path), "csv"))))
    assert [r["status"] for r in rows] == ["done", "degraded", "done", "crashed"]
    assert [r["ate.se3 (m)"] for r in rows] == ["0.1", "0.3", "", ""]
    assert rows[3]["reason"] == "killed & gone_by 100%"


def test_latex_is_escaped_and_balanced(tmp_path: Path) -> None:
    text = render(comparison(tmp_path), "tex")
    assert r"killed \& gone\_by 100\%" in text
    assert r"0.100 $\pm$ 0.020" in text
    assert text.count(r"\begin{tabular}") == text.count(r"\end{tabular}") == 5
    for line in text.splitlines():
        assert line.startswith(("%", "\\")) or not line or line.endswith(r"\\")


def test_every_table_of_markdown_has_equal_rows(tmp_path: Path) -> None:
    for block in re.findall(r"(?:^\|.*\n?)+", render(comparison(tmp_path), "md"), re.MULTILINE):
        assert len({line.count("|") for line in block.strip().splitlines()}) == 1


def test_json_is_strict_and_carries_recipes(tmp_path: Path) -> None:
    document = json.loads(json.dumps(to_document(comparison(tmp_path)), allow_nan=False))
    assert document["paired"][0]["p"] is None
    assert document["runs"][0]["stages_s"]["register"] == 0.01
    assert document["recipes"] == recipes(comparison(tmp_path))
    assert any("Wilcoxon" in line for line in document["recipes"])


def test_the_page_nests_shows_everything_and_needs_nothing_else(tmp_path: Path) -> None:
    c = comparison(tmp_path)
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "report.html").write_text("")
    parsed = parse(render_page(tmp_path, c, [drawing(tmp_path)]))
    assert not parsed.open
    assert [kind for kind, _ in parsed.scripts] == ["application/json", "application/json", ""]
    assert not parsed.handlers
    assert all(a.startswith("data:image/png;base64,") or a == "a/report.html" for a in parsed.addresses)
    assert "a/report.html" in parsed.addresses
    for word in (
        "killed & gone_by 100%",
        "no ground truth",
        "kiss-icp: mean 40.0 ms",
        "icp: mean 12.0 ms",
        "others were using",
        "1 failed",
    ):
        assert word.lower() in parsed.text.lower()


def test_the_page_of_a_comparison_in_which_all_failed_says_so(tmp_path: Path) -> None:
    c = comparison(tmp_path)
    c = replace(c, runs=c.failed, rows=c.rows[3:], sequences=("dark",), pairs=(), differences=())
    parsed = parse(render_page(tmp_path, c, []))
    assert "No run on this sequence has a result" in parsed.text


def test_without_ground_truth_the_distance_from_the_first_is_drawn_and_not_called_an_error(tmp_path: Path) -> None:
    bare = drawing(tmp_path, has_truth=False)
    page = render_page(tmp_path, comparison(tmp_path), [bare])
    assert "Position error" not in page
    assert "Distance from" not in page
    first, second = bare.runs
    apart = replace(second, distance=np.linspace(0, 60, 50), errors=np.full(50, 0.7))
    page = render_page(tmp_path, comparison(tmp_path), [replace(bare, runs=(first, apart), reference="icp")])
    assert "Position error" not in page
    (figure,) = re.findall(r"<h3>Distance from icp</h3>.*?</figure>", page, re.S)
    assert figure.count('class="line s2"') == 2, "one line and its entry in the legend"
    assert 'class="line s1"' not in figure
    assert (
        "No ground truth: from the same start, how far each is from icp, which may be the one that is wrong" in figure
    )


def test_all_trajectories_and_the_ground_truth_lie_on_the_map_of_the_first_method(tmp_path: Path) -> None:
    shown = drawing(tmp_path)
    page = render_page(tmp_path, comparison(tmp_path), [shown])
    ways = data_of(page, "sessions")["sessions"]
    assert [(way["name"], way["style"]) for way in ways] == [("ground truth", "gt"), ("icp", "s1"), ("kiss-icp", "s2")]
    assert shown.gt_positions is not None
    for way, positions in zip(ways, [shown.gt_positions, *(run.positions for run in shown.runs)], strict=True):
        np.testing.assert_allclose(unpack(way["positions"], "<f4").reshape(-1, 3), positions, atol=1e-5)
    cloud = data_of(page, "cloud")
    q = unpack(cloud["points"], "<i2").reshape(-1, 3)
    shown_points = np.array(cloud["low"]) + np.array(cloud["step"]) * (q + 32768.0)
    assert len(shown_points) == len(walls())
    assert cKDTree(walls()).query(shown_points)[0].max() < 0.01
    assert "Points: map of icp" in page
    # Another sequence has its chart: one cloud is as much as a page carries.
    both = [shown, replace(shown, sequence="dark")]
    assert render_page(tmp_path, comparison(tmp_path), both).count('id="cloud"') == 1
    assert "Trajectories from above" in render_page(tmp_path, comparison(tmp_path), both)
    bare = replace(shown, runs=tuple(replace(run, map_file=None) for run in shown.runs))
    page = render_page(tmp_path, comparison(tmp_path), [bare])
    assert 'id="cloud"' not in page
    assert "Trajectories from above" in page


def test_the_first_table_has_no_time_of_a_single_stage_and_a_table_below_has_them(tmp_path: Path) -> None:
    page = render_page(tmp_path, comparison(tmp_path), [])
    heads = [
        re.findall(r'<th scope="col"[^>]*>([^<]+)', table)
        for table in re.findall(r"<table class=\"sortable\">.*?</table>", page, re.S)
    ]
    first, stages = heads
    assert "ATE se3, m".replace(", ", ",\u00a0") in first
    assert not [head for head in first if head.startswith("read")]
    assert [head for head in stages if head.startswith("read")]


def test_ten_thousand_scans_of_two_methods_stay_small(tmp_path: Path) -> None:
    shown = drawing(tmp_path)
    along = np.linspace(0, 9000, 10_000)
    way = np.stack([along, 50 * np.sin(along / 99), along / 300], 1)
    cloud = np.random.default_rng(0).uniform((-50, -60, 0), (9050, 60, 40), (400_000, 3))
    write_points(tmp_path / "icp.ply", cloud)
    runs = tuple(replace(run, positions=way, distance=along, errors=along / 1000) for run in shown.runs)
    page = render_page(tmp_path, comparison(tmp_path), [replace(shown, runs=runs, gt_positions=way)])
    assert len(page) < 6_000_000


def test_crops_lie_on_structure_and_never_on_bare_ground() -> None:
    crops = choose_crops(walls(), size=20.0)
    assert len(crops) == 1
    x0, x1, y0, y1 = crops[0].extent
    assert x0 <= 26
    assert x1 >= 34
    assert y0 <= 7
    assert y1 >= 13
    assert choose_crops(walls()[:10]) == []
    assert choose_crops(np.zeros((0, 3))) == []


def test_several_crops_do_not_overlap() -> None:
    many = np.concatenate([walls(shift) for shift in (0.0, 35.0, 70.0)])
    centres = [(c.x, c.y) for c in choose_crops(many, size=20.0)]
    assert len(centres) == 3
    assert all(max(abs(a[0] - b[0]), abs(a[1] - b[1])) >= 20 for i, a in enumerate(centres) for b in centres[:i])


def test_maps_are_compared_at_the_same_place_in_one_world_and_one_grey(tmp_path: Path) -> None:
    """The second map lies 5 m off in its own world and is moved there by T_drawing_world: the pictures are equal."""
    page = render_page(tmp_path, comparison(tmp_path), [drawing(tmp_path)], (30.04, 10.03, 20.0))
    images = re.findall(r"data:image/png;base64,([^\"]+)", page.partition("The same places in each map")[2])
    assert len(images) == 2
    assert base64.b64decode(images[0]) == base64.b64decode(images[1])
    faint = walls()[::3]
    (dark, light, absent), top = crop_images([walls(), faint, None], Crop(30.0, 10.0, 20.0))
    assert absent is None
    assert dark is not None
    assert light is not None
    assert dark.max() >= top > light.max()
    assert dark[:, 100:].sum() > 0


def test_rows_of_a_crop_are_y_downwards() -> None:
    (image,), _ = crop_images([np.array([[1.0, 9.0, 0.0]])], Crop(0.0, 0.0, 20.0))
    assert image is not None
    assert np.argwhere(image).tolist() == [[9, 110]]


@pytest.mark.parametrize("style", ["text", "md", "tex"])
def test_notes_and_recipes_stand_under_the_tables(tmp_path: Path, style: str) -> None:
    text = render(comparison(tmp_path), style)
    assert "others were using the machine" in text
    assert "alignment se3" in text
    with pytest.raises(ValueError, match="table style"):
        render(comparison(tmp_path), "pdf")
