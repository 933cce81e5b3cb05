"""Control points: the georeference they give, factors that hold, and a word for each that does not fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lslam.backend.control_points import contradicting, control_residuals, place_keyframes, with_control
from lslam.backend.georeferencing import Placement
from lslam.core.config import Config
from lslam.core.errors import UsageError
from lslam.core.geometry import se3, so3
from lslam.core.types.constraint import ControlPoint, Instant
from lslam.core.types.gnss import Georeference
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.trajectory import Keyframe
from lslam.maps.georeference import Projection, to_wgs84

ORIGIN = np.array([49.0112, 8.4229, 115.0])
TRUE = Georeference(ORIGIN, se3.make(so3.exp(np.array([0.0, 0.0, 0.7])), np.array([30.0, -12.0, 2.0])), 25832)
# A drive of 60 m with a bend; a keyframe at every second scan.
WAY = np.linspace(0.0, 60.0, 61)
POSES = se3.make(
    so3.exp(np.column_stack([0 * WAY, 0 * WAY, 0.02 * WAY])),
    np.column_stack([50 * np.sin(0.02 * WAY), 50 * (1 - np.cos(0.02 * WAY)), 0.01 * WAY]),
)
RESULTS = [ScanResult(k, 100_000_000 * k, T) for k, T in enumerate(POSES)]
KEYFRAMES = [Keyframe(n, k, RESULTS[k].stamp_ns, POSES[k]) for n, k in enumerate(range(0, 61, 2))]


def surveyed(scans: tuple[int, ...], seen: np.ndarray | None = None) -> list[ControlPoint]:
    """Exact points; `seen` in the axes of the LiDAR."""
    seen = np.zeros(3) if seen is None else seen
    places = [Projection(TRUE).apply(se3.apply(POSES[k], seen[None]))[0] for k in scans]
    return [
        ControlPoint(Instant(f"line {k}", scan=k), place, np.full(3, 0.02), 25832, seen)
        for k, place in zip(scans, places, strict=True)
    ]


@pytest.mark.parametrize("seen", [np.zeros(3), np.array([4.0, -7.0, -1.5])], ids=["the sensor", "a target"])
def test_exact_points_give_the_exact_place_and_factors_without_a_residual(seen: np.ndarray) -> None:
    points = surveyed((0, 21, 40, 60), seen)
    placed = with_control(Placement(), points, RESULTS, KEYFRAMES, None, Config())
    assert placed.georeference is not None
    assert placed.georeference.epsg == 25832
    np.testing.assert_allclose(
        Projection(placed.georeference).apply(POSES[:, :3, 3]), Projection(TRUE).apply(POSES[:, :3, 3]), atol=2e-3
    )
    on_earth = placed.georeference.T_enu_world @ np.stack([k.T_world_lidar for k in KEYFRAMES])
    for fix in placed.fixes:
        assert fix.is_binding
        np.testing.assert_allclose(fix.predict(on_earth), fix.position, atol=2e-3)
    # Scan 21 is no keyframe: half of it hangs on the one before, half on the next.
    assert (placed.fixes[1].keyframe, placed.fixes[1].share) == (10, pytest.approx(0.5))
    left = control_residuals(points, RESULTS, placed.georeference)
    assert max(one.size for one in left) < 0.1
    assert contradicting(left, 0.999) == []


@pytest.mark.parametrize("tilt_deg", [1.5, -6.0])
def test_a_slope_under_the_first_scan_is_found_by_four_points(tilt_deg: float) -> None:
    """Without an IMU nothing says what is up: taken for level, the drive would have to be bent to pass the points."""
    T = TRUE.T_enu_world @ se3.make(so3.exp(np.deg2rad([0.3 * tilt_deg, tilt_deg, 0.0])), np.zeros(3))
    sloped = replace(TRUE, T_enu_world=T)
    places = Projection(sloped).apply(POSES[:, :3, 3])
    points = [
        replace(point, position=places[k]) for point, k in zip(surveyed((0, 21, 40, 60)), (0, 21, 40, 60), strict=True)
    ]
    placed = with_control(Placement(), points, RESULTS, KEYFRAMES, None, Config())
    assert placed.georeference is not None
    # 5 mm: up has a prior of 10 deg, and the points one of 2 cm.
    np.testing.assert_allclose(Projection(placed.georeference).apply(POSES[:, :3, 3]), places, atol=5e-3)


def test_a_point_of_the_wrong_scan_is_named_with_its_line() -> None:
    points = surveyed((0, 20, 40, 60))
    wrong = [*points[:2], replace(points[2], at=Instant("line 4", scan=44)), points[3]]
    left = control_residuals(wrong, RESULTS, TRUE)
    (said,) = contradicting(left, 0.999)
    assert said.startswith("line 4: the control point is left off by 4.0")


def test_points_beside_fixes_keep_the_place_of_the_fixes() -> None:
    known = Placement(replace(TRUE, method="graph"))
    placed = with_control(known, surveyed((0, 60)), RESULTS, KEYFRAMES, None, Config())
    assert placed.georeference is not None
    assert placed.georeference.origin is TRUE.origin
    np.testing.assert_allclose(placed.fixes[0].position, se3.apply(TRUE.T_enu_world, POSES[:1, :3, 3])[0], atol=2e-3)


def test_points_that_leave_the_heading_vague_give_no_place() -> None:
    for points in (surveyed((20,)), surveyed((20, 20, 20))):
        placed = with_control(Placement(), points, RESULTS, KEYFRAMES, None, Config())
        assert placed.georeference is None
        assert "nobody can say which way the run goes" in placed.problem


def test_coordinates_go_to_the_earth_and_back() -> None:
    there = Projection(TRUE).apply(np.array([[3.0, 4.0, 5.0]]))
    lat_lon = to_wgs84(there, 25832)
    np.testing.assert_allclose(to_wgs84(lat_lon[:, [1, 0, 2]], 4326), lat_lon, atol=1e-9)
    np.testing.assert_allclose(Projection(TRUE).invert(there), [[3.0, 4.0, 5.0]], atol=1e-6)
    east, north = 30 + 3 * np.cos(0.7) - 4 * np.sin(0.7), -12 + 3 * np.sin(0.7) + 4 * np.cos(0.7)
    round_earth = [49.0112 + north / 111_200, 8.4229 + east / (111_320 * np.cos(np.deg2rad(49.0112)))]
    assert lat_lon[0] == pytest.approx([*round_earth, 122.0], abs=2e-6)


@pytest.mark.parametrize(
    ("position", "epsg", "said"),
    [([457799.0, 5428861.0, 115.0], 4326, "is no place in EPSG:4326"), ([1.0, 2.0, 3.0], 1999, "PROJ knows no such")],
)
def test_coordinates_that_are_none_are_refused(position: list[float], epsg: int, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        to_wgs84(np.array([position]), epsg)


def test_one_keyframe_and_one_scan_are_placed_nowhere() -> None:
    points = surveyed((0, 60))
    for results, keyframes in ((RESULTS, KEYFRAMES[:1]), (RESULTS[:1], KEYFRAMES[:1])):
        assert place_keyframes(keyframes, [], points, results, Config()) == keyframes
