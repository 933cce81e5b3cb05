"""The map pass: what of a scan enters the map."""

from __future__ import annotations

import numpy as np

from lslam.core.config import load_config
from lslam.core.types.cloud import in_memory
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.pipeline.map_pass import build_map, without_box
from lslam.simulation.scenarios import simulate


def test_the_box_of_the_vehicle_takes_its_points_with_all_they_have() -> None:
    points = np.array([[0, 0, 0.5], [1, 1, 1], [1.01, 0, 0], [-5, 0, 0], [np.nan, 0, 0]], np.float32)
    scan = Scan(points, 0, 0, np.arange(5, dtype=np.float32), np.arange(5, dtype=np.float32))
    left = without_box(scan, (-1.0, 1.0, -1.0, 1.0, -1.0, 1.0))
    assert left.intensity is not None
    assert left.times is not None
    assert left.intensity.tolist() == left.times.tolist() == [2, 3, 4]


def test_settings_of_the_map_reach_it() -> None:
    drive = simulate("block", lidar="vlp16", count=4)
    assert drive.ground_truth is not None
    results = [
        ScanResult(k, int(t), T, "bridged" if k == 3 else "ok")
        for k, (t, T) in enumerate(zip(drive.stamps_ns, drive.ground_truth.poses, strict=True))
    ]

    def points(*settings: str) -> np.ndarray:
        built = build_map(drive, results, load_config(None, settings))
        assert built is not None
        return in_memory(built.cloud).points

    whole = points("map.range_max=30")
    cropped = points("map.range_max=30", "map.crop=[-3.0, 9.0, 0.0, 50.0]")
    assert len(cropped) > 100
    assert (cropped >= [-3, 0, -np.inf]).all()
    assert (cropped <= [9, 50, np.inf]).all()
    assert len(cropped) < 0.6 * len(whole)
    # No scan has seen the ground nearer than 2 m: a box ahead of the sensor leaves a hole that all poses agree on.
    boxed = points("map.range_max=30", "map.ego_box=[-100.0, 100.0, 0.0, 100.0, -100.0, 100.0]")
    assert len(boxed) > 100
    assert (boxed[:, 1] > 2.0).sum() < 0.02 * (whole[:, 1] > 2.0).sum()
    assert len(points("map.range_max=30", "preprocess.ego_box=[-100.0, 100.0, 0.0, 100.0, -100.0, 100.0]")) == len(
        boxed
    )
