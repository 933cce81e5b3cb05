"""LeGO-LOAM's front half: ground and clusters against what the simulated rays really met, and on small scenes by hand."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.errors import InputError
from lslam.core.types.scan import Scan
from lslam.registration.kernels import range_image
from lslam.registration.preprocessing.features import extract_features
from lslam.registration.preprocessing.segments import Segments, lego_features
from lslam.simulation import lidar
from lslam.simulation.scenarios import simulate
from lslam.simulation.scene_mesh import Surface

GROUND = [Surface.ROAD, Surface.PAVEMENT, Surface.LAWN]


def segment_scan(scan: Scan) -> Segments:
    return lego_features(scan)[1]


def classed(
    monkeypatch: pytest.MonkeyPatch, scenario: str, model: str | None, index: int, seed: int = 2
) -> tuple[Scan, NDArray[np.uint8]]:
    """A simulated scan and the surface each of its points was met on, overheard from the ray caster."""
    heard: list[Any] = []
    detect = lidar._detect

    def listen(model: Any, hits: Any, *given: Any) -> Any:
        out = detect(model, hits, *given)
        heard.append((hits.surface.copy(), out[0]))
        return out

    monkeypatch.setattr(lidar, "_detect", listen)
    drive = simulate(scenario, seed=seed, count=index + 1, lidar=model)
    scan = drive.scan(index)
    surface, seen = heard[-1]
    order = drive.lidar.sequence
    surface = surface[order[seen[order]]]
    assert len(surface) == len(scan)
    return scan, surface


@pytest.mark.parametrize(("scenario", "model"), [("street", "hdl64-kitti"), ("street", "vlp16"), ("walk", "os1-64")])
def test_ground_is_found_and_little_else_and_foliage_is_dropped_before_walls(
    monkeypatch: pytest.MonkeyPatch, scenario: str, model: str
) -> None:
    scan, surface = classed(monkeypatch, scenario, model, 1)
    ranges = np.linalg.norm(scan.points, axis=1)
    # LeGO-LOAM needs the ring above to tell ground: far off there is none.
    used = (ranges > 1) & (ranges < 30)
    is_ground = np.isin(surface, GROUND)
    segments = segment_scan(scan)
    assert (segments.ground & is_ground & used).sum() > 0.95 * (segments.ground & used).sum()
    assert (segments.ground & is_ground & used).sum() > 0.95 * (is_ground & used).sum()
    assert not (segments.ground & (segments.labels > 0)).any()
    walls = used & (surface == Surface.WALL)
    assert (segments.labels[walls] > 0).mean() > 0.7
    assert segments.ground[walls].mean() < 0.01
    foliage = used & (surface == Surface.FOLIAGE)
    if foliage.sum() > 300:
        assert (segments.labels[foliage] > 0).mean() < 0.8 * (segments.labels[walls] > 0).mean()
    sizes = np.bincount(segments.labels)[1:]
    assert sizes.min() >= 5
    assert segments.count == len(sizes)


def test_lego_features_have_edges_off_the_ground_and_planes_on_it() -> None:
    scan = simulate("street", seed=0, count=2, lidar="vlp16").scan(1)
    features, segments = lego_features(scan)
    labels = features.labels
    assert (segments.labels[labels > 0] > 0).all()
    assert segments.ground[labels == -2].all()
    assert (segments.ground | (segments.labels > 0))[labels != 0].all()
    assert (segments.labels[labels == -1] > 0).any()
    plain = extract_features(scan).labels
    assert 20 < (labels > 0).sum() < (plain > 0).sum()
    assert (labels == -2).sum() > 50
    with pytest.raises(InputError, match="no rings"):
        segment_scan(Scan(scan.points, 0, 0))


def cliff(rows: int, columns: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ranges of a picture of plateaus with sharp borders and holes, and the elevations of its rows."""
    rng = np.random.default_rng(rows * columns)
    heights = rng.choice([5.0, 8.0, 13.0, 21.0], (rows // 4 + 1, columns // 5 + 1))
    ranges = np.kron(heights, np.ones((4, 5)))[:rows, :columns] + rng.normal(0, 0.01, (rows, columns))
    ranges[rng.random((rows, columns)) < 0.15] = 0
    return ranges, np.radians(np.linspace(-15, 15, rows))


def plain_labels(
    ranges: NDArray[np.float64], ground: NDArray[np.bool_], elevation: NDArray[np.float64], angle: float, least: Any
) -> NDArray[np.int64]:
    """Breadth-first clusters, written down plainly."""
    rows, columns = ranges.shape
    labels = np.zeros((rows, columns), int)
    done = (ranges == 0) | ground
    count = 0
    for start in np.ndindex(rows, columns):
        if done[start]:
            continue
        queue, members = deque([start]), [start]
        done[start] = True
        while queue:
            r, c = queue.popleft()
            for dr, dc in ((0, -1), (0, 1), (1, 0), (-1, 0)):
                for step in (1, 2, 3):
                    other = (r + step * dr, (c + step * dc) % columns)
                    if not 0 <= other[0] < rows:
                        break
                    if ranges[other] == 0:
                        continue
                    between = abs(elevation[other[0]] - elevation[r]) if dr else step * 2 * np.pi / columns
                    far, near = max(ranges[r, c], ranges[other]), min(ranges[r, c], ranges[other])
                    if not done[other] and np.arctan2(near * np.sin(between), far - near * np.cos(between)) > angle:
                        done[other] = True
                        queue.append(other)
                        members.append(other)
                    break
        if len(members) >= least[0] or (len(members) >= least[1] and len({r for r, _ in members}) >= least[2]):
            count += 1
            for member in members:
                labels[member] = count
    return labels


@pytest.mark.parametrize(("rows", "columns", "angle"), [(16, 90, 60.0), (9, 40, 30.0), (1, 50, 60.0)])
def test_clusters_are_those_of_a_plain_search(rows: int, columns: int, angle: float) -> None:
    ranges, elevation = cliff(rows, columns)
    ground = np.zeros((rows, columns), bool)
    ground[0, : columns // 3] = ranges[0, : columns // 3] > 0
    nearest = np.full(rows * columns, -1)
    full = ranges.ravel() > 0
    nearest[full] = np.arange(full.sum())
    least = (12, 5, 3)
    expected = plain_labels(ranges, ground, elevation, np.radians(angle), least)
    got = range_image.cluster(
        ranges.ravel()[full], nearest, ground.ravel(), columns, elevation, np.radians(angle), least
    )
    np.testing.assert_array_equal(got.reshape(rows, columns), expected)
    assert rows == 1 or expected.max() > 3


def town(slope_deg: float, tilt_deg: float = 0.0) -> tuple[Scan, NDArray[np.bool_]]:
    """A plane rising by `slope_deg` from 6 m ahead, with a table on it, seen by 32 rings; and which points are on the plane."""
    azimuth = 2 * np.pi * np.arange(900) / 900
    elevation = np.radians(np.linspace(-25, 3, 32))
    e, a = np.broadcast_arrays(elevation[:, None], azimuth)
    beam = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)
    rise = np.tan(np.radians(slope_deg))
    with np.errstate(all="ignore"):
        flat = -1.8 / beam[..., 2]
        ramp = (-1.8 - 6 * rise) / (beam[..., 2] - rise * beam[..., 0])
        ramp[~(ramp > 0) | (ramp * beam[..., 0] < 6)] = np.inf
        flat[~(flat > 0) | (flat * beam[..., 0] > 6)] = np.inf
        table = np.where(beam[..., 2] < 0, -0.9 / beam[..., 2], np.inf)
        at = np.minimum(table, 1e3)[..., None] * beam
    table[~((np.abs(at[..., 0]) < 1.2) & (np.abs(at[..., 1] - 4) < 1.0))] = np.inf
    ground = np.minimum(flat, ramp)
    r = np.minimum(ground, table)
    seen = r < 60
    points = r[seen, None] * beam[seen] + np.random.default_rng(0).normal(0, 0.005, (int(seen.sum()), 3))
    c, s = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    points = points @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    rings = np.broadcast_to(np.arange(32)[:, None], r.shape)[seen]
    return Scan(points.astype(np.float32), 0, 0, rings=rings.astype(np.uint16)), (ground <= table)[seen]


@pytest.mark.parametrize(("slope", "tilt"), [(0.0, 0.0), (0.0, 12.0), (7.0, 0.0)])
def test_gentle_slopes_and_tilted_sensors_keep_their_ground_and_tables_are_none(slope: float, tilt: float) -> None:
    scan, is_ground = town(slope, tilt)
    segments = segment_scan(scan)
    assert segments.ground[is_ground].mean() > 0.95
    assert segments.ground[~is_ground].mean() < 0.05
    assert (~is_ground).sum() > 200


def test_a_steep_ramp_is_no_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    scan, _ = town(25.0)
    # Straight ahead: a column that climbs it aslant climbs less.
    ramp = (scan.points[:, 0] > 6.5) & (np.abs(scan.points[:, 1]) < 0.7 * scan.points[:, 0])
    assert ramp.sum() > 500
    assert segment_scan(scan).ground[ramp].mean() < 0.05
    monkeypatch.setattr("lslam.registration.preprocessing.segments.GROUND_ANGLE_DEG", 30.0)
    assert segment_scan(scan).ground[ramp].mean() > 0.9


@pytest.mark.parametrize("seed", [0, 1])
def test_the_ground_under_a_drone_is_found_where_its_beams_reach_it(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    scan, surface = classed(monkeypatch, "open", None, 1, seed)
    is_ground = np.isin(surface, GROUND)
    assert np.linalg.norm(scan.points[is_ground], axis=1).min() > 15
    segments = segment_scan(scan)
    assert segments.ground[is_ground].mean() > 0.7
    # Roofs of houses and cars are level, too.
    stands = ~is_ground & ~np.isin(surface, [Surface.ROOF, Surface.CAR])
    assert segments.ground[stands].mean() < 0.05


def test_a_scan_of_nothing_has_no_segments() -> None:
    segments = segment_scan(Scan(np.zeros((4, 3), np.float32), 0, 0, rings=np.zeros(4, np.uint16)))
    assert (segments.count, segments.ground.any(), len(segments.labels)) == (0, False, 4)
