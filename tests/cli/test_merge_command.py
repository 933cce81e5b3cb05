"""`lslam merge` as a user calls it: two drives of one town, one of another, and folders that are none."""

from __future__ import annotations

import json
import shutil
import sys
import traceback
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import SAMPLE, assert_one_sentence, lslam, strict_json
from made_once import MadeOnce
from revisits import frame_from_town, place_visits, run, town_poses

from lslam.backend.localization.sessions import by_georeference
from lslam.core.config import load_config
from lslam.core.errors import InterruptedRunError
from lslam.core.geometry import se3
from lslam.core.geometry.se3 import umeyama
from lslam.core.types.gnss import Georeference
from lslam.io.formats.point_files import read_cloud
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.maps.georeference import Projection
from lslam.pipeline.merge_runs import read_session
from lslam.pipeline.merged_folder import merge_into
from lslam.pipeline.watch import Watch

SAME = ("sessions/monday-run.tum", "sessions/tuesday-run.tum", "loops.csv", "graph.g2o", "map.ply")


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory, made_once: MadeOnce) -> Path:
    """Runs of `monday`, of `tuesday`, and of another town."""
    root = tmp_path_factory.mktemp("runs")
    place_visits(root, made_once, {"monday": "monday-run", "tuesday": "tuesday-run"})
    done = lslam("run", SAMPLE, "--count", 20, "--out", root / "elsewhere", "-q", "--set", "map.write=false")
    assert done.returncode == 0, done.stderr
    return root


@pytest.fixture(scope="module")
def town(runs: Path) -> Path:
    words = (runs / "monday-run", runs / "elsewhere", runs / "tuesday-run", "--out", runs / "town", "--json")
    done = lslam("merge", *words)
    assert done.returncode == 0, done.stderr
    (runs / "town.json").write_text(done.stdout)
    return runs / "town"


def test_all_sessions_lie_in_one_frame(runs: Path, town: Path) -> None:
    est = [read_trajectory(town / "sessions" / f"{name}-run.tum", "tum").positions for name in ("monday", "tuesday")]
    true = [town_poses(runs, name)[:, :3, 3] for name in ("monday", "tuesday")]
    T, _, _ = umeyama(np.concatenate(est), np.concatenate(true))
    away = np.linalg.norm(se3.apply(T, np.concatenate(est)) - np.concatenate(true), axis=1)
    # One alignment for both: what holds them together is the loops between them.
    assert away.max() < 0.02


def test_a_drive_of_another_town_is_left_out_and_named(runs: Path, town: Path) -> None:
    manifest = strict_json((runs / "town.json").read_text())["manifest"]
    assert [one["name"] for one in manifest["sessions"]] == ["monday-run", "tuesday-run"]
    assert [one["name"] for one in manifest["left_out"]] == ["elsewhere"]
    assert manifest["status"] == "degraded"
    assert all(one["loops_between"] > 0 for one in manifest["sessions"])
    page = (town / "report.html").read_text()
    assert "elsewhere is left out" in page.replace("Elsewhere", "elsewhere")
    assert "tuesday-run" in page


def test_the_map_is_of_both(runs: Path, town: Path) -> None:
    both, one = read_cloud(town / "map.ply").points, read_cloud(runs / "monday-run" / "map.ply").points
    assert len(both) > 1.05 * len(one)
    assert strict_json((town / "map.json").read_text())["sequence"] == "monday-run, tuesday-run"


def test_the_map_has_no_points_of_the_vehicles_of_its_runs(runs: Path, town: Path, tmp_path: Path) -> None:
    """The box of tuesday's vehicle holds all that is seen ahead: the merge's own configuration knows nothing of it."""
    shutil.copytree(runs / "tuesday-run", tmp_path / "tuesday-run")
    text = (tmp_path / "tuesday-run" / "config.toml").read_text()
    assert "\n[preprocess]\n" in text
    box = "\n[preprocess]\nego_box = [0.0, 500.0, -500.0, 500.0, -500.0, 500.0]\n"
    (tmp_path / "tuesday-run" / "config.toml").write_text(text.replace("\n[preprocess]\n", box))
    folders = [runs / "monday-run", tmp_path / "tuesday-run"]
    merge_into(folders, tmp_path / "town", load_config(None, []), Watch())
    both, fewer = (len(read_cloud(folder / "map.ply").points) for folder in (town, tmp_path / "town"))
    assert fewer < 0.98 * both


