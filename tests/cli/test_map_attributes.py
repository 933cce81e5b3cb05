"""`lslam map --attributes`, and maps of every point, held against the raw scans."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
from calling import SAMPLE, assert_one_sentence, lslam, manifest, sample_copy, strict_json

from lslam.core.config import load_config
from lslam.core.labels import CLASSES
from lslam.core.types.scan import NO_RING, Scan
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.sequence import SequenceView
from lslam.io.formats.ply_files import ply_columns
from lslam.io.formats.point_files import read_cloud
from lslam.io.readers import open_sequence
from lslam.pipeline.map_pass import build_map, with_attributes
from lslam.registration.preprocessing.rings import RingRule
from lslam.registration.preprocessing.views import RingView
from lslam.simulation.scenarios import simulate

COUNT = 10


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("attributes")
    done = lslam("run", sample_copy(root / "data", COUNT), "--out", root / "run", "-q")
    assert done.returncode == 0, done.stderr
    return root / "run"


def scans_of(run: Path) -> list[Scan]:
    sequence = open_sequence(Path(manifest(run)["sequence"]["path"]))
    return [sequence.scan(k) for k in range(COUNT)]


def test_every_point_of_every_scan_with_its_own_attributes(ran: Path, tmp_path: Path) -> None:
    one, tiles = tmp_path / "one.laz", tmp_path / "tiles"
    words = ("--voxel", 0, "--attributes", "time,scan,ring,range")
    done = lslam("map", ran, *words, "--out", one)
    assert done.returncode == 0, done.stderr
    assert "crispness  n/a: the map has every point" in done.stdout
    cloud, scans = laspy.read(one), scans_of(ran)
    for k, scan in enumerate(scans):
        own = np.array(cloud.point_source_id) == k
        ranges = np.linalg.norm(scan.points.astype(np.float64), axis=1)
        assert own.sum() == np.count_nonzero((ranges >= 2) & (ranges <= 80))
        assert not set(np.array(cloud["range"])[own].tolist()) - set(ranges.astype(np.float32).tolist())
        since = np.array(cloud.gps_time)[own] - 1e-9 * scan.stamp_ns
        assert scan.span.begin_s - 1e-6 <= since.min() <= since.max() <= scan.span.end_s + 1e-6
    about = json.loads((tmp_path / "one.json").read_text())
    assert list(about["attributes"]) == ["time", "scan", "ring", "range"]
    assert "no Unix time" in about["attributes"]["time"]
    assert done.stderr.count("no Unix time") == 1

    done = lslam("map", ran, *words, "--tiles", 20, "--format", "laz", "--out", tiles)
    assert done.returncode == 0, done.stderr
    parts = [laspy.read(path) for path in sorted(tiles.glob("*.laz"))]
    for name in ("x", "gps_time", "point_source_id", "ring", "range"):
        joined = np.concatenate([np.array(part[name]) for part in parts])
        np.testing.assert_allclose(np.sort(joined), np.sort(np.array(cloud[name])), atol=1e-9, rtol=0)


def test_a_map_of_voxels_has_what_its_nearest_points_had(ran: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.ply"
    done = lslam("map", ran, "--set", "map.attributes=scan,range,observations,time", "--out", out)
    assert done.returncode == 0, done.stderr
    columns, scans = ply_columns(out), scans_of(ran)
    assert list(columns) == ["x", "y", "z", "intensity", "scan", "range", "observations", "time"]
    stamps = np.array([scan.stamp_ns for scan in scans])
    since = columns["time"] - 1e-9 * stamps[columns["scan"]]
    assert since.min() >= min(scan.span.begin_s for scan in scans) - 1e-6
    assert since.max() <= max(scan.span.end_s for scan in scans) + 1e-6
    # trajectory.tum rounds to nanometres.
    np.testing.assert_allclose(read_cloud(out).points, read_cloud(ran / "map.ply").points, atol=1e-5, rtol=0)
    assert lslam("map", ran, "--voxel", 0, "--out", tmp_path / "all.ply").returncode == 0
    assert columns["observations"].sum() == len(read_cloud(tmp_path / "all.ply"))


def test_classes_of_labelled_points() -> None:
    drive = simulate("lights", lidar="vlp16", count=3)
    assert drive.ground_truth is not None
    results = [
        ScanResult(k, int(t), T, "ok")
        for k, (t, T) in enumerate(zip(drive.stamps_ns, drive.ground_truth.poses, strict=True))
    ]
    config = load_config(None, ["map.attributes=class,ring", "map.voxel=0"])
    built = build_map(drive, results, config)
    columns = [block.columns for block in built.cloud.blocks()]
    labels, rings = (np.concatenate([c[name] for c in columns]) for name in ("class", "ring"))
    assert CLASSES["moving-car"] in labels
    assert set(labels.tolist()) <= set(CLASSES.values())
    assert set(rings.tolist()) == set(range(16))


class WithoutRings(SequenceView):
    def scan(self, index: int) -> Scan:
        scan = self.whole.scan(index)
        return Scan(scan.points, scan.stamp_ns, scan.index, scan.intensity, scan.times)


def test_rings_are_found_where_the_recording_has_none() -> None:
    drive = simulate("block", lidar="vlp16", count=3)
    config = load_config(None, ["map.attributes=ring"])
    bare = WithoutRings(drive)
    rings, truth = with_attributes(bare, config).scan(1).rings, drive.scan(1).rings
    assert bare.scan(1).rings is None
    assert rings is not None
    assert truth is not None
    assert len(rings) == len(truth)
    # The rule counts from the top, the simulator may count from the bottom.
    assert len({*zip(rings.tolist(), truth.tolist(), strict=True)}) == 16
    assert NO_RING not in rings


def test_a_run_whose_map_has_every_point_says_so_and_has_no_score(ran: Path, tmp_path: Path) -> None:
    run = shutil.copytree(ran, tmp_path / "run")
    assert "map" in strict_json((run / "evaluation.json").read_text())
    for _ in range(2):
        done = lslam("map", run, "--voxel", 0, "--overwrite", "-q")
        assert done.returncode == 0, done.stderr
        assert "map" not in strict_json((run / "evaluation.json").read_text())
        assert "built anew after the run with every point" in (run / "report.html").read_text()
        assert manifest(run)["map_points"] == len(read_cloud(run / "map.ply"))
    assert lslam("map", run, "--overwrite", "-q").returncode == 0
    assert strict_json((run / "evaluation.json").read_text()) == strict_json((ran / "evaluation.json").read_text()) | {
        "map": strict_json((run / "evaluation.json").read_text())["map"]
    }


class PartlyRinged(SequenceView):
    def scan(self, index: int) -> Scan:
        scan = self.whole.scan(index)
        assert scan.rings is not None
        return replace(scan, rings=np.where(np.arange(len(scan)) % 3 == 0, NO_RING, scan.rings).astype(np.uint16))


def test_points_without_a_ring_stay_where_none_is_required() -> None:
    drive, rule = simulate("block", lidar="vlp16", count=2), RingRule("field", 16)
    whole = drive.scan(1)
    kept = RingView(PartlyRinged(drive), rule, is_strict=False).scan(1)
    assert len(kept) == len(whole)
    assert kept.rings is not None
    assert np.count_nonzero(kept.rings == NO_RING) == -(-len(whole) // 3)
    assert len(RingView(PartlyRinged(drive), rule).scan(1)) == len(whole) - -(-len(whole) // 3)


def test_what_cannot_be_is_said_in_one_sentence(ran: Path, tmp_path: Path) -> None:
    run = shutil.copytree(ran, tmp_path / "run")
    before = {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()}
    for words, code, sentence in (
        (("map", run, "--attributes", "speed"), 2, "'speed' is no attribute of points: time, scan"),
        (
            ("map", run, "--attributes", "class", "--out", tmp_path / "a.laz"),
            3,
            "map.attributes needs labels of points",
        ),
        (("map", run, "--voxel", 0.001), 2, "must be 0.01 m or more, or 0 for every point"),
        (("map", run, "--voxel", 0, "--mesh"), 2, "mesh, denoise and colour need voxels"),
        (
            ("map", run, "--against", run, "--changes", tmp_path / "c", "--attributes", "time"),
            2,
            "--attributes has no meaning",
        ),
        (("run", SAMPLE, "--set", "map.attributes=class", "--out", tmp_path / "b"), 3, "map.attributes needs labels"),
    ):
        done = lslam(*words)
        assert done.returncode == code, done.stderr
        assert sentence in done.stderr
        assert_one_sentence(done.stderr)
    assert {path.name for path in tmp_path.iterdir()} == {"run"}
    assert before == {path.name: path.read_bytes() for path in run.iterdir() if path.is_file()}
