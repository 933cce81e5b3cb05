"""`lslam map` as a user calls it."""

from __future__ import annotations

import itertools
import json
import os
import re
import shutil
from pathlib import Path

import laspy
import numpy as np
import pytest
from calling import SAMPLE, assert_one_sentence, lslam, sample_copy, strict_json

from lslam.cli.main import cli
from lslam.core.errors import InputError, LslamError, OutputError
from lslam.core.geometry.geodesy import from_local
from lslam.core.types.gnss import Georeference
from lslam.io.formats.point_files import read_cloud
from lslam.io.readers import open_sequence
from lslam.pipeline import rebuild
from lslam.pipeline.convert.bag_writer import BagWriter
from lslam.pipeline.map_files import georeference_note
from lslam.pipeline.run_folder import lock_folder

COUNT = 10


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose scans lie in a folder of their own; tests copy it before they change it."""
    root = tmp_path_factory.mktemp("map")
    done = lslam("run", sample_copy(root / "data", COUNT), "--out", root / "run", "-q")
    assert done.returncode == 0, done.stderr
    return root / "run"


@pytest.fixture
def run(ran: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(ran, tmp_path / "run"))


def test_the_same_settings_give_the_same_map(run: Path, tmp_path: Path) -> None:
    done = lslam("map", run, "--out", tmp_path / "again.ply", "--json")
    assert done.returncode == 0, done.stderr
    document = strict_json(done.stdout)
    before, after = read_cloud(run / "map.ply"), read_cloud(tmp_path / "again.ply")
    assert (document["points"], document["scans"]) == (len(before), COUNT)
    assert len(before) == len(after)
    # trajectory.tum rounds to nanometres.
    np.testing.assert_allclose(after.points, before.points, atol=1e-5)
    score = strict_json((run / "evaluation.json").read_text())["map"]
    assert document["crispness"]["entropy"] == pytest.approx(score["entropy"], abs=1e-3)
    assert {p.name for p in tmp_path.iterdir()} == {"run", "again.ply", "again.json"}


def test_other_settings(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "part.laz"
    done = lslam("map", run, "--voxel", 0.5, "--crop", "-8,8,-5,5,-3,1", "--out", out, "--set", "map.range_max=20")
    assert done.returncode == 0, done.stderr
    assert f"{out}: " in done.stdout
    part, whole = read_cloud(out).points, read_cloud(run / "map.ply").points
    assert ((part >= [-8, -5, -3]) & (part <= [8, 5, 1])).all()
    cells = np.unique(np.floor(part / 0.5), axis=0)
    assert 0.9 * len(part) < len(cells) <= len(part) < len(whole) / 4
    about = json.loads((tmp_path / "part.json").read_text())
    assert (about["voxel"], about["crs"], about["points"]) == (0.5, None, len(part))


def test_a_map_in_another_format_stands_beside_the_one_before(run: Path) -> None:
    (run / "map_mesh.ply").write_text("not a map")
    assert lslam("map", run, "--format", "pcd", "--voxel", 0.5, "-q").returncode == 0
    assert {p.name for p in run.glob("map*.*")} == {"map.ply", "map.pcd", "map.json", "map_mesh.ply"}
    assert strict_json(lslam("map", run, "--score", "--json").stdout)["file"] == str(run / "map.pcd")
    before = {name: (run / name).read_bytes() for name in ("map.ply", "map.pcd", "map_mesh.ply", "trajectory.tum")}
    assert lslam("map", run, "--format", "las", "--voxel", 1.0, "--overwrite", "-q").returncode == 0
    assert {p.name for p in run.glob("map*.*")} == {"map.ply", "map.pcd", "map.las", "map.json", "map_mesh.ply"}
    assert {name: (run / name).read_bytes() for name in before} == before
    note = strict_json((run / "map.json").read_text())
    told = {note["file"]: note, **note["others"]}
    assert list(told) == ["map.las", "map.pcd", "map.ply"]
    assert {name: about["voxel"] for name, about in told.items()} == {"map.las": 1.0, "map.pcd": 0.5, "map.ply": 0.2}
    for name, about in told.items():
        assert about["file"] == name
        assert about["points"] == len(read_cloud(run / name))
    assert not list(run.glob(".l*"))


def test_a_map_built_anew_renews_what_the_run_says_of_its_map(run: Path) -> None:
    """Of its map, and of nothing else."""
    page, facts = (run / "report.html").read_text(), json.loads((run / "manifest.json").read_text())
    score = strict_json((run / "evaluation.json").read_text())
    untouched = {p.name: p.read_bytes() for p in run.iterdir() if p.suffix in (".tum", ".csv", ".npz", ".toml", ".txt")}
    assert lslam("map", run, "--format", "laz", "-q").returncode == 0
    done = lslam("map", run, "--clean", "--voxel", 0.3, "--overwrite", "--json")
    assert done.returncode == 0, done.stderr
    built = strict_json(done.stdout)
    assert (run / "map.laz").is_file()

    new = strict_json((run / "evaluation.json").read_text())
    assert new["map"] == {"file": "map.ply", **built["crispness"]}
    assert new["map"]["entropy"] != score["map"]["entropy"]
    assert {k: v for k, v in new.items() if k != "map"} == {k: v for k, v in score.items() if k != "map"}

    told = json.loads((run / "manifest.json").read_text())
    assert (told["map_points"], told["map"]["file"], told["map"]["voxel"]) == (built["points"], "map.ply", 0.3)
    assert told["map"]["done"][0].startswith("cleaned: ")
    assert {k: v for k, v in told.items() if k not in ("map", "map_points")} == {
        k: v for k, v in facts.items() if k != "map_points"
    }

    after = (run / "report.html").read_text()
    assert f"Map entropy {score['map']['entropy']:.2f}:" in page
    assert f"Map entropy {new['map']['entropy']:.2f}:" in after
    assert f"Map entropy {score['map']['entropy']:.2f}:" not in after
    assert "map.ply, built anew after the run with voxels of 0.3 m; cleaned: " in after
    picture = re.compile(r"data:image/png;base64,[^\"]*")
    assert picture.findall(page) != picture.findall(after)
    assert len(picture.findall(page)) == len(picture.findall(after))
    part = re.compile(r"<!-- begin (\w+) -->.*?<!-- end \1 -->", re.DOTALL)
    assert part.sub("", page) == part.sub("", after)
    assert len(part.findall(page)) == 3
    assert {p.name: p.read_bytes() for p in run.iterdir() if p.name in untouched} == untouched


def test_a_map_elsewhere_or_of_another_name_is_not_the_map_of_the_run(run: Path, tmp_path: Path) -> None:
    kept = {name: (run / name).read_bytes() for name in ("evaluation.json", "report.html", "manifest.json", "map.json")}
    for out in (tmp_path / "map.ply", run / "square.ply"):
        assert lslam("map", run, "--crop", "-8,8,-5,5", "--out", out, "-q").returncode == 0
    assert {name: (run / name).read_bytes() for name in kept} == kept
    for name in ("manifest.ply", "evaluation.laz"):
        done = lslam("map", run, "--out", run / name, "--overwrite")
        assert done.returncode == 2
        assert_one_sentence(done.stderr)
        assert "is something else" in done.stderr
    assert {name: (run / name).read_bytes() for name in kept} == kept


def test_what_cannot_be_renewed_is_left_alone_and_said(run: Path) -> None:
    (run / "report.html").write_text("<html>of another time</html>")
    (run / "evaluation.json").write_text("{")
    (run / "map.json").write_text("null")
    done = lslam("map", run, "--voxel", 1.0, "--overwrite")
    assert done.returncode == 0, done.stderr
    assert "report.html keeps the figures of the map before" in done.stderr
    assert "evaluation.json keeps the figures of the map before" in done.stderr
    assert (run / "report.html").read_text() == "<html>of another time</html>"
    assert (run / "evaluation.json").read_text() == "{"
    (run / "report.html").unlink()
    (run / "evaluation.json").unlink()
    assert lslam("map", run, "--voxel", 1.0, "--overwrite", "-q").returncode == 0
    assert not (run / "report.html").exists()
    assert set(strict_json((run / "evaluation.json").read_text())) == {"schema", "version", "lslam", "estimate", "map"}


def test_ended_at_any_file_a_map_and_its_note_agree(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process ends at the first, second, ... file that gets its name: what is there is whole and belongs together."""

    class Killed(BaseException):
        """Nothing comes after it."""

    replace, voxels = os.replace, itertools.cycle([1.0, 0.5])
    for count in itertools.count():
        left = [count]

        def replaced(source: Path, target: Path, left: list[int] = left) -> None:
            if not left[0]:
                raise Killed
            left[0] -= 1
            replace(source, target)

        before = {p.name: p.read_bytes() for p in run.iterdir() if p.is_file()}
        monkeypatch.setattr(os, "replace", replaced)
        try:
            cli(["map", str(run), "--voxel", str(next(voxels)), "--overwrite", "-q"], standalone_mode=False)
            break
        except Killed:
            pass
        finally:
            monkeypatch.setattr(os, "replace", replace)
        after = {p.name: p.read_bytes() for p in run.iterdir() if p.is_file()}
        assert set(before) - set(after) <= {"map.json"}
        assert "map.ply.part" not in after
        cloud = read_cloud(run / "map.ply")
        note = json.loads(after.get("map.json", b"{}"))
        assert note.get("points", len(cloud)) == len(cloud)
        for name in ("evaluation.json", "manifest.json"):
            strict_json(after[name].decode())
        assert after["report.html"].rstrip().endswith(b"</html>")
    assert count > 5
    assert strict_json((run / "map.json").read_text())["points"] == len(read_cloud(run / "map.ply"))
    assert not list(run.glob(".l*"))


