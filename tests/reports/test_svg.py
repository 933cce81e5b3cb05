"""The drawing itself: ticks, thinning, the stacked times, the map's image."""

from __future__ import annotations

import io
import re
from xml.etree import ElementTree

import numpy as np
import pytest

from lslam.reports.plots import stage_chart
from lslam.reports.png import density_png
from lslam.reports.shell import template
from lslam.reports.svg import Frame, Line, Track, finite_runs, line_chart, number, plane_chart, thin, ticks


@pytest.mark.parametrize("low", [-1234.5, -0.031, 0.0, 1e-7, 5.4e6])
@pytest.mark.parametrize("span", [1e-6, 0.02, 1.0, 7.3, 99.0, 12_345.0])
def test_ticks_are_round_inside_and_neither_few_nor_many(low: float, span: float) -> None:
    values = ticks(low, low + span)
    assert 2 <= len(values) <= 9
    assert min(values) >= low - 1e-6 * span
    assert max(values) <= low + span * (1 + 1e-6)
    steps = np.diff(values)
    # Beside 5.4e6 a step of 1e-7 is at the edge of float64.
    np.testing.assert_allclose(steps, steps[0], rtol=1e-2)


def test_whole_ticks_count_scans() -> None:
    assert ticks(0, 2.5, 6, whole=True) == [0.0, 1.0, 2.0]


@pytest.mark.parametrize(
    ("value", "span", "text"),
    [(0.0, 1.0, "0"), (-0.25, 1.0, "−0.25"), (150.0, 700.0, "150"), (2e6, 1e6, "2e+06"), (0.0125, 0.05, "0.0125")],
)
def test_numbers_are_written_short(value: float, span: float, text: str) -> None:
    assert number(value, span) == text


def test_thinning_keeps_every_peak_of_a_bin() -> None:
    rng = np.random.default_rng(2)
    x, y = np.arange(10_000.0), rng.normal(0, 1, 10_000)
    y[[1234, 7777]] = 50, -50
    tx, ty = thin(x, y, bins=100)
    assert len(tx) <= 202
    assert (np.diff(tx) > 0).all()
    for block in range(100):
        part = slice(block * 100, block * 100 + 100)
        inside = (tx >= x[part][0]) & (tx <= x[part][-1])
        assert ty[inside].max() == y[part].max()
        assert ty[inside].min() == y[part].min()


def test_thinning_ignores_missing_values() -> None:
    x, y = np.arange(5000.0), np.sin(np.arange(5000.0))
    y[::7] = np.nan
    _, ty = thin(x, y, bins=50)
    assert np.isfinite(ty[1:-1]).all()
    assert np.nanmax(ty) == np.nanmax(y)


def test_short_series_are_left_alone() -> None:
    x, y = np.arange(5), np.array([3, np.nan, 1, 2, 5])
    tx, ty = thin(x, y)
    assert np.array_equal(tx, x)
    assert np.array_equal(ty, y, equal_nan=True)


def test_runs_of_finite_values() -> None:
    assert finite_runs(np.array([np.nan, 1, 2, np.inf, 3])) == [slice(1, 3), slice(4, 5)]
    assert finite_runs(np.zeros(0)) == []


def test_a_line_breaks_at_a_hole_and_a_lone_value_is_a_dot() -> None:
    chart = line_chart([Line("a", np.arange(6), np.array([1, 2, np.nan, 3, np.nan, 4]), "s1")], "x", "y", "t")
    assert chart.count('class="line s1"') == 1
    assert chart.count("<circle") == 2


def test_nothing_finite_is_no_chart() -> None:
    assert line_chart([Line("a", np.arange(3), np.full(3, np.nan), "s1")], "x", "y", "t") == ""
    assert line_chart([], "x", "y", "t") == ""
    assert plane_chart([Track("a", np.zeros((0, 2)), "s1")], "t") == ""


def test_axes_map_ends_to_ends() -> None:
    frame = Frame((10.0, 20.0), (-1.0, 1.0))
    assert (frame.px(10.0), frame.px(20.0)) == (frame.left, frame.right)
    assert (frame.py(-1.0), frame.py(1.0)) == (frame.bottom, frame.top)


@pytest.mark.parametrize("value", [0.0, 1e-12, -3.0, 5.4e6])
def test_one_value_has_a_range_around_it(value: float) -> None:
    frame = Frame((value, value), (value, value))
    assert frame.left <= frame.px(value) <= frame.right
    assert np.isfinite(frame.py(value))
    assert ticks(frame.x0, frame.x1)