def test_sessions_on_the_earth_are_sought_where_they_lie(runs: Path, tmp_path: Path) -> None:
    on_earth = Projection(Georeference(np.array([49.0112, 8.4229, 115.0]), np.eye(4), 25832))
    truths = {name: town_poses(runs, name)[:20, :3, 3] for name in ("monday", "tuesday")}
    for name, run_of in (("monday", "monday-run"), ("tuesday", "tuesday-run"), ("monday", "elsewhere")):
        places = on_earth.apply(truths[name])
        rows = [f"{k},{places[k, 0]:.3f},{places[k, 1]:.3f},{places[k, 2]:.3f},0.5,EPSG:25832" for k in (0, 9, 19)]
        (tmp_path / "points.csv").write_text("\n".join(["scan,x,y,z,sigma,crs", *rows]) + "\n")
        words = ("--control", tmp_path / "points.csv", "--no-map", "--out", tmp_path / run_of, "-q")
        assert lslam("graph", runs / run_of, *words).returncode == 0
    read = [read_session(tmp_path / name, name)[1] for name in ("monday-run", "tuesday-run")]
    T = by_georeference(read[1], read[:1])
    assert T is not None
    true = [frame_from_town(runs, tmp_path / f"{name}-run" / "trajectory.tum", name) for name in ("monday", "tuesday")]
    apart = se3.relative(true[0] @ se3.inverse(true[1]), T)
    assert np.linalg.norm(apart[:2, 3]) < 0.5
    names = [tmp_path / name for name in ("monday-run", "elsewhere", "tuesday-run")]
    done = lslam("merge", *names, "--out", tmp_path / "town", "--json", "--set", "map.write=false")
    assert done.returncode == 0, done.stderr
    about = strict_json(done.stdout)["manifest"]
    assert [one["name"] for one in about["sessions"]] == ["monday-run", "tuesday-run"]
    assert "not where its georeference puts it" in about["left_out"][0]["why"]


def test_a_merged_town_takes_another_run(runs: Path, town: Path, tmp_path: Path) -> None:
    done = lslam("merge", town, runs / "elsewhere", "--out", tmp_path / "more", "--no-map", "--json")
    assert done.returncode == 0, done.stderr
    manifest = strict_json(done.stdout)["manifest"]
    assert [one["name"] for one in manifest["sessions"]] == ["monday-run", "tuesday-run"]
    for name in SAME[:2]:
        assert (tmp_path / "more" / name).read_bytes() == (town / name).read_bytes()


def test_a_drive_is_located_in_the_merged_town(runs: Path, town: Path, tmp_path: Path) -> None:
    done = lslam("localize", runs / "tuesday", "--map", town, "--count", 25, "--out", tmp_path / "in", "-q")
    assert done.returncode == 0, done.stderr
    here = read_trajectory(tmp_path / "in" / "trajectory.tum", "tum").positions
    there = read_trajectory(town / "sessions" / "tuesday-run.tum", "tum").positions[:25]
    assert np.linalg.norm(here - there, axis=1).max() < 0.03


def test_an_interrupted_merge_goes_on_to_the_same_bytes_by_any_number_of_threads(
    runs: Path, town: Path, tmp_path: Path
) -> None:
    """By one, where the other had one per core."""
    folders = [runs / "monday-run", runs / "elsewhere", runs / "tuesday-run"]
    config = load_config(None, ["input.threads=1"])

    def look() -> bool:
        return sys._getframe(1).f_code.co_name == "scans_again"

    with pytest.raises(InterruptedRunError):
        merge_into(folders, tmp_path / "town", config, Watch(should_stop=look))
    assert json.loads((tmp_path / "town" / "manifest.json").read_text())["status"] == "interrupted"
    merge_into(folders, tmp_path / "town", config, Watch(), resume=True)
    for name in SAME:
        assert (tmp_path / "town" / name).read_bytes() == (town / name).read_bytes(), name


