"""What a feature method saw: the features of a scan, the map they make, and how many there were."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from stub_sequences import Stub, sample

from lslam.core.config import load_config
from lslam.core.geometry import se3
from lslam.core.types.scan_result import ScanResult
from lslam.odometry import create_odometry
from lslam.odometry.base import FeatureSource
from lslam.odometry.frontend.register_scans import estimate
from lslam.pipeline.further_passes import MOST_SCANS, view_features
from lslam.pipeline.run import run
from lslam.reports.page_data import feature_figures

CONFIG = load_config(None, ["odometry.method=floam", "map.write=false"], {})


@pytest.fixture(scope="module")
def driven() -> tuple[Stub, FeatureSource, list[ScanResult]]:
    stub, odometry = sample(40), create_odometry(CONFIG)
    assert isinstance(odometry, FeatureSource)
    return stub, odometry, estimate(stub, odometry)


def test_counts_and_map_are_those_of_the_scans(driven: tuple[Stub, FeatureSource, list[ScanResult]]) -> None:
    stub, odometry, results = driven
    view = view_features(stub, odometry, results)
    assert view is not None
    assert len(view.scans) == len(set(view.scans.tolist())) == MOST_SCANS
    features = [odometry.prepare(stub.scan(k)) for k in view.scans.tolist()]
    assert view.edge_counts.tolist() == [len(f.edges) for f in features]
    assert view.plane_counts.tolist() == [len(f.planes) for f in features]
    shown = features[view.scans.tolist().index(view.scan)]
    np.testing.assert_array_equal(view.edges, shown.edges.points[:, :2])
    expected = [
        se3.apply(results[k].T_world_lidar, f.less_planes.points) for k, f in zip(view.scans, features, strict=True)
    ]
    assert len(view.map_planes) == sum(map(len, expected))
    # Deskewed by the final poses: some centimetres beside where the points as they came lie.
    assert np.abs(view.map_planes - np.concatenate(expected)).max() < 1.0


def test_scans_that_are_gone_are_left_out(driven: tuple[Stub, FeatureSource, list[ScanResult]]) -> None:
    stub, odometry, results = driven
    gone = replace(stub, scans=[*stub.scans[:20], *["gone"] * 20])
    view = view_features(gone, odometry, results)
    assert view is not None
    assert view.scans.max() < 20
    assert view_features(replace(stub, scans=["gone"] * 40), odometry, results) is None
    assert view_features(stub, odometry, [replace(r, status="bridged") for r in results]) is None
    assert view_features(stub, odometry, []) is None
    assert feature_figures(None) == []


@pytest.mark.parametrize(("method", "is_shown"), [("floam", True), ("icp", False)])
def test_the_report_shows_them(method: str, is_shown: bool, tmp_path: Path) -> None:
    config = load_config(None, [f"odometry.method={method}", "map.write=false"], {})
    run(sample(12), config, out=tmp_path / "run")
    page = (tmp_path / "run" / "report.html").read_text()
    assert ("Features of scan" in page) == is_shown
    assert ('class="points s1"' in page) == is_shown
