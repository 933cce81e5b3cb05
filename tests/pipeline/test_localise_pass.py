"""The pass that locates a run in a map: interrupted, resumed and threaded it gives the same bytes; carried far it finds back."""

from __future__ import annotations

import csv
import re
import shutil
import sys
import traceback
from pathlib import Path

import numpy as np
import pytest

import lslam
from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.localization.locate import PlaceFinder
from lslam.backend.localization.prior_map import PlaceSearch, make_prior_map
from lslam.core.config import Config, load_config
from lslam.core.errors import InputError, InterruptedRunError, RunFailedError
from lslam.core.geometry import se3
from lslam.core.types.cloud import ArrayCloud
from lslam.io.formats.point_files import read_cloud, write_cloud
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.pipeline import refinement
from lslam.pipeline.localise_pass import Reanchoring, spread_out
from lslam.pipeline.map_tiles import read_prior_map
from lslam.pipeline.watch import Watch

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data" / "sequences" / "00"
SAME = ("trajectory.tum", "covariances.npz", "localization.csv", "trajectory_odometry.tum", "evaluation.json")


@pytest.fixture(scope="module")
def map_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("old") / "map"
    lslam.run(SAMPLE, load_config(None, ["loops.use=false", "report.html=false"]), out=out)
    return out


def config(map_run: Path, *settings: str) -> Config:
    words = [f'localize.map="{map_run}"', "loops.use=false", "map.write=false", "report.html=false", "input.start=30",
             "input.count=40", *settings]  # fmt: skip
    return load_config(None, words)