def test_a_disk_that_is_full_leaves_everything_as_it_was(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = {p.name: p.read_bytes() for p in run.iterdir() if p.is_file()}

    def full(path: Path, document: object) -> None:
        raise OutputError(f"{path} cannot be written: no space left on device")

    monkeypatch.setattr(rebuild, "write_json", full)
    with pytest.raises(OutputError):
        cli(["map", str(run), "--voxel", "1", "--overwrite", "-q"], standalone_mode=False)
    assert {p.name: p.read_bytes() for p in run.iterdir() if p.is_file()} == before


def test_a_run_at_work_keeps_its_folder(run: Path) -> None:
    with lock_folder(run):
        done = lslam("map", run, "--overwrite", "--voxel", 1.0)
    assert done.returncode == 2
    assert "in use by another run" in done.stderr
    assert_one_sentence(done.stderr)
    assert lslam("map", run, "--overwrite", "--voxel", 1.0, "-q").returncode == 0


def test_a_bridged_scan_stays_out(run: Path, tmp_path: Path) -> None:
    table = (run / "scans.csv").read_text().replace(",ok,", ",bridged,", COUNT - 1)
    (run / "scans.csv").write_text(table)
    done = lslam("map", run, "--out", tmp_path / "one.ply", "--json", "-q")
    assert strict_json(done.stdout)["scans"] == 1
    assert len(read_cloud(tmp_path / "one.ply")) < 0.7 * len(read_cloud(run / "map.ply"))


def test_the_scans_of_a_bag_are_found_by_the_topic_of_the_run(tmp_path: Path) -> None:
    sequence = open_sequence(SAMPLE)
    with BagWriter(tmp_path / "two.bag", "bag") as writer:
        for topic, scans in (("/front", (0, 1, 2, 3)), ("/rear", (40, 41))):
            for scan in map(sequence.scan, scans):
                writer.write(topic, scan.stamp_ns, writer.messages.cloud(scan, "lidar"))
    run, out = tmp_path / "run", tmp_path / "again.ply"
    done = lslam("run", tmp_path / "two.bag", "--lidar-topic", "/front", "--out", run, "-q")
    assert done.returncode == 0, done.stderr
    assert json.loads((run / "manifest.json").read_text())["sequence"]["reading"] == {"lidar_topic": "/front"}
    done = lslam("map", run, "--out", out, "--json")
    assert done.returncode == 0, done.stderr
    assert strict_json(done.stdout)["points"] == len(read_cloud(run / "map.ply"))
    other = lslam("map", run, "--out", out, "--overwrite", "--lidar-topic", "/rear")
    assert other.returncode == 3
    assert_one_sentence(other.stderr)
    assert "does not fit" in other.stderr


def test_a_georeferenced_run_lies_at_its_place(run: Path) -> None:
    manifest = json.loads((run / "manifest.json").read_text())
    origin = np.array([48.2, 16.4, 171.0])
    manifest["georeference"] = georeference_note(Georeference(origin, np.eye(4)))
    (run / "manifest.json").write_text(json.dumps(manifest))
    assert lslam("map", run, "--format", "laz", "-q").returncode == 0
    assert lslam("map", run, "--out", run / "austria.las", "--crs", "EPSG:31256", "-q").returncode == 0
    from pyproj import Transformer

    world = read_cloud(run / "map.ply").points
    lat_lon = from_local(world, origin)
    for name, epsg in (("map.laz", 32633), ("austria.las", 31256)):
        x, y = Transformer.from_crs(4326, epsg, always_xy=True).transform(lat_lon[:, 1], lat_lon[:, 0])
        np.testing.assert_allclose(laspy.read(run / name).xyz, np.column_stack([x, y, lat_lon[:, 2]]), atol=0.01)
    line = json.loads((run / "trajectory.geojson").read_text())["features"][0]["geometry"]["coordinates"]
    assert len(line) == COUNT
    np.testing.assert_allclose(line[0], [16.4, 48.2, 171.0], atol=1e-6)


def test_scores_and_comparisons(run: Path, tmp_path: Path) -> None:
    done = lslam("map", run, "--score", "--against", run / "map.ply", "--json")
    assert done.returncode == 0, done.stderr
    document = strict_json(done.stdout)
    # The file holds float32, the run scored float64.
    score = strict_json((run / "evaluation.json").read_text())["map"]
    assert document["crispness"]["entropy"] == pytest.approx(score["entropy"], abs=1e-4)
    assert (document["against"]["f1"], document["against"]["chamfer"]) == (1.0, 0.0)
    text = lslam("map", run / "map.ply", "--score", "--radius", 1.0, "--against", run / "map.ply").stdout
    assert "neighbourhoods of 1 m" in text
    assert "precision 1.0000" in text
    assert lslam("map", "--help").stdout.count("lslam map runs/first") >= 2


@pytest.mark.parametrize(
    ("words", "code", "part"),
    [
        ([], 2, "map.ply exists; name another file with --out or replace it with --overwrite"),
        (["--out", "no/where.ply"], 3, "the folder no does not exist"),
        (["--out", "map.xyz"], 2, "known suffixes: .ply"),
        (["--out", "a.ply", "--format", "laz"], 2, "contradicts"),
        (["--out", "a.ply", "--voxel", "-1"], 2, "map.voxel"),
        (["--out", "a.ply", "--crop", "5,-5,0,1"], 2, "pairs of a smaller and a larger"),
        (["--out", "a.ply", "--crop", "1,2,3"], 2, "x_min, x_max, y_min, y_max"),
        (["--out", "a.ply", "--format", "obj"], 2, "contradicts"),
        (["--out", "a.laz", "--crs", "EPSG:25832"], 2, "is not georeferenced"),
        (["--out", "a.laz", "--crs", "25832"], 2, "expected EPSG and a number"),
        (["--out", "a.ply", "--set", "odometry.method=icp"], 2, "only keys of the map"),
        (["--out", "a.ply", "--threshold", "1"], 2, "belongs to --against"),
        (["--against", "none.ply"], 3, "none.ply does not exist"),
    ],
)  # fmt: skip
def test_usage_errors_are_one_sentence(
    ran: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], code: int, part: str
) -> None:
    """In this process: `main` makes an error line and an exit code of every LslamError."""
    before = sorted(ran.iterdir())
    monkeypatch.chdir(ran)
    with pytest.raises(LslamError) as caught:
        cli(["map", str(ran), "-q", *words], standalone_mode=False)
    assert part in str(caught.value)
    assert caught.value.exit_code == code
    assert sorted(ran.iterdir()) == before


