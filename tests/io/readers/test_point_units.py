"""Coordinates in cm and mm are found by ranges, ground and noise, and metres are left alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from point_writers import packed, revolution

from lslam.io.formats.sequence_toml import LENGTHS, SequenceInfo, write_sequence_toml
from lslam.io.readers import open_sequence
from lslam.io.readers.sequence_on_disk import find_unit


def room(seed: int, height_m: float = 1.7, size: float = 1.0) -> NDArray[np.float64]:
    """Points (N, 3), m, of a sensor so high above the ground, in a room `size` times as wide as that of `revolution`."""
    columns = revolution(seed)
    along = np.column_stack([columns[name] for name in "xyz"])
    along /= np.linalg.norm(along, axis=1)[:, None]
    with np.errstate(divide="ignore"):
        walls = np.where(along > 0, [9.3 * size, 5.2 * size, 40], [-8.4 * size, -6.1 * size, -height_m]) / along
    r = walls.min(1) + np.random.default_rng(seed).normal(0, 0.02, len(along))
    return np.asarray(r[:, None] * along)


@pytest.mark.parametrize("unit", ["cm", "mm"])
@pytest.mark.parametrize("is_whole", [True, False])
@pytest.mark.parametrize(("height_m", "size"), [(1.7, 1.0), (0.4, 0.6), (1.9, 3.0), (2.5, 1.5)])
def test_units_are_told_apart(unit: str, is_whole: bool, height_m: float, size: float) -> None:
    scans = [room(seed, height_m, size) / LENGTHS[unit] for seed in range(3)]
    found, sentence = find_unit([np.round(points) if is_whole else points for points in scans])
    assert found == unit
    assert f"points in {unit}, found" in sentence


@pytest.mark.parametrize("height_m", [80.0, 1500.0])
def test_what_flies_stays_in_metres(height_m: float) -> None:
    rng = np.random.default_rng(0)
    down = np.column_stack([rng.uniform(-0.4 * height_m, 0.4 * height_m, (9000, 2)), rng.normal(-height_m, 0.03, 9000)])
    assert find_unit([down])[0] == "m"
    # Without noise nothing tells: metres, and a problem that names the key.
    down[:, 2] = -height_m
    found, sentence = find_unit([down])
    assert found is None
    assert "taken to be in m, though" in sentence
    assert "point_unit" in sentence


def _folder(folder: Path, unit: str, words: str) -> Path:
    folder.mkdir()
    for k in range(3):
        points = room(k) / LENGTHS[unit]
        columns = revolution(k) | dict(zip("xyz", np.round(points).T if unit != "m" else points.T, strict=True))
        (folder / f"{k}.bin").write_bytes(packed(columns, words))
    return folder


@pytest.mark.parametrize("words", ["x y z intensity", "x y z intensity ring time"])
def test_scans_come_in_metres(words: str, tmp_path: Path) -> None:
    for unit, length in LENGTHS.items():
        s = open_sequence(_folder(tmp_path / unit, unit, words))
        np.testing.assert_allclose(s.scan(1).points, room(1), atol=0.51 * length if unit != "m" else 1e-5)
        assert [f"points in {unit}" in note for note in s.notes].count(True) == (unit != "m")


def test_the_unit_can_be_stated(tmp_path: Path) -> None:
    folder = _folder(tmp_path / "a", "cm", "x y z intensity")
    write_sequence_toml(folder / "sequence.toml", SequenceInfo(point_unit="mm"))
    s = open_sequence(folder)
    np.testing.assert_allclose(s.scan(1).points, room(1) / 10, atol=0.00051)
    assert "points in mm, as stated" in s.notes