@pytest.mark.parametrize("size", [(100.0, 50.0), (50.0, 100.0), (800.0, 1.0)])
def test_the_plane_has_one_scale(size: tuple[float, float]) -> None:
    corners = np.array([[0, 0], [size[0], 0], [size[0], size[1]], [0, size[1]]])
    chart = plane_chart([Track("a", corners, "s1")], "t")
    data = re.search(r'class="line s1" d="M([^"]+)"', chart)
    assert data
    drawn = np.array(re.findall(r"[\d.]+", data[1]), float).reshape(-1, 2)
    drawn_size = np.ptp(drawn, axis=0)
    assert drawn_size[0] / size[0] == pytest.approx(drawn_size[1] / size[1], abs=0.2 / min(size))
    assert drawn[0, 1] > drawn[2, 1]  # y is up


def areas(chart: str) -> list[float]:
    """Area of each stacked layer, SVG units squared (shoelace)."""
    found = []
    for element in ElementTree.fromstring(chart).iter():
        if element.attrib.get("class", "").startswith("area"):
            x, y = np.array(re.findall(r"-?[\d.]+", element.attrib["d"]), float).reshape(-1, 2).T
            found.append(abs(float(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))) / 2)
    return found


@pytest.mark.parametrize("scans", [1, 2, 50, 3000])
def test_areas_are_the_shares_of_the_stages(scans: int) -> None:
    rng = np.random.default_rng(scans)
    ms = np.array([1.0, 3.0, 6.0]) * rng.uniform(0.8, 1.2, (scans, 3))
    chart, _ = stage_chart(np.arange(scans), ms, 0.0, "t")
    drawn = np.array(areas(chart))
    np.testing.assert_allclose(drawn / drawn.sum(), ms.sum(0) / ms.sum(), atol=0.01)


def test_a_limit_outside_of_the_axes_is_noted() -> None:
    ms = np.full((20, 2), 20.0)
    near, _ = stage_chart(np.arange(20), ms, 100.0, "t")
    assert 'class="limit"' in near
    assert "real-time limit 100 ms" in near
    far, _ = stage_chart(np.arange(20), ms / 20, 100.0, "t")
    assert 'class="limit"' not in far
    assert "real-time limit 100 ms lies above" in far
    none, _ = stage_chart(np.arange(20), ms, 0.0, "t")
    assert "limit" not in none


def test_a_clipped_peak_is_noted() -> None:
    ms = np.full((200, 1), 10.0)
    ms[3] = 2000.0
    chart, remark = stage_chart(np.arange(100, 300), ms, 100.0, "t")
    assert remark == "One scan is cut off: 2000 ms at scan 103."
    assert areas(chart)[0] > 0.5 * 414 * 194  # the other scans still fill the chart


def test_the_density_image_is_a_png_with_alpha() -> None:
    image_module = pytest.importorskip("PIL.Image")
    density = np.zeros((5, 7))
    density[1, 2], density[4, 6], density[0, 0] = 1, 30, np.nan
    picture = image_module.open(io.BytesIO(density_png(density)))
    assert picture.size == (7, 5)
    alpha = np.asarray(picture.convert("RGBA"))[..., 3]
    assert alpha[4, 6] == 255
    assert 0 < alpha[1, 2] < 255
    assert np.count_nonzero(alpha) == 2


def test_an_empty_density_image_is_transparent() -> None:
    image_module = pytest.importorskip("PIL.Image")
    picture = image_module.open(io.BytesIO(density_png(np.zeros((3, 3)))))
    assert np.asarray(picture.convert("RGBA"))[..., 3].max() == 0


def test_every_stage_has_a_colour_of_its_own() -> None:
    """Seven with an IMU; the style sheet must tell the classes apart, in light and dark."""
    chart, _ = stage_chart(np.arange(20), np.ones((20, 7)), 0.0, "t")
    classes = re.findall(r'class="area (s\d+)"', chart)
    assert len(set(classes)) == 7
    style = template("style.html.j2").render()
    colours = dict(re.findall(r"\.(s\d+) \{ color: var\((--c\d)\); \}", style))
    for part in style.split("prefers-color-scheme: dark", 1):
        values = dict(re.findall(r"(--c\d): (#\w+)", part))
        assert len({values[colours[name]] for name in classes}) == 7
