"""The plan: a PNG whose pixels are where the grid says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from lslam.reports.plans import bar_length, write_plan
from lslam.simulation.plan import BORDER, COARSE, COLOURS, FINEST, PATH, plan_of
from lslam.simulation.scenarios import SimulatedDrive, simulate


def read_png(path: Path) -> np.ndarray:
    """(H, W, 3) uint8."""
    return np.rint(255 * imread(path)[..., :3]).astype(np.uint8)


@pytest.fixture(scope="module")
def drive() -> SimulatedDrive:
    return simulate("block")


def test_a_plan_shows_houses_path_and_grid_in_their_places(drive: SimulatedDrive, tmp_path: Path) -> None:
    line = drive.city_poses[:, :3, 3]
    plan = plan_of(drive.scene, drive.city, line)
    (width, depth), image = plan.high - plan.low, plan.image.astype(int)
    write_plan(tmp_path / "plan.png", plan)
    written = read_png(tmp_path / "plan.png")
    places = np.concatenate([line[:, :2], *drive.city.footprints])
    low = np.floor(places.min(axis=0) - BORDER)
    assert image.shape[:2] == (round(depth / FINEST), round(width / FINEST))

    def pixel(xy: np.ndarray) -> np.ndarray:
        column, row = np.floor((xy - low) / FINEST).astype(int)
        return image[image.shape[0] - 1 - row, column]

    for xy in line[1::10, :2]:
        np.testing.assert_array_equal(pixel(xy), (214, 30, 40))
    # Roofs and walls are reddish, grass is greenish.
    reddish = [np.subtract(*pixel(f.mean(axis=0))[[0, 1]]) > 15 for f in drive.city.footprints]
    assert np.mean(reddish) > 0.85
    grass = pixel(low + 0.6 * BORDER)
    assert grass[1] > grass[0] > 100
    # A labelled line of the grid darkens its column from top to bottom.
    metre = np.ceil(low[0] / COARSE) * COARSE
    column = int((metre - low[0]) / FINEST)
    beside = image[:, column + 3].mean() - image[:, column].mean()
    assert beside > 30
    # The picture is the view as it is, but for the metres at its edges, with the key below.
    inside = np.s_[: plan.image.shape[0] - 40, 60:]
    np.testing.assert_array_equal(written[: plan.image.shape[0]][inside], plan.image[inside])
    key = written[plan.image.shape[0] :].reshape(-1, 3)
    for colour in [COLOURS[surface] for surface in plan.surfaces] + [np.array(PATH)]:
        assert (key == colour).all(axis=1).sum() > 100, "a patch of every colour that is seen"
    # Beside letters and the arrow, the only long black line is the black half of the scale bar.
    black = (written[plan.image.shape[0] :] < 40).all(axis=2)
    runs = [len(run) for row in black for run in "".join("x" if b else " " for b in row).split()]
    assert max(runs) == pytest.approx(bar_length(width) / FINEST, abs=6)


def test_a_large_scene_stays_a_small_picture(tmp_path: Path) -> None:
    made = simulate("motorway", count=2)
    plan = plan_of(made.scene, made.city, made.vehicle.poses(np.array([0.0, 30.0]))[:, :3, 3])
    write_plan(tmp_path / "plan.png", plan)
    assert plan.high[0] - plan.low[0] > 900
    assert 1990 <= max(plan.image.shape[:2]) <= 2001
    assert read_png(tmp_path / "plan.png").shape[1] == plan.image.shape[1]
    assert len(COLOURS) == len(set(map(tuple, COLOURS.tolist())))
