"""`lslam plot`: a figure of each kind, of the size that was asked for, and what a run does not have."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from calling import SAMPLE, assert_one_sentence, lslam

import lslam as lslam_api
from lslam.core.config import load_config
from lslam.evaluation.metric import AbsoluteError
from lslam.pipeline.plot_run import gather_figure
from lslam.reports.figures import draw_figure
from lslam.reports.picture import house_style

WALLS = SAMPLE / "sequences" / "00" / "map_perturbed.osm"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("plot") / "run"
    words = ("--method", "loam", "--osm", WALLS, "--georeference", "--set", "report.html=false")
    done = lslam("run", SAMPLE, "--out", out, "-q", *words)
    assert done.returncode == 0, done.stderr
    return out


def size(png: bytes) -> tuple[int, int]:
    width, height = struct.unpack(">II", png[16:24])
    return width, height


@pytest.mark.parametrize("what", ["map", "trajectory", "errors", "features", "imu", "buildings"])
def test_each_figure_fits_a_column_and_is_not_blank(run: Path, tmp_path: Path, what: str) -> None:
    from matplotlib.image import imread

    done = lslam("plot", run, "--what", what, "--out", tmp_path / "a.png")
    assert done.returncode == 0, done.stderr
    assert size((tmp_path / "a.png").read_bytes())[0] == pytest.approx(300 * 88.9 / 25.4, abs=2)
    pixels = imread(tmp_path / "a.png")[..., :3]
    assert 0.005 < float((pixels.min(axis=2) < 0.9).mean()) < 0.9


def test_the_same_bytes_twice_and_the_size_of_a_page(run: Path, tmp_path: Path) -> None:
    for name in ("a.svg", "b.svg"):
        words = ("--what", "trajectory", "--width", "page", "--font", 10, "--out", tmp_path / name)
        assert lslam("plot", run, *words).returncode == 0
    text = (tmp_path / "a.svg").read_text()
    assert text == (tmp_path / "b.svg").read_text()
    assert 'width="515.6' in text, "points of 181.9 mm"
    assert "font-size: 10px" in text


def T_gt_est_R(absolute: AbsoluteError) -> np.ndarray:
    return absolute.T_gt_est[:3, :3]


def test_errors_are_in_the_axes_of_the_lidar(run: Path) -> None:
    """The planar error is that of x and y of the body, and no larger than the whole."""
    plotted = gather_figure(run, "errors")
    assert plotted.evaluation is not None
    planar, _ = draw_figure(plotted, "errors").axes
    ahead, left, up, both = (np.asarray(line.get_ydata()) for line in planar.get_lines())
    np.testing.assert_allclose(np.hypot(ahead, left), both, atol=1e-12)
    absolute = plotted.evaluation.ate["se3"]
    whole = np.linalg.norm(absolute.errors, axis=1)
    # Estimate minus truth: who is ahead of it has a positive error ahead.
    axes = np.stack([T_gt_est_R(absolute) @ pose[:3, 0] for pose in plotted.trajectory.poses])
    np.testing.assert_allclose(
        ahead, np.einsum("ni,ni->n", axes, absolute.aligned_positions - plotted.evaluation.gt_positions), atol=1e-9
    )
    np.testing.assert_allclose(np.hypot(both, up), whole, atol=1e-9)


@pytest.mark.parametrize("width", [70.0, 88.9])
def test_labels_of_errors_stay_beside_their_plots(run: Path, width: float) -> None:
    with house_style(8.0):
        figure = draw_figure(gather_figure(run, "errors"), "errors", width)
        figure.draw_without_rendering()
        upper, lower = (plot.yaxis.label.get_window_extent() for plot in figure.axes)
    assert lower.y1 < upper.y0
    assert lower.y0 >= 0.0


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("--what", "maps", "--out", "a.png"), 2, "no figure 'maps'; did you mean 'map'"),
        (("--what", "map", "--out", "a.gif"), 2, "a.gif"),
        (("--what", "map", "--out", "a.png", "--width", "wide"), 2, "column, page, or mm"),
        (("--what", "map", "--out", "a.png", "--font", "100"), 2, "3 to 72 points"),
        (("--what", "map", "--out", "there.png"), 2, "exists"),
        (("--what", "errors", "--gt", "none.txt", "--out", "a.png"), 3, "none.txt does not exist"),
    ],
)
def test_what_cannot_be_drawn_is_one_sentence(
    run: Path, tmp_path: Path, words: tuple[str, ...], code: int, said: str
) -> None:
    (tmp_path / "there.png").touch()
    done = lslam("plot", run, *words, cwd=tmp_path)
    assert done.returncode == code
    assert said in done.stderr
    assert_one_sentence(done.stderr)
    assert not (tmp_path / "a.png").exists()


def test_what_a_run_does_not_have_is_said(tmp_path: Path) -> None:
    done = lslam("run", SAMPLE, "--count", 8, "--out", tmp_path / "run", "-q", "--set", "map.write=false")
    assert done.returncode == 0, done.stderr
    for what, said in (("map", "has no map"), ("features", "has no features"), ("buildings", "has no buildings")):
        done = lslam("plot", tmp_path / "run", "--what", what, "--out", tmp_path / "a.png", "-q")
        assert done.returncode == 3
        assert said in done.stderr


def test_an_outcome_draws_its_buildings_on_its_map(tmp_path: Path) -> None:
    settings = [f"osm.extract='{WALLS}'", "gnss.mode=fit", "input.count=60", "report.html=false"]
    outcome = lslam_api.run(SAMPLE, load_config(None, settings), out=tmp_path / "run")
    assert outcome.plot("buildings").axes[0].collections, "the map beneath"
