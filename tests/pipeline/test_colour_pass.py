"""Coloured maps of simulated drives, the motion between poses, and images that no registered scan is about."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lslam.core.config import load_config
from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.core.types.scan_result import ScanResult, Status
from lslam.maps.colour import GREY
from lslam.pipeline.further_passes import build_finished_map, motion_of
from lslam.simulation.camera import COLOURS, CameraModel, SimulatedCamera
from lslam.simulation.scenarios import SimulatedDrive, simulate

CONFIG = load_config(settings=["map.colour=true"], environ={})


@pytest.fixture(scope="module")
def drive() -> SimulatedDrive:
    """A drive round a block with its camera, whose exposure and noise are off."""
    made = simulate("block", lidar="hdl64", count=8, motion_compensated=True)
    camera = SimulatedCamera(made, CameraModel(noise=0.0, exposure_sigma=0.0)).camera
    images = [camera.image(k) for k in range(len(camera.stamps_ns))]
    object.__setattr__(camera, "load", images.__getitem__)
    made.cameras = lambda: [camera]  # type: ignore[attr-defined]
    return made


def results_of(drive: SimulatedDrive, bridged: tuple[int, ...] = ()) -> list[ScanResult]:
    assert drive.ground_truth is not None
    status: dict[bool, Status] = {True: "bridged", False: "ok"}
    pairs = zip(drive.stamps_ns, drive.ground_truth.poses, strict=True)
    return [ScanResult(k, int(stamp), T, status[k in bridged]) for k, (stamp, T) in enumerate(pairs)]


def built(drive: SimulatedDrive, bridged: tuple[int, ...] = (), spool: Path | None = None):  # type: ignore[no-untyped-def]
    return build_finished_map(drive, results_of(drive, bridged), CONFIG, spool=spool)


def test_most_points_have_the_colour_of_the_nearest_surface_of_the_scene(drive: SimulatedDrive) -> None:
    made = built(drive)
    points = np.concatenate([block.points for block in made.cloud.blocks()])
    colours = np.concatenate(
        [np.stack([b.columns[c] for c in ("red", "green", "blue")], 1) for b in made.cloud.blocks()]
    )
    seen = np.flatnonzero(~(colours == GREY).all(1))
    assert made.colour is not None
    assert (made.colour.points, made.colour.unseen, made.colour.images) == (len(points), len(points) - len(seen), 7)
    # What a ray towards the point meets within a voxel of it.
    T = drive.T_city_world @ results_of(drive)[4].T_world_lidar
    there = se3.apply(drive.T_city_world, points[seen])
    away = there - T[:3, 3]
    r = np.linalg.norm(away, axis=1)
    origins = np.broadcast_to(T[:3, 3], away.shape).astype(np.float32)
    met, face = drive.scene.cast(origins, (away / r[:, None]).astype(np.float32))
    same = np.abs(met - r) < 0.1
    truth = COLOURS[drive.scene.mesh.surfaces[face[same]]]
    assert same.sum() > 1000
    right = (np.abs(colours[seen][same] - truth) <= 3).all(1)
    assert right.mean() > 0.95


def test_images_beside_a_bridged_scan_are_left_out_and_counted(drive: SimulatedDrive) -> None:
    made = built(drive, bridged=(3,))
    assert made.colour is not None
    assert (made.colour.images, made.colour.outside) == (5, 2)
    assert "2 without a registered scan before and after left out" in made.steps[-1]
    with pytest.raises(InputError, match="no image of block-0 can colour its map: 7 are not between registered scans"):
        built(drive, bridged=(1, 3, 5, 7))


def test_an_image_that_cannot_be_read_is_counted_and_the_rest_is_used(
    drive: SimulatedDrive, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (camera,) = drive.cameras()  # type: ignore[attr-defined]
    whole = camera.load

    def load(k: int) -> np.ndarray:
        if k == 2:
            raise InputError("2.png cannot be read")
        return np.asarray(whole(k))

    monkeypatch.setitem(camera.__dict__, "load", load)
    made = built(drive)
    assert (made.colour.images, made.colour.unreadable) == (6, 1)
    assert "an image is left out: 2.png cannot be read" in caplog.text


def test_points_and_intensities_are_those_of_the_map_without_colours(drive: SimulatedDrive, tmp_path: Path) -> None:
    plain = load_config(settings=["map.voxel=0.2"], environ={})
    without = build_finished_map(drive, results_of(drive), plain)
    made = built(drive, spool=tmp_path)
    assert (made.cloud.cloud.points == without.cloud.points).all()  # type: ignore[attr-defined]
    assert without.colour is None
    assert not next(iter(without.cloud.blocks())).columns
    assert list(tmp_path.iterdir()) == []


def test_a_swing_between_two_scans_is_followed() -> None:
    times = np.arange(0, 3, 0.1)

    def pose(t: np.ndarray) -> np.ndarray:
        turn = np.stack([0 * t, 0.05 * np.sin(4 * np.pi * t), 0.3 * t], axis=1)
        return se3.make(so3.exp(turn), np.stack([1.2 * t, 0.1 * np.sin(6 * t), 0 * t], axis=1))

    results = [ScanResult(k, round(1e9 * t), T, "ok") for k, (t, T) in enumerate(zip(times, pose(times), strict=True))]
    query = np.arange(0.33, 2.6, 0.1)
    poses, rates, within = motion_of(results).at(np.round(1e9 * query).astype(np.int64))
    assert within.all()
    off = se3.relative(poses, pose(query))
    angle = np.arccos(np.clip((np.trace(off[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
    # A straight line between the poses is off by 0.05 (4 pi 0.1)^2 / 8 = 0.0099 rad.
    assert angle.max() < 0.0015
    assert np.abs(off[:, :3, 3]).max() < 0.001
    np.testing.assert_allclose(rates, np.hypot(0.05 * 4 * np.pi * np.cos(4 * np.pi * query), 0.3), atol=0.06)
