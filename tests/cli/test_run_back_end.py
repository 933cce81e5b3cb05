"""`lslam run` with loops, fixes and somebody else's poses, as a user calls it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from calling import SAMPLE, assert_one_sentence, lslam, manifest, sample_copy, strict_json

from lslam.core.geometry import geodesy
from lslam.io.formats.trajectory_files import read_trajectory

PART = ("--count", 40, "-q", "--set", "map.write=false", "--set", "report.html=false")


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The whole sample, round a block, with fixes in the graph and loops."""
    out = tmp_path_factory.mktemp("run") / "closed"
    done = lslam("run", SAMPLE, "--out", out, "--gnss", "--crs", "EPSG:25832", "--set", "map.format=laz")
    assert done.returncode == 0, done.stderr
    assert "closed of" in done.stdout
    assert "georeference" in done.stdout
    return out


def test_fixes_place_the_run_where_the_sample_was_made(closed: Path) -> None:
    """Ten fixes of a metre and a half: the place to a metre, and the shape of odometry with loops."""
    facts = manifest(closed)
    place = facts["georeference"]
    assert (place["method"], place["epsg"], facts["status"]) == ("graph", 25832, "done")
    positions = read_trajectory(closed / "trajectory.tum").positions
    city = geodesy.to_local(
        geodesy.from_local(positions, np.array(place["origin_lat_lon_height"])), np.array([49.0, 8.4, 115])
    )
    rows = np.loadtxt(SAMPLE / "sequences" / "00" / "gnss.csv", delimiter=",", skiprows=1)
    fixes = geodesy.to_local(rows[:, 1:4], np.array([49.0, 8.4, 115]))
    gap = np.linalg.norm(fixes[:, None, :2] - city[None, :, :2], axis=2).min(1)
    assert gap.max() < 3 * rows[:, 4].max() + 1.5
    assert "east, north, up" in facts["frames"]["world"]


def test_a_map_in_degrees_is_refused_before_it_is_built(closed: Path) -> None:
    before = (closed / "map.laz").read_bytes()
    done = lslam("map", closed, "--crs", "EPSG:4326", "--overwrite")
    assert done.returncode == 2
    assert "EPSG:4326 (WGS 84) does not count in metres on a plane" in done.stderr
    assert "scans/s" not in done.stderr
    assert (closed / "map.laz").read_bytes() == before


def test_odometry_and_optimised_trajectory_are_distinguished(closed: Path) -> None:
    document = strict_json((closed / "evaluation.json").read_text())
    before, after = document["odometry"]["ate"]["se3"]["rmse"], document["ate"]["se3"]["rmse"]
    assert after < before + max(0.05 * before, 0.01)
    assert (closed / "graph.g2o").read_text().startswith("VERTEX_SE3:QUAT 0 ")
    assert "accepted" in (closed / "loops.csv").read_text()
    assert "Before and after the pose graph" in (closed / "report.html").read_text()
    world = np.load(closed / "covariances.npz")["covariances"]
    assert np.linalg.eigvalsh(world).min() > 0


def test_without_loops_it_is_odometry_byte_for_byte(closed: Path, tmp_path: Path) -> None:
    done = lslam("run", SAMPLE, "--out", tmp_path / "out", "--no-loops", "-q", "--set", "map.write=false")
    assert done.returncode == 0
    pure, kept = (
        folder / name for folder, name in ((tmp_path / "out", "trajectory.tum"), (closed, "trajectory_odometry.tum"))
    )
    rows = [[line for line in path.read_text().splitlines() if not line.startswith("#")] for path in (pure, kept)]
    assert rows[0] == rows[1]
    assert not (tmp_path / "out" / "graph.g2o").exists()


def test_external_poses(closed: Path, tmp_path: Path) -> None:
    """Without stamps and of the camera: one line per scan, converted."""
    out = tmp_path / "out"
    words = ("--poses", SAMPLE / "poses" / "00.txt", "--georeference", "-q", "--json", "--set", "report.html=false")
    done = lslam("run", SAMPLE, "--out", out, *words)
    assert done.returncode == 0, done.stderr
    document = strict_json(done.stdout)
    assert document["manifest"]["method"] == "poses"
    assert document["manifest"]["counts"]["ok"] == 95
    assert document["manifest"]["georeference"]["method"] == "fit"
    assert document["evaluation"]["ate"]["se3"]["rmse"] < 0.01
    assert (out / "map.ply").exists()


def test_drift_is_reported(tmp_path: Path) -> None:
    done = lslam("run", SAMPLE, "--out", tmp_path / "out", *PART, "--set", "debug.drift=true")
    assert done.returncode == 0
    facts = manifest(tmp_path / "out")
    assert facts["status"] == "degraded"
    assert "experiment" in facts["problems"][0]
    assert "experiment" in done.stderr


def test_bad_fixes_make_the_run_degraded(tmp_path: Path) -> None:
    copy = sample_copy(tmp_path / "copy", 40)
    path = copy / "gnss.csv"
    head, *rows = path.read_text().splitlines()
    wrong = [",".join([r.split(",")[0], "0", "0", "0", r.split(",")[4]]) for r in rows]
    path.write_text("\n".join([head, *wrong]) + "\n")
    done = lslam("run", copy, "--out", tmp_path / "out", *PART, "--gnss")
    assert done.returncode == 0
    facts = manifest(tmp_path / "out")
    assert facts["status"] == "degraded"
    assert any("GNSS" in problem for problem in facts["problems"])
    assert "georeference" not in facts


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("--poses", "nowhere.tum"), 3, "nowhere.tum"),
        (("--poses", SAMPLE / "poses" / "00.txt", "--method", "loam"), 2, "--method loam"),
        (("--poses", SAMPLE / "poses" / "00.txt", "--imu"), 2, "--imu"),
        (("--method", "poses"), 2, "--poses"),
        (("--gnss", "--crs", "utm"), 2, "EPSG"),
    ],
)
def test_what_does_not_go_together_is_one_sentence(
    words: tuple[object, ...], code: int, said: str, tmp_path: Path
) -> None:
    done = lslam("run", SAMPLE, "--out", tmp_path / "out", "-q", *words)
    assert done.returncode == code
    assert_one_sentence(done.stderr)
    assert said in done.stderr


def test_poses_that_do_not_belong_to_the_scans(tmp_path: Path) -> None:
    short = tmp_path / "short.txt"
    short.write_text("\n".join((SAMPLE / "poses" / "00.txt").read_text().splitlines()[:20]) + "\n")
    done = lslam("run", SAMPLE, "--out", tmp_path / "out", "-q", "--poses", short)
    assert done.returncode == 3
    assert "95 scans" in done.stderr


def test_missing_fixes_are_reported_before_the_run(tmp_path: Path) -> None:
    copy = sample_copy(tmp_path / "copy", 40)
    toml = copy / "sequence.toml"
    toml.write_text(toml.read_text().replace('gnss = "gnss.csv"\n', ""))
    (copy / "gnss.csv").unlink()
    done = lslam("run", copy, "--out", tmp_path / "out", "-q", "--georeference")
    assert done.returncode == 3
    assert "satellite fixes" in done.stderr
