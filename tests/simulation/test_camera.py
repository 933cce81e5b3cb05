"""The simulated camera: each pixel is what its ray meets at that instant, and a recording is otherwise as it was."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lslam.core.geometry import se3
from lslam.core.types.camera import Lens, cameras_of
from lslam.io.readers import open_sequence
from lslam.maps.kernels.views import project_all
from lslam.simulation.camera import COLOURS, CameraModel, SimulatedCamera
from lslam.simulation.record import record
from lslam.simulation.scenarios import SimulatedDrive, simulate

SMALL = CameraModel(Lens("pinhole", (80, 60), (50.0, 50.0, 39.5, 29.5), (-0.05, 0.01, 0.0005, -0.0005)), noise=0.0)


@pytest.fixture(scope="module")
def drive() -> SimulatedDrive:
    return simulate("block", count=4)


def test_points_of_a_scan_are_where_the_camera_sees_their_surface(drive: SimulatedDrive) -> None:
    camera = SimulatedCamera(drive, replace(SMALL, exposure_s=0.0, instants=1, exposure_sigma=0.0))
    scan = drive.scan(1)
    stamp = scan.stamp_ns / 1e9
    T_camera_lidar = se3.inverse(camera.T_lidar_camera)
    points = se3.apply(T_camera_lidar, scan.points.astype(float))
    pixels = np.empty((len(points), 2))
    project_all(points, camera.model.lens.parameters, pixels)
    inside = np.flatnonzero((pixels > 2).all(1) & (pixels < [77, 57]).all(1) & (points[:, 2] < 20))
    seen = camera.surfaces(stamp)
    column, row = np.rint(pixels[inside]).astype(int).T
    classes = seen[row * 80 + column]
    from lslam.simulation.lidar import LABELS

    agree = LABELS[0][np.minimum(classes, len(LABELS[0]) - 1)] == scan.labels[inside]
    assert len(inside) > 300
    assert agree.mean() > 0.93


def test_an_image_has_the_colours_of_surfaces_and_blur_mixes_them(drive: SimulatedDrive) -> None:
    sharp = SimulatedCamera(drive, replace(SMALL, instants=1, exposure_sigma=0.0)).image(0)
    known = {tuple(colour) for colour in COLOURS.astype(int).tolist()}
    assert {tuple(colour) for colour in sharp.reshape(-1, 3).tolist()} <= known
    assert len({tuple(colour) for colour in sharp.reshape(-1, 3).tolist()}) > 3
    blurred = SimulatedCamera(drive, replace(SMALL, exposure_s=0.2, exposure_sigma=0.0)).image(1)
    assert not {tuple(colour) for colour in blurred.reshape(-1, 3).tolist()} <= known


def test_brightness_wanders_and_the_same_seed_gives_the_same_image(drive: SimulatedDrive) -> None:
    camera = SimulatedCamera(drive, CameraModel(SMALL.lens))
    assert (camera.image(2) == SimulatedCamera(drive, CameraModel(SMALL.lens)).image(2)).all()
    assert len(set(camera.gains.tolist())) == len(camera)
    wide = SimulatedCamera(simulate("block", count=60), CameraModel(SMALL.lens))
    assert 0.02 < np.log(wide.gains).std() < 0.3


def test_a_recording_with_a_camera_is_otherwise_the_same(drive: SimulatedDrive, tmp_path: Path) -> None:
    plain = record(drive, tmp_path / "plain").sequence
    seen: list[int] = []
    filmed = record(drive, tmp_path / "filmed", on_image=seen.append).sequence
    assert seen == [0, 1, 2]
    others = {p.relative_to(filmed) for p in filmed.rglob("*") if p.is_file()}
    assert {str(p) for p in others if "front" in p.parts} == {
        *(f"front/{k:06d}.png" for k in range(3)),
        "front/times.txt",
    }
    for path in plain.rglob("*"):
        if path.is_file() and path.name not in ("sequence.toml", "manifest.json"):
            assert path.read_bytes() == (filmed / path.relative_to(plain)).read_bytes(), path
    assert (filmed / "sequence.toml").read_text().startswith((plain / "sequence.toml").read_text())
    (camera,) = cameras_of(open_sequence(filmed))
    own = SimulatedCamera(drive)
    assert camera.lens == own.model.lens
    assert camera.stamps_ns.tolist() == own.stamps_ns.tolist()
    np.testing.assert_allclose(camera.T_lidar_camera, own.T_lidar_camera, atol=1e-12)
    assert (camera.image(1) == own.image(1)).all()
