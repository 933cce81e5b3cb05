"""`--out s3://...`: a manifest stands in storage only where the whole run does, whatever breaks off."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from storages import Counted, counted
from stub_sequences import sample

from lslam.core.config import Config
from lslam.core.errors import InterruptedRunError, OutputExistsError, RunFinishedError, StorageError
from lslam.io.remote import RemotePath
from lslam.pipeline.run import run
from lslam.pipeline.run_folder import spool_of
from lslam.pipeline.watch import Watch

CONFIG = Config.model_validate({"report": {"html": False}, "map": {"voxel": 1.0}})
TIMED = {
    "manifest.json", "log.txt", "timing.csv", "scans.csv", "evaluation.json", "config.toml", "keyframes/odometry.npz",
}  # fmt: skip


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RemotePath]:
    """A run folder to be, and a cache of the test's own beside the kernels'."""
    monkeypatch.setattr("lslam.pipeline.run_folder.cache_folder", lambda name: tmp_path / name)
    with counted() as root:
        yield root / "results" / "drive7"


def names(place: RemotePath) -> set[str]:
    return {name for name, _ in place.files()}


def test_it_holds_what_a_folder_of_a_disk_holds_and_the_manifest_comes_last(place: RemotePath, tmp_path: Path) -> None:
    run(sample(4), CONFIG, out=str(place))
    run(sample(4), CONFIG, out=tmp_path / "here")
    here = {p.relative_to(tmp_path / "here").as_posix(): p for p in (tmp_path / "here").rglob("*") if p.is_file()}
    assert names(place) == set(here)
    assert all((place / name).read_bytes() == here[name].read_bytes() for name in set(here) - TIMED)
    assert Counted.put[-1].endswith("drive7/manifest.json")
    assert json.loads((place / "manifest.json").read_text())["status"] == "done"
    assert not spool_of(place).exists()


def test_a_run_that_is_there_is_kept_replaced_or_refused(place: RemotePath) -> None:
    run(sample(4), CONFIG, out=place)
    with pytest.raises(OutputExistsError, match="counted://bucket/results/drive7 exists; --resume keeps"):
        run(sample(4), CONFIG, out=place)
    with pytest.raises(RunFinishedError, match="drive7 is finished"):
        run(sample(4), CONFIG, out=place, resume=True)
    assert (place / "map.ply").exists()
    run(
        sample(3),
        CONFIG.model_copy(update={"map": CONFIG.map.model_copy(update={"write": False})}),
        out=place,
        overwrite=True,
    )
    assert not (place / "map.ply").exists(), "of the run before"
    assert json.loads((place / "manifest.json").read_text())["counts"]["scans"] == 3


def test_what_others_put_there_is_not_touched(place: RemotePath) -> None:
    (place / "thesis.tex").write_bytes(b"years")
    with pytest.raises(OutputExistsError, match="is not a run of lslam"):
        run(sample(3), CONFIG, out=place, overwrite=True)
    assert names(place) == {"thesis.tex"}


@pytest.mark.parametrize("at", [0, 3, "manifest.json"])
@pytest.mark.parametrize("is_replaced", [False, True])
def test_an_upload_that_breaks_off_leaves_no_manifest_and_is_gone_on_with(
    at: int | str, is_replaced: bool, place: RemotePath
) -> None:
    if is_replaced:
        run(sample(3), CONFIG, out=place)
    Counted.put.clear()

    def refuse(verb: str, name: str) -> None:
        if verb == "put" and (name.endswith(at) if isinstance(at, str) else len(Counted.put) == at):
            raise ConnectionResetError("reset by peer")

    Counted.refuse = staticmethod(refuse)
    with pytest.raises(StorageError, match=r"does not answer .*; the results are in .*, and --resume uploads them"):
        run(sample(4), CONFIG, out=place, overwrite=True)
    assert not (place / "manifest.json").exists()
    Counted.refuse = staticmethod(lambda verb, name: None)
    again = sample(4)
    with pytest.raises(RunFinishedError):
        run(again, CONFIG, out=place, resume=True)
    assert len(again.reads) < 4, "nothing is registered anew"
    assert json.loads((place / "manifest.json").read_text())["counts"]["scans"] == 4
    assert not spool_of(place).exists()


def test_an_interrupted_run_stays_here_and_goes_on(place: RemotePath) -> None:
    steps: list[int] = []
    watch = Watch(on_step=lambda: steps.append(1), should_stop=lambda: len(steps) >= 2)
    with pytest.raises(InterruptedRunError):
        run(sample(4), CONFIG, out=place, watch=watch)
    assert names(place) == set()
    assert (spool_of(place) / "manifest.json").is_file()
    run(sample(4), CONFIG, out=place, resume=True)
    assert json.loads((place / "manifest.json").read_text())["status"] == "done"