def test_refined_sessions_agree_better_and_resume_to_the_same_bytes_by_any_number_of_threads(
    runs: Path, tmp_path: Path
) -> None:
    folders = [runs / "monday-run", runs / "tuesday-run"]
    true = np.concatenate([town_poses(runs, name)[:, :3, 3] for name in ("monday", "tuesday")])

    def merged(name: str, *settings: str, watch: Watch | None = None) -> dict[str, Any]:
        config = load_config(None, ["map.write=false", *settings])
        return merge_into(folders, tmp_path / name, config, watch or Watch(), resume=(tmp_path / name).exists())

    def error(name: str) -> float:
        files = [tmp_path / name / "sessions" / f"{session}-run.tum" for session in ("monday", "tuesday")]
        est = np.concatenate([read_trajectory(file, "tum").positions for file in files])
        T, _, _ = umeyama(est, true)
        return float(np.sqrt(np.mean(np.sum((se3.apply(T, est) - true) ** 2, axis=1))))

    def is_refining() -> bool:
        return "refine" in {one.name for one in traceback.extract_stack()}

    merged("plain")
    facts = merged("refined", "graph.refine=true", "input.threads=1")["refinement"]
    assert facts["is_taken"]
    assert facts["thickness_mm"] <= facts["thickness_before_mm"]
    assert error("refined") < 0.9 * error("plain")
    with pytest.raises(InterruptedRunError, match="while the poses were refined"):
        merged("again", "graph.refine=true", watch=Watch(should_stop=is_refining))
    merged("again", "graph.refine=true", "input.threads=2")
    for name in SAME[:4]:
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "refined" / name).read_bytes(), name


def test_nothing_that_can_be_tied_is_a_failure(runs: Path, tmp_path: Path) -> None:
    done = lslam("merge", runs / "monday-run", runs / "elsewhere", "--out", tmp_path / "town")
    assert done.returncode == 1
    assert "elsewhere: not found among the others" in done.stderr


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("monday-run",), 2, "two runs"),
        (("monday-run", "monday-run"), 2, "named twice"),
        (("monday-run", "nowhere"), 3, "nowhere does not exist"),
        (("monday-run", "monday"), 3, "no folder of a run"),
        (("monday-run", "tuesday-run", "--resume"), 2, "--resume needs --out"),
        (("monday-run", "tuesday-run", "--out", "tuesday-run"), 2, "exists"),
    ],
)
def test_wrong_words_get_one_sentence(runs: Path, words: tuple[str, ...], code: int, said: str) -> None:
    done = lslam("merge", *words, cwd=runs)
    assert done.returncode == code, done.stderr
    assert said in done.stderr
    assert_one_sentence(done.stderr)


def test_scans_that_are_gone_are_missing_in_the_map_alone(runs: Path, tmp_path: Path) -> None:
    shutil.copytree(runs / "tuesday", tmp_path / "moving")
    run(tmp_path / "moving", tmp_path / "tuesday-run")
    shutil.rmtree(tmp_path / "moving")
    words = (runs / "monday-run", tmp_path / "tuesday-run", "--out", tmp_path / "town", "--refine", "--json")
    done = lslam("merge", *words)
    assert done.returncode == 0, done.stderr
    manifest = strict_json(done.stdout)["manifest"]
    assert [one["name"] for one in manifest["sessions"]] == ["monday-run", "tuesday-run"]
    assert any("tuesday-run cannot be read" in problem for problem in manifest["problems"])
    assert manifest["refinement"]["why"] == "the raw scans of a session are missing"
    assert "--sequence" not in done.stderr
    assert len(read_cloud(tmp_path / "town" / "map.ply").points) > 10_000
