"""A whole run on a map, fetched or read, interrupted, by other methods and along given poses: the same result."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lslam
from lslam.core.config import Config, load_config
from lslam.core.errors import InputError, InterruptedRunError, OutputExistsError
from lslam.core.geometry import geodesy
from lslam.io.formats.osm_files import read_osm
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.odometry.frontend.checkpoints import CheckpointSchedule
from lslam.osm import source
from lslam.osm.bounds import Bounds
from lslam.pipeline.watch import Watch

SAMPLE = Path(__file__).resolve().parents[2] / "sample_data"
MAP = SAMPLE / "sequences" / "00" / "map.osm"
COUNT = 24


def config(extract: str | Path = MAP, *more: str) -> Config:
    return load_config(
        None,
        [
            f"osm.extract={json.dumps(str(extract))}", "osm.origin=[49.0, 8.3999, 115.0]", "report.html=false",
            "map.write=false", f"input.count={COUNT}", "osm.start_radius=20", *more,
        ],
        {},
    )  # fmt: skip


def bytes_of(folder: Path) -> dict[str, bytes]:
    """All that a run promises to repeat, its replies aside."""
    changing = ("manifest.json", "log.txt", "timing.csv", "config.toml", "odometry.npz")
    files = [f for f in folder.rglob("*") if f.is_file() and f.name not in changing and f.parent.name != "osm_replies"]
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def serve(monkeypatch: pytest.MonkeyPatch, answer: Callable[[], None] = lambda: None) -> list[Bounds]:
    """Answer every request with the whole extract of the sample; the boxes that were asked for."""
    data = read_osm(MAP)
    elements: list[dict[str, Any]] = [
        {"type": "node", "id": n, "lat": lat, "lon": lon} for n, (lat, lon) in data.nodes.items()
    ]
    elements += [{"type": "way", "id": w.id, "nodes": list(w.nodes), "tags": dict(w.tags)} for w in data.ways.values()]
    asked: list[Bounds] = []

    def fetch(bounds: Bounds, **_: object) -> dict[str, Any]:
        asked.append(bounds)
        answer()
        return {"elements": elements}

    monkeypatch.setattr(source, "fetch_buildings", fetch)
    return asked


@pytest.fixture(scope="module")
def by_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("osm") / "file"
    outcome = lslam.run(SAMPLE, config(), out=out)
    assert outcome.record.osm is not None
    assert len(outcome.record.osm.accepted_matches) >= 10
    return out


def test_buildings_fetched_during_a_run_give_the_same_result_and_are_kept(
    by_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = serve(monkeypatch)
    (tmp_path / "auto").mkdir()
    with monkeypatch.context() as inside:
        inside.chdir(tmp_path / "auto")
        lslam.run(SAMPLE, config("auto"), out=".")
    assert len(asked) == len(list((tmp_path / "auto" / "osm_replies").iterdir())) >= 1
    known = bytes_of(by_file)
    assert (tmp_path / "auto" / "trajectory.tum").read_bytes() == known["trajectory.tum"]
    assert (tmp_path / "auto" / "osm_matches.csv").read_bytes() == known["osm_matches.csv"]
    asked.clear()
    lslam.run(SAMPLE, config(tmp_path / "auto" / "osm_replies"), out=tmp_path / "again")
    assert asked == []
    assert bytes_of(tmp_path / "again") == bytes_of(tmp_path / "auto")


def test_a_dead_server_leaves_odometry_as_it_is(by_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def die() -> None:
        raise InputError("the line is dead")

    serve(monkeypatch, die)
    outcome = lslam.run(SAMPLE, config("auto"), out=tmp_path / "out")
    assert outcome.record.osm is None
    assert "the line is dead; the run goes on without the buildings" in outcome.record.manifest["problems"][0]
    assert (tmp_path / "out" / "trajectory_odometry.tum").read_bytes() == bytes_of(by_file)["trajectory_odometry.tum"]


@pytest.mark.parametrize("extract", [str(MAP), "auto"])
def test_an_interrupted_run_resumes_to_the_same_bytes(
    extract: str, by_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(CheckpointSchedule, "is_due", True)
    serve(monkeypatch)
    left = [9]

    def step() -> None:
        left[0] -= 1

    out = tmp_path / "out"
    with pytest.raises(InterruptedRunError):
        lslam.run(SAMPLE, config(extract), out=out, watch=Watch(on_step=step, should_stop=lambda: left[0] <= 0))
    lslam.run(SAMPLE, config(extract), out=out, resume=True)
    for name in ("trajectory.tum", "osm_matches.csv", "covariances.npz", "graph.g2o"):
        assert (out / name).read_bytes() == bytes_of(by_file)[name], name


def test_another_extract_is_another_run(tmp_path: Path) -> None:
    own = tmp_path / "map.osm"
    own.write_bytes(MAP.read_bytes())
    out = tmp_path / "out"
    with pytest.raises(InterruptedRunError):
        lslam.run(SAMPLE, config(own), out=out, watch=Watch(should_stop=lambda: True))
    own.write_bytes(MAP.read_bytes() + b"\n")
    with pytest.raises(OutputExistsError, match="the extract of OpenStreetMap is another"):
        lslam.run(SAMPLE, config(own), out=out, resume=True)


@pytest.mark.parametrize(
    "words",
    [
        ("odometry.method=loam",), ("odometry.method=ndt", "loops.use=false"), ("imu.use=true",), ("graph.robust=cauchy",),
        ("graph.optimizer=isam2",), ("gnss.mode=graph",),
    ],
)  # fmt: skip
def test_every_kind_of_run_ends_in_the_same_place_of_the_map(words: tuple[str, ...], by_file: Path) -> None:
    record = lslam.run(SAMPLE, config(MAP, *words)).record
    assert record.osm is not None, record.problems
    assert record.georeference is not None
    on_earth = geodesy.from_local(record.trajectory.positions, record.georeference.origin)
    found = geodesy.to_local(on_earth, np.array([49.0, 8.3999, 115.0]))
    away = np.abs(found - read_trajectory(by_file / "trajectory.tum").positions)[:, :2].max()
    # Satellites say where it is on the Earth to a metre or so, whatever the map says.
    assert away < (2.0 if "gnss.mode=graph" in words else 0.4)


@pytest.mark.usefixtures("starts_sought_anew")
def test_the_number_of_threads_changes_nothing(by_file: Path, tmp_path: Path) -> None:
    lslam.run(SAMPLE, config(MAP, "input.threads=1"), out=tmp_path / "out")
    assert bytes_of(tmp_path / "out") == bytes_of(by_file)


@pytest.mark.quick
def test_external_poses_are_matched_with_the_map(by_file: Path, tmp_path: Path) -> None:
    outcome = lslam.run(
        SAMPLE, config(MAP, "odometry.method=poses", f'odometry.poses="{by_file / "trajectory_odometry.tum"}"')
    )
    assert outcome.record.osm is not None
    known = read_trajectory(by_file / "trajectory.tum")
    assert np.abs(outcome.trajectory.positions - known.positions)[:, :2].max() < 0.3