def test_missing_files_are_named(run: Path, ran: Path, tmp_path: Path) -> None:
    scans = ran.parent / "data"
    scans.rename(tmp_path / "moved")
    try:
        done = lslam("map", run, "--out", run / "a.ply")
        assert done.returncode == 3
        assert str(scans / "sequences" / "00") in done.stderr
        assert "--sequence" in done.stderr
        assert_one_sentence(done.stderr)
        there = tmp_path / "moved" / "sequences" / "00"
        assert lslam("map", run, "--out", run / "a.ply", "--sequence", there, "-q").returncode == 0
        other = sample_copy(tmp_path / "other", COUNT - 3)
        with pytest.raises(InputError, match="does not fit"):
            cli(["map", str(run), "--out", str(run / "b.ply"), "--sequence", str(other), "-q"], standalone_mode=False)
    finally:
        (tmp_path / "moved").rename(scans)
    (run / "trajectory.tum").unlink()
    nothing = tmp_path / "none"
    for target, part in ((run, "no trajectory.tum"), (nothing, "no folder of a run"), (tmp_path, "manifest.json")):
        with pytest.raises(InputError, match=part):
            cli(["map", str(target), "-q"], standalone_mode=False)
    for path in run.glob("map.*"):
        path.unlink()
    with pytest.raises(InputError, match="has no map file"):
        cli(["map", str(run), "--score"], standalone_mode=False)


def test_a_part_of_a_recording_gives_the_same_map_again(tmp_path: Path) -> None:
    done = lslam("run", SAMPLE, "--start", 12, "--count", 8, "--skip-frames", 2, "--out", tmp_path / "run", "-q")
    assert done.returncode == 0, done.stderr
    assert lslam("map", tmp_path / "run", "--out", tmp_path / "again.ply", "-q").returncode == 0
    before, after = read_cloud(tmp_path / "run" / "map.ply"), read_cloud(tmp_path / "again.ply")
    assert len(before.points) > 10_000
    # Poses of trajectory.tum are rounded.
    assert np.abs(np.subtract(before.points, after.points)).max() < 1e-3
