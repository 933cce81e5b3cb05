"""`--colour` as a user calls it: simulated, run, mapped again in every format, and refused in one sentence."""

from __future__ import annotations

import shutil
from pathlib import Path

import laspy
import numpy as np
import pytest
from calling import SAMPLE, assert_one_sentence, lslam, strict_json

from lslam.io.formats.ply_files import ply_columns


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short drive with a camera, and a run of it with colours."""
    root = tmp_path_factory.mktemp("colour")
    done = lslam("simulate", "block", "--scans", 6, "--lidar", "hdl64", "--camera", "--out", root / "town", "-q")
    assert done.returncode == 0, done.stderr
    done = lslam("run", root / "town", "--colour", "--no-loops", "--out", root / "run", "-q")
    assert done.returncode == 0, done.stderr
    (root / "said.txt").write_text(done.stdout)
    return root / "run"


def test_a_run_has_a_coloured_map_and_counts_what_is_grey(ran: Path) -> None:
    columns = ply_columns(ran / "map.ply")
    colours = np.stack([columns[c] for c in ("red", "green", "blue")], axis=1)
    unseen = int((colours == 128).all(1).sum())
    counts = strict_json((ran / "manifest.json").read_text())["map_colour"]
    assert counts == {"points": len(colours), "unseen": unseen, "images": 5, "outside": 0, "unreadable": 0}
    assert 0 < unseen < len(colours)
    done = strict_json((ran / "map.json").read_text())["done"]
    said = f"{len(colours) - unseen} of {len(colours)} points from 5 images; {unseen} that none shows are grey"
    assert done == [f"coloured: {said}"]
    assert f"  colour       {said}\n" in (ran.parent / "said.txt").read_text()


def test_a_map_built_anew_has_the_same_colours_in_every_format(ran: Path, tmp_path: Path) -> None:
    plain = ply_columns(ran / "map.ply")
    done = lslam("map", ran, "--colour", "--out", tmp_path / "again.ply", "--json")
    assert done.returncode == 0, done.stderr
    document = strict_json(done.stdout)["colour"]
    assert document["images"] == 5
    again = ply_columns(tmp_path / "again.ply")
    same = np.all([again[c] == plain[c] for c in ("red", "green", "blue")], axis=0)
    # Poses of trajectory.tum are rounded: a point on the edge of two pixels may fall on the other.
    assert same.mean() > 0.995
    done = lslam("map", ran, "--colour", "--out", tmp_path / "a.laz", "-q")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[1].startswith("colour     ")
    las = laspy.read(tmp_path / "a.laz")
    assert (np.asarray(las.red) == 257 * again["red"].astype(int)).all()
    assert lslam("map", ran, "--colour", "--tiles", 50, "--out", tmp_path / "tiles", "-q").returncode == 0
    tile = next((tmp_path / "tiles").glob("*.ply"))
    assert "red" in ply_columns(tile)


def test_what_cannot_be_coloured_is_one_sentence(ran: Path, tmp_path: Path) -> None:
    done = lslam("run", SAMPLE, "--colour", "--out", tmp_path / "run")
    assert done.returncode == 3
    assert "has no images that lslam reads" in done.stderr
    assert_one_sentence(done.stderr)
    assert not (tmp_path / "run").exists()
    folder = ran.parent / "town" / "sequences" / "00"
    text = (folder / "front" / "times.txt").read_text()
    try:
        (folder / "front" / "times.txt").write_text("\n".join(f"{900 + k}" for k in range(5)))
        done = lslam("map", ran, "--colour", "--out", tmp_path / "a.ply", "-q")
        assert done.returncode == 3
        assert "share no time with its scans: they run from 900.000 to 904.000 s, the scans from 0.000" in done.stderr
        assert_one_sentence(done.stderr)
        assert not (tmp_path / "a.ply").exists()
    finally:
        (folder / "front" / "times.txt").write_text(text)


def test_images_are_not_read_unless_asked_for(ran: Path, tmp_path: Path) -> None:
    folder = ran.parent / "town" / "sequences" / "00"
    hidden = (folder / "front").rename(folder / "hidden")
    try:
        done = lslam("map", ran, "--set", "map.colour=false", "--out", tmp_path / "a.ply", "-q")
        assert done.returncode == 0, done.stderr
        assert "red" not in ply_columns(tmp_path / "a.ply")
    finally:
        hidden.rename(folder / "front")


def test_a_merge_says_that_it_has_no_colours(ran: Path, tmp_path: Path) -> None:
    done = lslam("merge", ran, ran.parent / "town", "--set", "map.colour=true", "--out", tmp_path / "town")
    assert done.returncode == 2
    assert "merged maps have no colours; those of their runs have, by lslam map RUN --colour" in done.stderr
    assert_one_sentence(done.stderr)
    assert not (tmp_path / "town").exists()


def test_a_run_whose_images_are_broken_ends_with_a_map_and_says_so(ran: Path, tmp_path: Path) -> None:
    shutil.copytree(ran.parent / "town", tmp_path / "town")
    images = sorted((tmp_path / "town").rglob("*.png"))
    assert images
    for image in images:
        image.write_bytes(image.read_bytes()[:60])
    done = lslam("run", tmp_path / "town", "--colour", "--no-loops", "--out", tmp_path / "run", "-q")
    assert done.returncode == 0, done.stderr
    assert "can colour its map" in done.stdout
    manifest = strict_json((tmp_path / "run" / "manifest.json").read_text())
    assert manifest["status"] == "degraded"
    assert "map_colour" not in manifest
    columns = ply_columns(tmp_path / "run" / "map.ply")
    assert "red" not in columns
    assert len(columns["x"]) == len(ply_columns(ran / "map.ply")["x"])
