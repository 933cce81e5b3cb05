"""Classes of points choose what walls are made of: in one cloud, in keyframes, and in whole runs on a map."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from wall_scenes import misfit, noisy, plain, upright

import lslam
from lslam.backend.keyframes.store import KeyframeStore, PartOfStore, submap, submap_labels
from lslam.core.config import Config, load_config
from lslam.core.config.input import PreprocessConfig
from lslam.core.errors import InputError
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.trajectory import Keyframe
from lslam.odometry.frontend.keyframing import keyframe_cloud, keyframe_labels
from lslam.osm.walls import find_walls
from lslam.pipeline.again import open_again, read_for_graph
from lslam.pipeline.run import run
from lslam.pipeline.watch import RunOutcome

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data" / "sequences" / "00"
COUNT = 24
BUILDING, VEGETATION = 50, 70


def test_only_points_of_the_class_are_walls_and_all_tell_the_ground() -> None:
    """A clipped hedge before a facade that is seen above parked cars alone."""
    corners = np.array([[(6, 5), (6, -4)], [(18, 5), (6, 5)]], np.float64)
    facades = [upright((6, 5), (6, -4), 1.7, 6), upright((18, 5), (6, 5), 1.7, 6)]
    far = np.full((500, 3), 100.0)
    parts = [far, plain(), *facades, upright((4, -6), (4, 7), 0, 3)]
    cloud, which = noisy(np.concatenate(parts)), np.repeat([0, 0, 1, 1, 2], [len(part) for part in parts])
    views = np.array([[-10.0, 12.0]])
    both, walls = find_walls(cloud, views=views), find_walls(cloud, views=views, is_wall=which == 1)
    assert misfit(both.segments, corners)[0].max() > 1.0, "a hedge is as flat as a wall"
    assert len(walls) == 2
    assert misfit(walls.segments, corners)[0].max() < 0.03
    alone = find_walls(cloud[which == 1], views=views)
    assert walls.counts.sum() > 1.5 * alone.counts.sum(), (
        "without the ground, the lowest metres of a facade are its clutter"
    )


def labelled_scan(seed: int) -> tuple[Scan, NDArray[np.uint16]]:
    """Two walls of one class each, 3 m apart and more."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-8, 8, (4000, 3)).astype(np.float32)
    points[:, 0] = np.where(np.arange(4000) % 2, 5.0, -5.0)
    labels = np.where(points[:, 0] > 0, BUILDING, VEGETATION).astype(np.uint16)
    return Scan(points, 0, 0, labels=labels), labels


@pytest.mark.parametrize("is_on_disk", [False, True])
def test_keyframes_keep_the_classes_of_their_points(is_on_disk: bool, tmp_path: Path) -> None:
    store = KeyframeStore(tmp_path / "keyframes" if is_on_disk else None, cache_size=1)
    given = MotionPrior.at_once(np.eye(4)), PreprocessConfig()
    for k in range(3):
        scan, _ = labelled_scan(k)
        scan = scan if k != 1 else Scan(scan.points, 0, 1)
        store.add(Keyframe(k, k, k, np.eye(4)), keyframe_cloud(scan, *given), keyframe_labels(scan, *given))
    part = PartOfStore(store, [2, 0])
    for labels, points in ((store.labels(0), store.points(0)), (part.labels(0), part.points(0))):
        assert labels is not None
        assert np.array_equal(labels, np.where(points[:, 0] > 0, BUILDING, VEGETATION))
    assert store.labels(1) is None
    whole = submap(store, np.stack([np.eye(4)] * 3), 1, 3)
    classes = submap_labels(store, 1, 3)
    assert len(whole) == len(classes)
    assert (classes[len(store.points(0)) :][: len(store.points(1))] == 0).all(), "unlabeled"
    if is_on_disk:
        np.savez(
            tmp_path / "keyframes" / "000002.npz", planes=np.zeros((4, 3, 5), np.uint8), labels=np.zeros(4, np.uint16)
        )
        with pytest.raises(InputError, match="no cloud of a keyframe"):
            store.points(2)


def sample_of(folder: Path, label: int | None) -> Path:
    """The first scans of the sample, all points of one class."""
    shutil.copytree(SAMPLE, folder, ignore=shutil.ignore_patterns("truth", "map_perturbed*"))
    if label is not None:
        (folder / "labels").mkdir()
        for path in sorted((folder / "velodyne").iterdir()):
            labels = np.full(path.stat().st_size // 16, label, "<u4")
            (folder / "labels" / f"{path.stem}.label").write_bytes(labels.tobytes())
    return folder


def manifest(folder: Path) -> str:
    return (folder / "manifest.json").read_text()


def on_map(*more: str) -> Config:
    settings = [
        f"osm.extract={SAMPLE / 'map.osm'}", "osm.origin=[49.0, 8.3999, 115.0]", "report.html=false", "map.write=false",
        f"input.count={COUNT}", "osm.start_radius=20", *more,
    ]  # fmt: skip
    return load_config(None, settings, {})


@pytest.fixture(scope="module")
def plain_run(tmp_path_factory: pytest.TempPathFactory) -> RunOutcome:
    folder = tmp_path_factory.mktemp("plain")
    return lslam.run(sample_of(folder / "drive", BUILDING), on_map(), out=folder / "run")


@pytest.mark.parametrize("matcher", ["walls", "baseline"])
def test_a_run_matches_the_class_that_is_asked_for(matcher: str, plain_run: RunOutcome, tmp_path: Path) -> None:
    drive = sample_of(tmp_path / "drive", BUILDING)
    found = lslam.run(drive, on_map("osm.labels=building", f"osm.matcher={matcher}"), out=tmp_path / "run")
    assert found.record.osm is not None
    if matcher == "walls":
        assert np.array_equal(found.trajectory.poses, plain_run.trajectory.poses), "all points are of buildings"
    # The graph again, from the same keyframes, with another class.
    folder = found.record.folder
    assert folder is not None
    known = read_for_graph(folder, ["osm.labels=vegetation"])
    again = run(open_again(known), known.config, out=tmp_path / "again", earlier=known)
    assert again.record.osm is None or not again.record.osm.accepted_matches
    assert "the walls about the start do not locate it" in manifest(tmp_path / "again")


def test_classes_that_are_not_there_are_asked_for_in_vain(plain_run: RunOutcome, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"osm\.labels needs labels of points"):
        lslam.run(sample_of(tmp_path / "drive", None), on_map("osm.labels=building"), out=tmp_path / "run")
    folder = plain_run.record.folder
    assert folder is not None
    known = read_for_graph(folder, ["osm.labels=building"])
    again = run(open_again(known), known.config, out=tmp_path / "again", earlier=known)
    assert again.record.osm is None
    assert "the keyframes have none" in manifest(tmp_path / "again")


def test_geometry_tells_classes_where_there_are_no_labels(tmp_path: Path) -> None:
    drive = sample_of(tmp_path / "drive", None)
    settings = ("osm.labels=building", "osm.label_source=geometry")
    found = lslam.run(drive, on_map(*settings), out=tmp_path / "run")
    assert found.record.osm is not None
    assert len(found.record.osm.accepted_matches) >= 10
    none = lslam.run(drive, on_map("osm.labels=car", "osm.label_source=geometry"), out=tmp_path / "cars")
    assert none.record.osm is None or not none.record.osm.accepted_matches
