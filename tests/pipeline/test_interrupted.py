"""A run that is stopped at any of its checks ends as interrupted, and resumes to the same bytes."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

import lslam
from lslam.core.config import Config, load_config
from lslam.core.errors import InterruptedRunError
from lslam.pipeline.watch import Watch

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data" / "sequences" / "00"
RESULTS = ("trajectory.tum", "covariances.npz", "loops.csv", "graph.g2o", "map.ply", "evaluation.json")
OF_ALL = (*RESULTS, "osm_matches.csv", "buildings.geojson", "occupancy.ply", "trajectory.geojson")
# The whole round, so that it closes: by every other scan, and half as many keyframes.
# Each scan is decided as it comes: none is registered again on the map of those that follow.
SPARSE, SCANS = ("input.skip_frames=2", "keyframes.distance=4", "registration.start_scans=1"), 48
# Who asks in a run that does everything: what takes long where a recording is long.
ASKERS = (
    "estimate", "find", "floor_planes", "_voted_out", "solve", "marginal_blocks", "_along", "sightings",
    "finish", "agreeing", "absent_buildings", "new_walls", "remove_overlaps", "scans_again", "merge", "_pieces", "make_report",
)  # fmt: skip


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(None, [*SPARSE, "map.voxel=0.5"])


@pytest.fixture(scope="module")
def everything() -> Config:
    return load_config(
        None,
        [
            *SPARSE, "imu.use=true", "gnss.mode=graph", f"osm.extract={json.dumps(str(SAMPLE / 'map_perturbed.osm'))}",
            "osm.mode=non-rigid", "graph.floor=true", "map.clean=true", "map.occupancy=true", "map.voxel=0.5",
            "loops.spacing=1", "loops.min_travel=20", "report.html=false", "odometry.checkpoint_s=0.2",
        ],
    )  # fmt: skip


def asked(at: Callable[[int, str], bool], looks: list[str]) -> Watch:
    """Asks to stop from the look on that `at` is true of: its number, and the function that looks."""
    is_asked = [False]

    def look() -> bool:
        frame = sys._getframe(1)
        while frame.f_globals["__name__"] == "lslam.core.stopping" or frame.f_code.co_name in (
            "<lambda>",
            "<listcomp>",
        ):
            assert frame.f_back is not None
            frame = frame.f_back
        looks.append(frame.f_code.co_name)
        is_asked[0] |= at(len(looks) - 1, looks[-1])
        return is_asked[0]

    return Watch(should_stop=look)


def all_looks(config: Config, out: Path) -> list[str]:
    """Who looked in an uninterrupted run, look by look."""
    looks = list[str]()
    lslam.run(SAMPLE, config, out=out, watch=asked(lambda look, who: False, looks))
    return looks


@pytest.fixture(scope="module")
def whole(config: Config, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """An uninterrupted run, and who looked."""
    out = tmp_path_factory.mktemp("whole") / "out"
    return out, all_looks(config, out)


@pytest.fixture(scope="module")
def whole_of_all(everything: Config, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[str]]:
    """Likewise, of a run that does everything."""
    out = tmp_path_factory.mktemp("all") / "out"
    return out, all_looks(everything, out)


def test_every_stage_checks_for_a_stop(whole: tuple[Path, list[str]]) -> None:
    """Each scan of odometry and of the map, each keyframe, before and in the graph, the map, and before the last word."""
    out, looks = whole
    keyframes = json.loads((out / "manifest.json").read_text())["keyframes"]["count"]
    counts = Counter(looks)
    assert {who: counts[who] for who in ("estimate", "find", "optimise_poses", "scans_again", "make_report")} == {
        "estimate": SCANS, "find": keyframes, "optimise_poses": 1, "scans_again": SCANS, "make_report": 1,
    }  # fmt: skip
    assert counts["marginal_blocks"] == keyframes
    assert counts["solve"] >= 2, "before the first iteration and after it"


def test_every_long_loop_checks_for_a_stop(whole_of_all: tuple[Path, list[str]]) -> None:
    out, looks = whole_of_all
    keyframes = json.loads((out / "manifest.json").read_text())["keyframes"]["count"]
    counts = Counter(looks)
    assert not set(ASKERS) - set(counts)
    assert counts["_along"] >= keyframes
    assert counts["finish"] >= keyframes, "each keyframe's buildings, and each scan that the cleaner held back"


def assert_stops(config: Config, out: Path, asker: str, number: int) -> None:
    """Interrupted when a function looks for the `number`-th time, a run does nothing more but to say so."""
    looks, left = list[str](), list[int]()

    def at(look: int, who: str) -> bool:
        if left or (who == asker and looks.count(asker) > number):
            left.append(look)
        return bool(left)

    with pytest.raises(InterruptedRunError, match=r"interrupted .*--resume goes on"):
        lslam.run(SAMPLE, config, out=out, resume=True, watch=asked(at, looks))
    assert json.loads((out / "manifest.json").read_text())["status"] == "interrupted"
    assert any((out / "checkpoint").glob("odometry-*.npz"))
    assert not list(out.rglob("*.part"))
    assert len(left) <= 3, f"what comes after the look of {asker} is not begun"


def assert_goes_on(
    config: Config, reference: Path, out: Path, names: tuple[str, ...], stops: Iterable[tuple[str, int]]
) -> None:
    """One run, stopped at each of these looks in turn, ends with the bytes of one that nobody stopped."""
    for asker, number in stops:
        assert_stops(config, out, asker, number)
    lslam.run(SAMPLE, config, out=out, resume=True)
    assert json.loads((out / "manifest.json").read_text())["status"] in ("done", "degraded")
    for name in names:
        assert (out / name).read_bytes() == (reference / name).read_bytes(), name


def test_a_stop_at_any_check_interrupts_and_resumes_to_the_same_bytes(
    whole: tuple[Path, list[str]], config: Config, tmp_path: Path
) -> None:
    """Before the first scan, on the way, before the last; in keyframes, graph and map; before the last word."""
    stops = [
        ("estimate", 0), ("estimate", 20), ("estimate", 24), ("find", 1), ("find", 17), ("solve", 1),
        ("marginal_blocks", 5), ("scans_again", 0), ("scans_again", 24), ("scans_again", 23), ("make_report", 0),
    ]  # fmt: skip
    assert_goes_on(config, whole[0], tmp_path / "out", RESULTS, stops)


def test_a_stop_in_graph_buildings_or_map_interrupts_and_resumes_to_the_same_bytes(
    whole_of_all: tuple[Path, list[str]], everything: Config, tmp_path: Path
) -> None:
    counts = Counter(whole_of_all[1])
    # In the solver and its covariances, the run without buildings is stopped.
    askers = ("_along", "agreeing", "new_walls", "merge", "_pieces")
    stops = [(asker, counts[asker] // 2) for asker in askers]
    assert_goes_on(everything, whole_of_all[0], tmp_path / "out", OF_ALL, stops)


@pytest.mark.parametrize("way", ["resume", "overwrite"])
def test_a_run_that_was_stopped_before_it_knew_its_configuration_begins_anew(
    way: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    config = load_config(None, ["input.count=6", "map.write=false", "report.html=false"])

    def stopped(config: Config) -> str:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("lslam.pipeline.outputs.config_text", stopped)
        with pytest.raises(KeyboardInterrupt):
            lslam.run(SAMPLE, config, out=tmp_path / "out")
    assert not (tmp_path / "out" / "config.toml").exists()
    lslam.run(SAMPLE, config, out=tmp_path / "out", **{way: True})
    assert json.loads((tmp_path / "out" / "manifest.json").read_text())["status"] == "done"
    assert len((tmp_path / "out" / "trajectory_kitti.txt").read_text().splitlines()) == 6
