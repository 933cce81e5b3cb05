"""feature_map.ply: edges where edges are, planes where planes are, and a refusal where there are neither."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.config import load_config
from lslam.core.errors import UsageError
from lslam.io.formats.point_files import read_points, write_ply
from lslam.pipeline.check import check_config
from lslam.pipeline.run import run
from lslam.reports.text import summary
from lslam.simulation.scenarios import simulate

SETTINGS = ["map.write_features=true", "map.write=false", "report.html=false"]


def columns(path: Path) -> NDArray[np.float32]:
    """x, y, z, class of a feature map."""
    data = path.read_bytes()
    header, _, body = data.partition(b"end_header\n")
    assert b"property float x\nproperty float y\nproperty float z\nproperty float class\n" in header
    return np.frombuffer(body, "<f4").reshape(-1, 4)


@pytest.mark.parametrize("method", ["loam", "loam-odom", "lego-loam"])
def test_a_run_saves_its_feature_map(method: str, tmp_path: Path) -> None:
    drive = simulate("street", seed=1, lidar="vlp16", count=8)
    out = tmp_path / "run"
    run(drive, load_config(None, [f"odometry.method={method}", *SETTINGS], {}), out=out)
    table = columns(out / "feature_map.ply")
    edges, planes = table[table[:, 3] == 1], table[table[:, 3] == 0]
    assert len(edges) + len(planes) == len(table) == len(read_points(out / "feature_map.ply").points)
    assert len(planes) > len(edges) > 300
    for part in (edges, planes):
        assert len(np.unique(np.floor(part[:, :3]), axis=0)) > 0.9 * len(part)  # voxels of 1 m
    # The street's ground, 1.7 m below the sensor, is made of planes.
    assert np.mean(planes[:, 2] < -1.4) > 2 * np.mean(edges[:, 2] < -1.4)
    posed_by = json.loads((out / "manifest.json").read_text())["posed_by"]
    assert set(posed_by) <= {method, "less planar points"}


def test_stand_ins_are_counted(tmp_path: Path) -> None:
    few = ["loam.regions=1", "loam.max_edge_points=1", "loam.max_planar_points=1"]
    config = load_config(
        None,
        ["odometry.method=floam", "map.write=false", "report.html=false", "recovery.fallback=all-points", *few],
        {},
    )
    outcome = run(simulate("carpark", seed=1, lidar="vlp16", count=8), config, out=tmp_path / "run")
    assert not (tmp_path / "run" / "feature_map.ply").exists()
    posed_by = json.loads((tmp_path / "run" / "manifest.json").read_text())["posed_by"]
    header, *rows = (tmp_path / "run" / "scans.csv").read_text().splitlines()
    column = header.split(",").index("posed_by")
    names = [row.split(",")[column] for row in rows]
    assert names == [result.posed_by or "floam" for result in outcome.record.results]
    assert posed_by == Counter(names)
    # Which of both stands in hangs on the noise.
    assert names[0] == "floam"
    assert [name in ("less planar points", "all-points") for name in names[1:]] == 7 * [True]
    stood_in = ", ".join(f"{name} {count}" for name, count in posed_by.items() if name != "floam")
    assert f"posed by     {stood_in} of 8 scans" in summary(outcome.record, None)


def test_a_method_without_features_is_refused_with_those_that_have_them() -> None:
    with pytest.raises(UsageError, match=r"icp has no feature map.*loam-odom, loam, floam, lego-loam"):
        check_config(load_config(None, ["map.write_features=true"], {}))


def test_scalars_of_a_ply_come_after_the_intensity(tmp_path: Path) -> None:
    points = np.arange(6.0).reshape(2, 3)
    write_ply(tmp_path / "a.ply", points, np.array([7.0, 8.0]), scalars={"class": np.array([1, 0], np.uint8)})
    body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")[2]
    np.testing.assert_array_equal(
        np.frombuffer(body, "<f4").reshape(2, 5), [[0, 1, 2, 7, 1], [3, 4, 5, 8, 0]]
    )  # fmt: skip
