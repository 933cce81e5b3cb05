"""The plan: a PNG whose pixels are where the grid says."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest

from lslam.simulation.plan import BORDER, COARSE, COLOURS, FINEST, write_plan
from lslam.simulation.scenarios import SimulatedDrive, simulate


def read_png(path: Path) -> np.ndarray:
    """An independent reader of what `png` writes."""
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    at, chunks = 8, {}
    while at < len(data):
        (length,), kind = struct.unpack(">I", data[at : at + 4]), data[at + 4 : at + 8]
        body = data[at + 8 : at + 8 + length]
        assert struct.unpack(">I", data[at + 8 + length : at + 12 + length])[0] == zlib.crc32(kind + body)
        chunks[kind] = body
        at += 12 + length
    width, height, depth, colour = struct.unpack(">IIBB", chunks[b"IHDR"][:10])
    assert (depth, colour) == (8, 2)
    raw = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), np.uint8).reshape(height, 1 + 3 * width)
    assert not raw[:, 0].any()
    return raw[:, 1:].reshape(height, width, 3)


@pytest.fixture(scope="module")
def drive() -> SimulatedDrive:
    return simulate("block")


def test_a_plan_shows_houses_path_and_grid_in_their_places(drive: SimulatedDrive, tmp_path: Path) -> None:
    line = drive.city_poses[:, :3, 3]
    width, depth = write_plan(tmp_path / "plan.png", drive.scene, drive.city, line)
    image = read_png(tmp_path / "plan.png").astype(int)
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


def test_a_large_scene_stays_a_small_picture(tmp_path: Path) -> None:
    made = simulate("motorway", count=2)
    width, _ = write_plan(
        tmp_path / "plan.png", made.scene, made.city, made.vehicle.poses(np.array([0.0, 30.0]))[:, :3, 3]
    )
    image = read_png(tmp_path / "plan.png")
    assert width > 900
    assert 1990 <= max(image.shape[:2]) <= 2001
    assert len(COLOURS) == len(set(map(tuple, COLOURS.tolist())))
