"""`lslam run --again`: the folder of a run is enough to make it again, and what is other is said."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from calling import SAMPLE, Done, lslam

from lslam.core.errors import InputError
from lslam.io.formats.osm_files import read_osm
from lslam.osm import source
from lslam.pipeline.again import other_inputs, other_programs, read_recipe

SAME_BYTES = re.compile(r"^  again +same bytes: (\d+) files$", re.MULTILINE)


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded") / "sample"
    shutil.copytree(SAMPLE, folder)
    return folder


@pytest.fixture(scope="module")
def run(recording: Path) -> Path:
    """With all that comes from beside the recording, told by paths as they are seen from its folder."""
    shutil.copy(recording / "poses/00.txt", recording / "truth.txt")
    done = lslam(
        "run", "../sample", "--gt", "truth.txt", "--start", "2", "--count", "24", "--imu", "--gnss",
        "--osm", "sequences/00/map.osm", "--set", "map.voxel=0.4", "--out", "../first", cwd=recording,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return recording.parent / "first"


def again(run: Path, *words: object, cwd: Path | None = None) -> Done:
    return lslam("run", "--again", run, *words, cwd=cwd)


def edited(run: Path, to: Path, **changes: Any) -> Path:
    """The run in another folder, with other facts in its manifest."""
    shutil.copytree(run, to)
    manifest = json.loads((to / "manifest.json").read_text()) | changes
    (to / "manifest.json").write_text(json.dumps(manifest))
    return to


@pytest.mark.quick
def test_a_run_is_made_again_from_anywhere_with_the_same_bytes(run: Path, tmp_path: Path) -> None:
    done = again(run, "--out", "again", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = SAME_BYTES.search(done.stdout)
    assert found
    assert int(found.group(1)) >= 10
    for name in ("trajectory.tum", "map.ply", "covariances.npz", "evaluation.json"):
        assert (tmp_path / "again" / name).read_bytes() == (run / name).read_bytes()
    assert (tmp_path / "again/config.toml").read_bytes() == (run / "config.toml").read_bytes()
    assert "was changed" not in done.stderr
    assert "are others" not in done.stderr
    first, second = (json.loads((folder / "manifest.json").read_text()) for folder in (run, tmp_path / "again"))
    assert first["identity"] == second["identity"]
    assert first["ground_truth"] == second["ground_truth"]


def test_beside_the_run_by_default_and_by_one_thread(run: Path) -> None:
    done = again(run, "--threads", "1", "--json", "--set", "map.voxel=0.4")
    assert done.returncode == 2
    assert "--set is not for --again, which takes all of that from the run" in done.stderr
    done = again(run, "--threads", "1", "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["folder"] == str(run.with_name("first-again"))
    assert facts["again"]["is_same"]
    assert not facts["again"]["warnings"]
    assert again(run).returncode == 2, "it exists"
    assert again(run, "--out", run).returncode == 2


def test_a_scan_that_was_edited_is_said_before_and_after(recording: Path, run: Path, tmp_path: Path) -> None:
    scan = sorted((recording / "sequences/00/velodyne").iterdir())[10]
    before = scan.read_bytes()
    points = np.frombuffer(before, np.float32).reshape(-1, 4).copy()
    points[:, :2] *= 1.01
    scan.write_bytes(points.tobytes())
    try:
        done = again(run, "--out", tmp_path / "again", "--json", "--strict")
    finally:
        scan.write_bytes(before)
    assert done.returncode == 4
    warning = f"the recording or its ground truth is another or was changed, since the run in {run}"
    assert warning in done.stderr
    assert done.stderr.index(warning) < done.stderr.index("odometry 24/24")
    facts = json.loads(done.stdout)["again"]
    assert warning in facts["warnings"]
    assert {"trajectory.tum", "map.ply"} <= set(facts["differing"])
    assert "--strict" in done.stderr


def test_another_version_or_library_is_said_in_a_sentence_each(run: Path, tmp_path: Path) -> None:
    machine = json.loads((run / "manifest.json").read_text())["machine"]
    old = edited(run, tmp_path / "old", lslam="0.0.9", machine=machine | {"numpy": "2.0.0", "gtsam": None, "code": "x"})
    done = again(old, "--out", tmp_path / "again")
    assert done.returncode == 0, done.stderr
    assert "WARNING: lslam was 0.0.9 at the run and is" in done.stderr
    assert "WARNING: numpy was 2.0.0 at the run and is" in done.stderr
    assert "WARNING: gtsam was not installed at the run and is" in done.stderr
    assert "lslam's code" not in done.stderr, "another version has other code"
    assert SAME_BYTES.search(done.stdout)
    old = edited(run, tmp_path / "code", machine=machine | {"code": "x"}, status="interrupted")
    (old / "map.ply").unlink()
    done = again(old, "--out", tmp_path / "code-again")
    assert "WARNING: lslam's code is another than at the run, with the same version" in done.stderr
    assert f"the run in {old} did not come to its end (interrupted)" in done.stderr
    assert "only in one of them: map.ply; same bytes:" in done.stdout


def test_a_recording_that_is_gone_is_found_at_its_new_place(recording: Path, run: Path, tmp_path: Path) -> None:
    moved = tmp_path / "moved"
    recording.rename(moved)
    try:
        gone = again(run, "--out", tmp_path / "again")
        lslam_config = (run / "config.toml").read_text()
        there = edited(run, tmp_path / "there", ground_truth=str(moved / "truth.txt"))
        (there / "config.toml").write_text(lslam_config.replace(str(recording), str(moved)))
        done = lslam("run", moved / "sequences/00", "--again", there, "--out", tmp_path / "again")
    finally:
        moved.rename(recording)
    assert gone.returncode == 3
    assert gone.stderr.splitlines()[-1].startswith(f"error: the recording of {run} is gone: {recording}")
    assert not (tmp_path / "first").exists()
    assert done.returncode == 0, done.stderr
    assert f"the recording is read from {moved / 'sequences/00'}, not from {recording}" in done.stderr
    assert SAME_BYTES.search(done.stdout)


def test_a_folder_that_does_not_say_what_was_run(run: Path, tmp_path: Path) -> None:
    cases = {
        "empty": None,
        "cut": (run / "manifest.json").read_text()[:300],
        "list": "[]",
        "nothing": "{}",
        "merge": json.dumps({"kind": "merge", "command": "lslam merge a b"}),
    }
    for name, text in cases.items():
        folder = tmp_path / name
        folder.mkdir()
        if text is not None:
            (folder / "manifest.json").write_text(text)
        done = again(folder, "--out", tmp_path / "again")
        assert done.returncode == 3, name
        (line,) = done.stderr.splitlines()
        assert str(folder) in line
        assert ("lslam merge a b" in line) == (name == "merge")
        assert not (tmp_path / "again").exists()
    folder = edited(run, tmp_path / "without")
    (folder / "config.toml").unlink()
    done = again(folder, "--out", tmp_path / "again")
    assert done.returncode in (2, 3)
    assert "config.toml" in done.stderr.splitlines()[-1]


def test_a_manifest_of_nonsense_is_no_crash(tmp_path: Path) -> None:
    """Every part replaced by each of some things that are none: what comes is the sentence, or the run as far as it is told."""
    good: dict[str, Any] = {
        "sequence": {"path": str(SAMPLE), "reading": {"lidar_topic": "/a", "what": "is this"}, "decisions": []},
        "identity": {"input": "1"}, "machine": {"numpy": "1"}, "ground_truth": "a.txt", "lslam": "0", "status": "done",
    }  # fmt: skip
    (tmp_path / "config.toml").touch()
    said: list[str] = []
    for part in ("sequence", "sequence.path", "sequence.reading", *good):
        for junk in (None, 3, "x", [], {}, [1], {"a": [2]}, True):
            tree = json.loads(json.dumps(good))
            place, _, key = part.partition(".")
            if key:
                tree[place][key] = junk
            else:
                tree[place] = junk
            (tmp_path / "manifest.json").write_text(json.dumps(tree))
            try:
                recipe = read_recipe(tmp_path)
            except InputError as error:
                said.append(str(error))
                continue
            other_programs(recipe)
            other_inputs(recipe, {})
            assert set(recipe.reading) <= {"lidar_topic"}
    assert said
    assert all(str(tmp_path) in text for text in said)


def test_poses_of_another_program(run: Path, recording: Path, tmp_path: Path) -> None:
    poses = tmp_path / "theirs.tum"
    shutil.copy(run / "trajectory.tum", poses)
    first = tmp_path / "given"
    words = ("run", recording / "sequences/00", "--poses", "theirs.tum", "--start", "2", "--count", "24")
    done = lslam(*words, "--out", first, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    done = again(first, "--out", tmp_path / "again")
    assert SAME_BYTES.search(done.stdout), done.stderr
    lines = poses.read_text().splitlines()
    poses.write_text("\n".join(lines[:-4]))
    done = again(first, "--out", tmp_path / "changed")
    assert "the poses of --poses are others" in done.stderr
    assert "other bytes: " in done.stdout
    poses.unlink()
    done = again(first, "--out", tmp_path / "gone")
    assert done.returncode == 3
    assert str(poses) in done.stderr.splitlines()[-1]


@pytest.mark.parametrize("is_answered", [True, False])
def test_buildings_of_a_server_are_those_of_then(
    is_answered: bool, recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = read_osm(recording / "sequences/00/map.osm")
    elements: list[dict[str, Any]] = [
        {"type": "node", "id": n, "lat": lat, "lon": lon} for n, (lat, lon) in data.nodes.items()
    ]
    elements += [{"type": "way", "id": w.id, "nodes": list(w.nodes), "tags": dict(w.tags)} for w in data.ways.values()]

    def answer(*_: object, **__: object) -> dict[str, Any]:
        if not is_answered:
            raise InputError("the line is dead")
        return {"elements": elements}

    monkeypatch.setattr(source, "fetch_buildings", answer)
    words = ("run", recording / "sequences/00", "--count", "24", "--osm", "auto", "--origin", "49.0,8.3999,115")
    done = lslam(*words, "--set", "osm.start_radius=20", "--out", tmp_path / "first")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "first/buildings.geojson").exists() is is_answered
    monkeypatch.setattr(source, "fetch_buildings", lambda *_, **__: pytest.fail("the server is asked again"))
    done = again(tmp_path / "first", "--out", tmp_path / "again")
    assert SAME_BYTES.search(done.stdout), done.stdout + done.stderr
    assert ("had no reply of the server" in done.stderr) is not is_answered
    assert "OpenStreetMap is another" not in done.stderr


def test_other_commands_that_make_runs_are_made_again(recording: Path, tmp_path: Path) -> None:
    """A drive located in a map, and a graph that was optimised once more: all of it, odometry too."""
    where = recording / "sequences/00"
    first, graph, located = (tmp_path / name for name in ("first", "graph", "located"))
    loops = tmp_path / "pairs.csv"
    loops.write_text("scan_a,scan_b,verdict\n0,20,forbidden\n")
    for words in (
        ("run", where, "--count", "24", "--out", first),
        ("graph", first, "--loops", "pairs.csv", "--out", graph),
        ("localize", where, "--map", "first", "--count", "12", "--start", "0,0,0", "--out", located),
    ):
        done = lslam(*words, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
    for folder in (graph, located):
        done = again(folder, cwd=recording)
        assert SAME_BYTES.search(done.stdout), done.stdout + done.stderr
        assert "are others" not in done.stderr
