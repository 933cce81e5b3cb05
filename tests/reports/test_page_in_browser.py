"""Pages as a browser shows them: without complaints, moved by mouse and keys, the right scan under the pointer.

Skipped without selenium, chromium and chromedriver (`pip install 'lslam[browser]'`, `apt-get install chromium-driver`).
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import click, find, hover, load, picture, settle
from comparisons import comparison, drawing
from merged_sessions import sessions, write
from reported_study import study_rows

from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.run_record import RunRecord
from lslam.evaluation.evaluate import evaluate
from lslam.evaluation.metric import Evaluation
from lslam.evaluation.sensitivity import evaluate_study
from lslam.reports.compare_html import write_page
from lslam.reports.html import write_report
from lslam.reports.picture import COLOURS
from lslam.reports.png import palette
from lslam.reports.study_table import write_study_files

pytest.importorskip("selenium")

from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys

SCANS = 60
MOVED = 0.04  # share of pixels that are others; the ring about what has the focus is 0.01


@pytest.fixture
def run(make_record: Callable[..., RunRecord], tmp_path: Path) -> tuple[Path, RunRecord, Evaluation]:
    """A report whose map is a floor with one high block on it, in the west."""
    rng = np.random.default_rng(0)
    floor, block = (
        rng.uniform((-10, -5, 0), (60, 35, 0.1), (40_000, 3)),
        rng.uniform((0, 20, 8), (10, 30, 9), (5000, 3)),
    )
    record = make_record(
        SCANS, bad={7: ("bridged", "too few <b>inliers</b>")}, map_sample=ArrayCloud.of([*floor, *block])
    )
    assert record.ground_truth is not None
    evaluation = evaluate(record.trajectory, record.ground_truth)
    write_report(tmp_path / "report.html", record, evaluation)
    return tmp_path / "report.html", record, evaluation


def said(browser: Any) -> str:
    return str(find(browser, "#said").text)


@pytest.mark.parametrize(("width", "dark"), [(400, True), (1600, False)])
def test_it_opens_without_complaint_and_shows_the_map(browser: Any, run: Any, width: int, dark: bool) -> None:
    page, _, _ = run
    load(browser, page, width, dark=dark)
    assert browser.get_log("browser") == []
    assert (
        browser.execute_script(
            "return performance.getEntriesByType('resource').filter(e => !e.name.startsWith('data:')).length"
        )
        == 0
    )
    assert browser.execute_script("return document.documentElement.scrollWidth") <= width
    brightness = picture(browser, "h1").mean()
    assert brightness < 80 if dark else brightness > 175
    shown = picture(browser)
    low, high = palette()[0].astype(int), palette()[-1].astype(int)
    floor, block = (np.abs(shown - colour).max(axis=2) < 24 for colour in (low, high))
    assert floor.mean() > 0.1
    # The block is a square of 10 m on a map of 70 m by 40 m, in its upper left.
    rows, columns = np.nonzero(block)
    assert np.ptp(columns) == pytest.approx(np.ptp(rows), abs=6)
    assert columns.mean() < shown.shape[1] / 2
    assert rows.mean() < shown.shape[0] / 2
    across = np.flatnonzero(floor.any(axis=0))
    assert np.ptp(columns) / np.ptp(across) == pytest.approx(10 / 70, abs=0.02)


def test_the_map_zooms_turns_and_comes_back_by_keys_and_buttons(browser: Any, run: Any) -> None:
    load(browser, run[0])
    canvas = find(browser, "canvas.lines")
    whole = picture(browser)
    canvas.send_keys("+")
    near = picture(browser)
    assert (whole != near).any(axis=2).mean() > MOVED
    canvas.send_keys(Keys.ARROW_LEFT)
    assert (near != picture(browser)).any(axis=2).mean() > MOVED
    canvas.send_keys("0")
    assert (whole != picture(browser)).any(axis=2).mean() < MOVED / 2
    click(browser, "[data-do=turn]")
    turned = picture(browser)
    # Points and what is drawn over them are put in their places by two programs.
    x, y = browser.execute_script("return [...mapView.project([5, 25, 8.5])]")
    rows, columns = np.nonzero(np.abs(turned - palette()[-1].astype(int)).max(axis=2) < 24)
    assert (columns.mean(), rows.mean()) == pytest.approx((x, y), abs=6)
    assert (whole != turned).any(axis=2).mean() > MOVED
    assert find(browser, "[data-do=turn]").get_attribute("aria-pressed") == "true"
    canvas.send_keys(Keys.ARROW_RIGHT)
    assert (turned != picture(browser)).any(axis=2).mean() > MOVED
    click(browser, "[data-do=flat]")
    browser.execute_script(
        "const s = document.querySelector('select'); s.value = 'error'; s.dispatchEvent(new Event('change'))"
    )
    assert (whole != picture(browser)).any(axis=2).mean() > MOVED
    assert "position error" in find(browser, ".ramp .said").text


def test_the_pointer_on_the_map_finds_the_scan(browser: Any, run: Any) -> None:
    page, record, evaluation = run
    load(browser, page)
    canvas = find(browser, "canvas.lines")
    x0, x1, y0, y1 = record.map_extent
    size = canvas.rect
    metres = 1.04 * max((x1 - x0) / size["width"], (y1 - y0) / size["height"])
    for k in (12, 30):
        x, y, _ = record.trajectory.positions[k]
        hover(
            browser,
            canvas,
            size["width"] / 2 + (x - (x0 + x1) / 2) / metres,
            size["height"] / 2 - (y - (y0 + y1) / 2) / metres,
        )
        text = said(browser)
        assert f"scan {k}\n" in text or f"scan {k} " in text
        assert f"stamp {record.trajectory.stamps_ns[k]} ns" in text
        assert f"{x:.2f}".replace("-", "−") in text
        error = np.linalg.norm(evaluation.ate["se3"].errors[k])
        assert f"error (se3) {error:.3f} m" in text


def test_a_chart_marks_its_scan_in_all_plots_and_zooms(browser: Any, run: Any) -> None:
    page, _, evaluation = run
    load(browser, page)
    chart = find(browser, "svg[aria-label='Position error']")
    x0, x1, _, _, left, right, *_ = map(float, chart.get_attribute("data-view").split())
    scale = chart.rect["width"] / 480
    at = scale * (left + (evaluation.distance[7] - x0) / (x1 - x0) * (right - left))
    hover(browser, chart, at, 100 * scale)
    assert "bridged" in said(browser)
    assert "too few <b>inliers</b>" in said(browser)
    assert find(browser, "#time").get_attribute("value") == "7"
    plane = find(browser, "svg[aria-label='trajectory from above']")
    px0, px1, _, _, pleft, pright, *_ = map(float, plane.get_attribute("data-view").split())
    drawn = float(plane.find_element("css selector", ".cursor").get_attribute("cx"))
    place = evaluation.ate["se3"].aligned_positions[7, 0]
    assert px0 + (drawn - pleft) / (pright - pleft) * (px1 - px0) == pytest.approx(place, abs=0.01)
    # Twice as near by one turn of the wheel about the pointer, once it was clicked: what is under it stays.
    ActionChains(browser, duration=0).click().perform()
    browser.execute_script(
        "const [svg, x] = arguments; const box = svg.getBoundingClientRect(); svg.dispatchEvent(new WheelEvent('wheel',"
        " { deltaY: -Math.log(2) / 0.0015, clientX: box.left + x, clientY: box.top + 50, cancelable: true }))", chart, at,
    )  # fmt: skip
    matrix = chart.find_element("css selector", "g.data").get_attribute("transform")
    kx, _, _, ky, shift, _ = map(float, re.findall(r"-?[\d.e-]+", matrix))
    assert (kx, ky) == (pytest.approx(2.0), pytest.approx(1.0))
    assert kx * at / scale + shift == pytest.approx(at / scale, abs=0.5)
    assert "moved" in chart.get_attribute("class")
    chart.send_keys("0")
    assert "moved" not in chart.get_attribute("class")
    chart.send_keys(".")
    settle(browser)
    assert find(browser, "#time").get_attribute("value") == "8"


def test_the_slider_moves_by_keys_and_says_the_scan(browser: Any, run: Any) -> None:
    load(browser, run[0], 400)
    slider = find(browser, "#time")
    slider.send_keys(Keys.END)
    settle(browser)
    assert f"scan {SCANS - 1}" in said(browser)
    slider.send_keys(Keys.ARROW_LEFT)
    settle(browser)
    assert slider.get_attribute("aria-valuetext").startswith(f"scan {SCANS - 2}; time 5.800 s")
    unnamed = browser.execute_script(
        "return [...document.querySelectorAll('[tabindex], button, input, select')].filter(e => !(e.getAttribute('aria-label')"
        " || e.textContent.trim() || e.labels?.length)).map(e => e.outerHTML.slice(0, 80))"
    )
    assert unnamed == []


def test_without_scripts_or_webgl_and_on_paper_the_drawing_stands(browser: Any, run: Any) -> None:
    def seen(selector: str) -> bool:
        return bool(find(browser, selector).is_displayed())

    load(browser, run[0], media="print")
    assert seen(".stage svg")
    assert not seen("canvas.lines")
    assert not seen(".now")
    browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": True})
    try:
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
        browser.refresh()
        assert seen(".stage svg")
        assert not seen(".now")
        assert not seen(".tools")
        assert browser.find_elements("css selector", ".stage canvas") == []
        assert "too few <b>inliers</b>" in find(browser, "section.first").text
    finally:
        browser.execute_cdp_cmd("Emulation.setScriptExecutionDisabled", {"value": False})
    hidden = "HTMLCanvasElement.prototype.getContext = () => null"
    key = browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": hidden})
    try:
        load(browser, run[0])
        assert browser.get_log("browser") == []
        assert seen(".stage svg")
        assert browser.find_elements("css selector", ".stage canvas") == []
        chart = find(browser, ".stage svg")
        chart.send_keys("+")
        assert "moved" in chart.get_attribute("class")
    finally:
        browser.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", key)


def test_a_long_run_and_one_of_no_scan_open(
    browser: Any, make_record: Callable[..., RunRecord], tmp_path: Path
) -> None:
    for name, record in (("long", make_record(2000)), ("none", replace(make_record(3), results=[]))):
        trajectory = record.trajectory if record.results else record.trajectory.select(slice(0))
        path = tmp_path / f"{name}.html"
        write_report(path, replace(record, trajectory=trajectory), None)
        load(browser, path, 400)
        assert browser.get_log("browser") == []


def test_a_comparison_zooms(browser: Any, tmp_path: Path) -> None:
    page = tmp_path / "compare.html"
    write_page(page, comparison(tmp_path), [drawing(tmp_path)])
    load(browser, page, 400)
    assert browser.get_log("browser") == []
    assert browser.execute_script("return document.documentElement.scrollWidth") <= 400
    chart = find(browser, ".half > svg")
    before = [tick.text for tick in chart.find_elements("css selector", "g.ticks text")]
    chart.send_keys("+++")
    assert [tick.text for tick in chart.find_elements("css selector", "g.ticks text")] != before


def test_merged_runs_lie_on_one_map_and_the_pointer_names_session_and_scan(browser: Any, tmp_path: Path) -> None:
    load(browser, write(tmp_path / "merge.html"))
    assert browser.get_log("browser") == []
    bare = picture(browser)
    click(browser, "[data-do=turn]")
    assert (bare != picture(browser)).any(axis=2).mean() > MOVED
    click(browser, "[data-do=flat]")
    place = sessions()[1].after[31]
    x, y = browser.execute_script("return [...mapView.project(arguments[0])]", place.tolist())
    hover(browser, find(browser, "canvas.lines"), x, y)
    name, scan = browser.execute_script(
        "const { session, k } = mapView.pointed; return [session.name, session.index[k]]"
    )
    assert (name, scan) == ("tuesday", 231)
    disc = picture(browser)[round(y) - 2 : round(y) + 3, round(x) - 2 : round(x) + 3]
    assert disc.max() < 80  # of ink, on a light floor


def test_a_figure_of_a_study_says_the_value_under_the_pointer(browser: Any, tmp_path: Path) -> None:
    rows = study_rows()
    write_study_files(tmp_path, evaluate_study(rows), rows, "study")
    load(browser, tmp_path / "report.html", 1000)
    assert browser.get_log("browser") == []
    frame = find(browser, ".picture")
    points = browser.execute_script("return JSON.parse(arguments[0].querySelector('script').textContent)", frame)
    x, y, text = next(p for p in points if p[2].startswith("loam+imu, input.skip_frames 3"))
    size = frame.rect
    hover(browser, frame, x * size["width"], y * size["height"])
    # Both curves have it.
    assert find(browser, ".told").text == f"{text.replace('loam+imu', 'icp')}; {text}"
    frame.click()
    frame.send_keys("+.")
    settle(browser)
    assert find(browser, ".told").text.startswith("icp, input.skip_frames 4")
    # Zoomed: the ring lies about the next point of the curve.
    ring = find(browser, ".ring").rect
    around = picture(browser, ".ring")
    assert (ring["width"], ring["height"]) == (15, 15)
    middle = around[6:9, 6:9].reshape(-1, 3)
    curve = [int(COLOURS[1][i : i + 2], 16) for i in (1, 3, 5)]  # drawn last
    assert np.abs(middle - curve).max(axis=1).min() < 60
