"""`lslam view --rerun`: what is shown of a run, and what is said where rerun is missing. rerun itself is too large for tests."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from calling import lslam
from scipy.spatial import cKDTree

from lslam.cli.main import cli
from lslam.core.errors import InputError, OutputError, OutputExistsError
from lslam.core.geometry import se3, so3
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.gnss import Georeference
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.point_files import read_cloud
from lslam.io.formats.trajectory_lines import write_tum
from lslam.maps.octree import points_of
from lslam.pipeline.map_files import MapNote, georeference_note, write_map
from lslam.pipeline.map_tiles import write_tiles
from lslam.pipeline.plot_run import view_run
from lslam.pipeline.rebuild import read_run
from lslam.pipeline.view.server import RunServer
from lslam.pipeline.view.sites import MapTiles, ViewedSites
from lslam.reports.figures import MOST_POINTS, by_height

POINTS = np.random.default_rng(0).uniform(-50, 50, (400, 3))


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run folder of five scans, georeferenced, its map in UTM."""
    poses = se3.make(so3.exp(np.outer(np.arange(5), [0, 0, 0.1])), np.outer(np.arange(5), [1.0, 0, 0]))
    for name in ("trajectory.tum", "trajectory_odometry.tum"):
        write_tum(tmp_path / name, Trajectory(np.arange(5) * 10**8, poses))
    (tmp_path / "config.toml").write_text("")
    (tmp_path / "scans.csv").write_text("index,status\n" + "".join(f"{k},ok\n" for k in range(5)))
    place = Georeference(np.array([48.2, 16.4, 171.0]), se3.make(so3.exp(np.array([0, 0, 2.0])), np.zeros(3)))
    document = {"sequence": {"name": "drive"}, "georeference": georeference_note(place)}
    (tmp_path / "manifest.json").write_text(json.dumps(document))
    write_map(tmp_path / "map.laz", ArrayCloud.of(POINTS), MapNote("drive", 0.2), place)
    return tmp_path


def test_a_word_for_a_port_is_told_what_a_port_is() -> None:
    for word in ("abc", "70000"):
        done = lslam("view", "nowhere", "--port", word)
        assert done.returncode == 2
        assert f"'{word}' is no port: a whole number up to 65535" in done.stderr


def test_all_is_shown_in_the_world_of_the_run(run: Path) -> None:
    assert np.abs(read_cloud(run / "map.laz").points).max() > 1e6
    viewed = view_run(run)
    assert viewed.cloud is not None
    np.testing.assert_allclose(viewed.cloud.points, POINTS, atol=0.001)
    assert viewed.odometry is not None
    assert (len(viewed.trajectory), len(viewed.odometry)) == (5, 5)
    assert viewed.name == f"drive ({run.name})"
    for path in (run / "map.laz", run / "trajectory_odometry.tum"):
        path.unlink()
    bare = view_run(run)
    assert (bare.cloud, bare.odometry) == (None, None)


@pytest.mark.parametrize("is_tiled", [False, True])
def test_tiles_of_a_map_in_utm_lie_in_the_world_of_the_run(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_tiled: bool
) -> None:
    if is_tiled:
        (run / "tiles").mkdir()
        write_tiles(
            run / "tiles", ArrayCloud.of(POINTS), MapNote("drive", 0.2), 100.0, "laz", read_run(run).georeference
        )
        for name in ("map.laz", "map.json"):
            (run / name).unlink()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    for _ in ("built", "from the cache"):
        tiles = MapTiles(run, [np.zeros((1, 3))])
        tiles.start()
        for _ in range(200):
            if "nodes" in tiles.tree():
                break
            time.sleep(0.02)
        tree, data = tiles.tree(), tiles.node("r")
        assert (tree["points"], tree["nodes"]) == (400, {"r": 400})
        assert data is not None
        away, _ = cKDTree(points_of("r", data[:2400], tree)).query(POINTS)
        assert away.max() < 0.003
    assert tiles.node("r0") is None
    if is_tiled:
        (run / "tiles/map.json").unlink()
    else:
        (run / "map.laz").unlink()
    bare = MapTiles(run, [np.zeros((1, 3))])
    bare.start()
    bare.stop()
    assert "no map file" in bare.tree()["error"]


def test_the_page_of_a_drive_in_an_old_map_gets_no_points_of_the_map_of_the_drive(run: Path) -> None:
    (run / "config.toml").write_text('[localize]\nmap = "/maps/old.laz"\n')
    with RunServer() as server:
        sites = ViewedSites(server)
        sites.add(run)
        said = server.sites[0].gets["tiles/tree.json"]({})
        sites.stop()
    assert said == {"error": "the page shows the old map, /maps/old.laz, where it differs from the drive"}


class Stream:
    """Stands for rerun's stream: notes what is logged and writes a file."""

    def __init__(self, *_: object, **__: object) -> None:
        self.logged: list[str] = []
        self.times: list[Any] = []
        Stream.last = self

    last: Stream

    def save(self, path: Path) -> None:
        path.write_bytes(b"RRF2")

    def log(self, name: str, *_: object, **__: object) -> None:
        self.logged.append(name)

    def set_time(self, _: str, timestamp: Any) -> None:
        self.times.append(timestamp)

    def flush(self) -> None:
        pass

    disconnect = flush


@pytest.fixture
def rerun(monkeypatch: pytest.MonkeyPatch) -> type[Stream]:
    module = ModuleType("rerun")
    made = lambda *_, **__: object()  # noqa: E731
    for name in ("LineStrips3D", "Points3D", "Transform3D", "TransformAxes3D"):
        setattr(module, name, made)
    module.ViewCoordinates = type("V", (), {"RIGHT_HAND_Z_UP": 0})  # type: ignore[attr-defined]
    module.RecordingStream = Stream  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "rerun", module)
    return Stream


def test_a_recording_holds_ways_map_and_every_pose(
    run: Path, rerun: type[Stream], capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["view", str(run), "--rerun", str(run / "run.rrd")]
    cli([*words, "-q"], standalone_mode=False)
    assert capsys.readouterr().out == f"{run / 'run.rrd'}\n"
    assert {"world/trajectory", "world/odometry", "world/map"} <= set(rerun.last.logged)
    assert rerun.last.times == [np.datetime64(k * 10**8, "ns") for k in range(5)]
    assert not list(run.glob("*.part"))
    with pytest.raises(OutputExistsError, match="--overwrite"):
        cli(words, standalone_mode=False)
    with pytest.raises(OutputError, match="does not exist"):
        cli(["view", str(run), "--rerun", str(run / "none" / "a.rrd")], standalone_mode=False)
    with pytest.raises(InputError, match="no folder of a run"):
        cli(["view", str(run / "none"), "--rerun", str(run / "b.rrd")], standalone_mode=False)


def test_without_rerun_the_way_out_is_said(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(InputError, match=r"rerun cannot be imported: .*pip install .*\[view\]") as caught:
        cli(["view", str(run), "--rerun", str(run / "run.rrd")], standalone_mode=False)
    assert caught.value.exit_code == 3
    assert not (run / "run.rrd").exists()


def test_heights_are_colours() -> None:
    colours = by_height(np.linspace(0, 10, 101))
    assert colours[0].tolist() == [40, 60, 160]
    assert colours[-1].tolist() == [250, 220, 60]
    assert (np.diff(colours[:, 0].astype(int)) >= 0).all()
    assert by_height(np.zeros(3)).shape == (3, 3)
    assert MOST_POINTS > 10**6