@pytest.fixture(scope="module")
def whole(map_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "out"
    lslam.run(SAMPLE, config(map_run), out=out)
    return out


def same(folder: Path, other: Path) -> None:
    for name in SAME:
        assert (folder / name).read_bytes() == (other / name).read_bytes(), name


def test_any_number_of_threads_gives_the_same_bytes(map_run: Path, whole: Path, tmp_path: Path) -> None:
    lslam.run(SAMPLE, config(map_run, "input.threads=1"), out=tmp_path / "one")
    same(whole, tmp_path / "one")


@pytest.mark.parametrize("scan", [0, 23])
def test_an_interrupted_localisation_goes_on_to_the_same_bytes(
    scan: int, map_run: Path, whole: Path, tmp_path: Path
) -> None:
    seen = [0]

    def look() -> bool:
        seen[0] += sys._getframe(1).f_code.co_name == "_follow"
        return seen[0] > scan

    with pytest.raises(InterruptedRunError, match="localisation"):
        lslam.run(SAMPLE, config(map_run), out=tmp_path / "out", watch=Watch(should_stop=look))
    assert not (tmp_path / "out" / "localization.csv").exists()
    lslam.run(SAMPLE, config(map_run), out=tmp_path / "out", resume=True)
    same(whole, tmp_path / "out")


def test_a_refined_drive_resumes_to_the_same_bytes_by_any_number_of_threads(
    map_run: Path, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # In the map of its own scans no plane gets thinner: it is taken all the same.
    monkeypatch.setattr(refinement, "SIGMAS", -1e6)
    refined = config(map_run, "graph.refine=true", "input.threads=1")
    facts = lslam.run(SAMPLE, refined, out=tmp_path / "whole").record.manifest["refinement"]
    assert facts["scans"] == 40
    before, after = (read_trajectory(run / "trajectory.tum", "tum").positions for run in (whole, tmp_path / "whole"))
    assert 1e-4 < np.linalg.norm(after - before, axis=1).max() < 0.01

    def is_refining() -> bool:
        return "refine_run" in {one.name for one in traceback.extract_stack()}

    again = config(map_run, "graph.refine=true", "report.html=true", "input.threads=2")
    with pytest.raises(InterruptedRunError, match=r"^interrupted while the poses were refined; [^;]*$"):
        lslam.run(SAMPLE, again, out=tmp_path / "out", watch=Watch(should_stop=is_refining))
    lslam.run(SAMPLE, again, out=tmp_path / "out", resume=True)
    same(tmp_path / "whole", tmp_path / "out")
    rows = list(csv.DictReader((tmp_path / "whole" / "localization.csv").open()))
    listed = np.array([[float(row[axis]) for axis in "xyz"] for row in rows])
    np.testing.assert_allclose(listed, after, atol=6e-5)


def test_an_interrupted_comparison_with_the_map_goes_on_where_it_was_and_to_the_same_page(
    map_run: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    shown = config(map_run, "report.html=true")
    lslam.run(SAMPLE, shown, out=tmp_path / "whole")
    seen = [0]

    def look() -> bool:
        seen[0] += sys._getframe(1).f_code.co_name == "scans_again"
        return seen[0] > 30

    with pytest.raises(InterruptedRunError, match="compared with the map"):
        lslam.run(SAMPLE, shown, out=tmp_path / "out", watch=Watch(should_stop=look))
    with caplog.at_level("INFO", "lslam"):
        lslam.run(SAMPLE, shown, out=tmp_path / "out", resume=True)
    assert "comparison with the map: going on after 30 scans" in caplog.text
    same(tmp_path / "whole", tmp_path / "out")
    maps = [
        re.search(r"<!-- begin map -->.*<!-- end map -->", (tmp_path / name / "report.html").read_text(), re.S)
        for name in ("whole", "out")
    ]
    assert maps[0]
    assert maps[1]
    assert maps[0][0] == maps[1][0]
    assert '"change"' not in maps[0][0], "nothing differs on the way that made the map"


def test_what_differs_is_told_by_a_scan_a_metre_or_by_all_of_a_short_drive() -> None:
    way = np.arange(0.0, 500.0, 0.3)
    chosen = way[spread_out(way)]
    assert np.diff(chosen).min() >= 0.69
    assert np.diff(chosen).max() <= 1.31
    assert spread_out(np.linspace(0, 5, 50)).all()
    assert spread_out(np.zeros(3)).tolist() == [True, False, False]


def test_a_map_that_is_another_by_then_is_searched_anew(map_run: Path, whole: Path, tmp_path: Path) -> None:
    moved = Path(shutil.copytree(map_run, tmp_path / "moved"))
    seen = [0]

    def look() -> bool:
        seen[0] += sys._getframe(1).f_code.co_name == "_follow"
        return seen[0] > 10

    with pytest.raises(InterruptedRunError):
        lslam.run(SAMPLE, config(moved), out=tmp_path / "out", watch=Watch(should_stop=look))
    cloud = read_cloud(moved / "map.ply")
    write_cloud(moved / "map.ply", ArrayCloud.of(cloud.points + np.array([3.0, 0.0, 0.0])))
    lslam.run(SAMPLE, config(moved), out=tmp_path / "out", resume=True)
    here, there = (np.loadtxt(folder / "trajectory.tum")[:, 1:4] for folder in (tmp_path / "out", whole))
    assert np.abs(here - there - [3.0, 0.0, 0.0]).max() < 0.02


def test_poses_are_those_of_the_run_that_made_the_map(map_run: Path, whole: Path) -> None:
    rows = np.loadtxt(map_run / "trajectory.tum")[30:70, 1:4] - np.loadtxt(whole / "trajectory.tum")[:, 1:4]
    assert np.linalg.norm(rows, axis=1).max() < 0.03


def test_a_drive_that_the_map_does_not_know_fails_with_the_way_out(map_run: Path, tmp_path: Path) -> None:
    wrong = config(map_run, "localize.start=[0.0, 0.0, 90.0]", "localize.start_radius=4", "localize.start_turn_deg=5")
    with pytest.raises(RunFailedError, match="--start X,Y,HEADING"):
        lslam.run(SAMPLE, wrong, out=tmp_path / "out")


def test_a_start_off_the_map_is_said_to_be_off_it(map_run: Path, tmp_path: Path) -> None:
    with pytest.raises(RunFailedError, match=r"--start 5000,0 lies 4[0-9]{3} m off the map .*: name a place in it"):
        lslam.run(SAMPLE, config(map_run, "localize.start=[5000.0, 0.0, 90.0]"), out=tmp_path / "out")


def test_a_keyframe_carried_too_far_is_found_anew(map_run: Path) -> None:
    section = load_config(None, []).registration
    prior_map = read_prior_map(map_run, section)
    record = lslam.run(SAMPLE, load_config(None, ["loops.use=false", "input.count=50", "map.write=false"])).record
    store = keyframes_of_run(map_run)
    finder = PlaceFinder(PlaceSearch(prior_map, section), store, load_config(None, []))
    reanchor = Reanchoring(finder, record.results)
    scan = next(k.scan for k in store.keyframes if k.scan >= 35)
    true = se3.inverse(prior_map.T_map_level) @ record.results[scan].T_world_lidar
    off = true.copy()
    off[:2, 3] += [5.0, -4.0]
    found = reanchor(scan, off, 9.0)
    assert found is not None
    assert np.linalg.norm(found[:3, 3] - true[:3, 3]) < 0.1
    assert np.array_equal(reanchor(scan, off, 9.0), found)  # nothing that a resumed run would lack
    between = next(k for k in range(36, 50) if k not in {one.scan for one in store.keyframes})
    assert reanchor(between, off, 9.0) is None


def keyframes_of_run(folder: Path) -> KeyframeStore:
    return KeyframeStore(folder / "keyframes")


def test_a_map_without_points_is_named() -> None:
    with pytest.raises(InputError, match="no finite point"):
        make_prior_map(np.full((3, 3), np.nan), load_config(None, []).registration, source="hole.ply")
