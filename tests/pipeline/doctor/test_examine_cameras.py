"""Cameras against scans: edges of depth by hand, and offsets in angle and time that a simulated camera has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lslam.core.geometry import se3, so3
from lslam.core.geometry.se3 import ContinuousMotion
from lslam.core.types.camera import Camera, Lens
from lslam.core.types.scan import Scan
from lslam.pipeline.doctor import Findings
from lslam.pipeline.doctor.examine_cameras import Offset, _judge, beam_spacing, depth_edges, offset_of
from lslam.simulation.camera import CameraModel, SimulatedCamera
from lslam.simulation.scenarios import SimulatedDrive, simulate

FOCAL = 160.0
MODEL = CameraModel(Lens("pinhole", (260, 180), (FOCAL, FOCAL, 129.5, 89.5)))


def ring_scan(ranges: np.ndarray) -> Scan:
    """Two rings of 1 deg steps, 2 deg apart, out of order."""
    azimuth = np.radians(np.arange(len(ranges)))
    parts = []
    for rise in np.radians([0.0, 2.0]):
        flat = ranges * np.cos(rise)
        parts.append(np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), ranges * np.sin(rise)], axis=1))
    points = np.concatenate(parts).astype(np.float32)
    order = np.random.default_rng(0).permutation(len(points))
    rings = np.repeat([0, 1], len(ranges)).astype(np.uint16)
    return Scan(points[order], 0, 0, None, None, rings[order])


def test_edges_of_depth_are_the_near_sides_of_jumps() -> None:
    ranges = np.full(60, 20.0)
    ranges[20:30] = 10.0
    scan = ring_scan(ranges)
    points, weights = depth_edges(scan)
    azimuth = np.round(np.degrees(np.arctan2(scan.points[points, 1], scan.points[points, 0]))).astype(int)
    assert sorted(azimuth.tolist()) == [20, 20, 29, 29]
    np.testing.assert_allclose(weights, 1.0)
    np.testing.assert_allclose(np.degrees(beam_spacing(scan)), [1.0, 2.0], atol=1e-3)


def test_a_slanted_wall_and_a_lost_beam_are_no_edges() -> None:
    azimuth = np.radians(np.arange(60))
    wall = 5.0 / np.cos(azimuth - np.radians(20))  # met at 50 deg of its normal at most
    wall[40] = 0.0
    assert len(depth_edges(ring_scan(wall))[0]) == 0


@pytest.fixture(scope="module")
def drive() -> SimulatedDrive:
    return simulate("urban", lidar="hdl64", count=16, seed=3)


@pytest.fixture(scope="module")
def camera(drive: SimulatedDrive) -> Camera:
    camera = SimulatedCamera(drive, MODEL).camera
    images = {k: camera.load(k) for k in range(15)}
    object.__setattr__(camera, "load", images.__getitem__)
    return camera


@pytest.mark.parametrize(
    ("turned", "late_s"),
    [((0.0, 0.0), 0.0), ((0.0, -0.7), 0.0), ((0.5, 0.0), -0.04)],
)
def test_an_offset_is_found_in_pixels_and_in_time(
    drive: SimulatedDrive, camera: Camera, turned: tuple[float, float], late_s: float
) -> None:
    assert drive.ground_truth is not None
    motion = ContinuousMotion([(drive.stamps_ns, drive.ground_truth.poses)])
    yaw, pitch = np.radians(turned)
    wrong = replace(
        camera,
        T_lidar_camera=camera.T_lidar_camera @ se3.make(so3.exp(np.array([pitch, yaw, 0.0])), np.zeros(3)),
        stamps_ns=camera.stamps_ns + round(1e9 * late_s),
    )
    found = offset_of(wrong, drive, drive.stamps_ns, motion)
    assert found is not None
    # Axes x right, y down: a camera turned to the right by its calibration expects everything further left.
    assert found.pixels[0] == pytest.approx(FOCAL * yaw, abs=1.0)
    assert found.pixels[1] == pytest.approx(-FOCAL * pitch, abs=found.beams[1])
    assert found.time_s == pytest.approx(-late_s, abs=0.012)


def test_offsets_beyond_their_error_and_the_beams_are_findings() -> None:
    def judged(pixels: tuple[float, float], time_s: float, sigma: float = 0.1) -> list[str]:
        findings = Findings()
        offset = Offset(np.array(pixels), time_s, np.full(2, sigma), 0.002, 20, np.array([0.8, 2.2]))
        _judge("front", offset, findings)
        return [f.code for f in findings]

    assert judged((0.9, 2.0), 0.005) == []
    assert judged((1.1, 0.0), 0.0) == ["camera-pixels"]
    assert judged((0.0, -2.5), 0.02) == ["camera-pixels", "camera-clock"]
    assert judged((5.0, 5.0), 0.0, sigma=2.0) == []
