"""The run folder: what is refused, what is replaced, and what is left when writing fails."""

from __future__ import annotations

import errno
import io
import json
import logging
import multiprocessing
import os
import shutil
from collections import namedtuple
from pathlib import Path

import pytest

from lslam.core.errors import OutputError, OutputExistsError
from lslam.pipeline.run_folder import LOCK, MANIFEST, RunFolder, default_folder

Usage = namedtuple("Usage", "total used free")


def names(folder: Path) -> set[str]:
    return {p.name for p in folder.iterdir()}


def test_an_empty_folder_is_taken_and_left_with_what_was_written(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with RunFolder(tmp_path / "out") as folder:
        assert LOCK in names(folder.path)
        folder.write_text("config.toml", "a = 1\n")
        folder.write_manifest({"status": "done"})
    assert names(tmp_path / "out") == {"config.toml", MANIFEST, "log.txt"}
    assert json.loads((tmp_path / "out" / MANIFEST).read_text()) == {"status": "done"}


def test_an_existing_run_needs_overwrite_which_removes_our_files_only(tmp_path: Path) -> None:
    out = tmp_path / "out"
    with RunFolder(out) as folder:
        folder.write_manifest({"status": "done"})
    (out / "map.ply").write_text("old")
    (out / "map.ply.part").write_text("half")
    (out / "notes-of-mine.md").write_text("keep")
    (out / "download.part").write_text("somebody else's")
    with pytest.raises(OutputExistsError, match="--overwrite"):
        RunFolder(out)
    with RunFolder(out, overwrite=True):
        assert names(out) == {LOCK, "log.txt", "notes-of-mine.md", "download.part"}


def test_foreign_folders_and_files_are_refused_untouched(tmp_path: Path) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "map.ply").write_text("mine")
    with pytest.raises(OutputExistsError, match="not a run of lslam"):
        RunFolder(tmp_path / "photos", overwrite=True)
    assert names(tmp_path / "photos") == {"map.ply"}
    with pytest.raises(OutputExistsError, match="is a file"):
        RunFolder(tmp_path / "photos" / "map.ply", overwrite=True)


def _hold_in_child(path: Path, held: multiprocessing.synchronize.Event, go: multiprocessing.synchronize.Event) -> None:
    with RunFolder(path) as folder:
        folder.write_manifest({"status": "running"})
        held.set()
        go.wait(30)


def test_a_folder_another_process_writes_is_in_use_until_it_ends(tmp_path: Path) -> None:
    spawn = multiprocessing.get_context("spawn")
    held, go = spawn.Event(), spawn.Event()
    child = spawn.Process(target=_hold_in_child, args=(tmp_path / "out", held, go))
    child.start()
    try:
        assert held.wait(30)
        before = names(tmp_path / "out")
        for overwrite in (False, True):
            with pytest.raises(OutputExistsError, match="in use by another run"):
                RunFolder(tmp_path / "out", overwrite)
        assert names(tmp_path / "out") == before
    finally:
        child.kill()
        child.join(30)
    # Killed, so the lock file is still there: it must not keep anybody out.
    assert LOCK in names(tmp_path / "out")
    with RunFolder(tmp_path / "out", overwrite=True):
        assert MANIFEST not in names(tmp_path / "out")


@pytest.mark.parametrize("below", ["file/run", "/proc/no-such/run", "x" * 300])
def test_what_cannot_be_written_says_so(tmp_path: Path, below: str) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written: "):
        RunFolder(tmp_path / below)


def test_a_closed_folder_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def closed(path: object, mode: int = 0o777) -> None:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    # Not by the folder's mode: root, which tests in containers are, may write everywhere.
    monkeypatch.setattr(os, "mkdir", closed)
    with pytest.raises(OutputError, match="Permission denied"):
        RunFolder(tmp_path / "out")


def test_space_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with RunFolder(tmp_path / "out") as folder:
        folder.require_space(1000, "the map")
        monkeypatch.setattr(shutil, "disk_usage", lambda path: Usage(10**9, 10**9 - 999, 999))
        with pytest.raises(OutputError, match=r"the map needs about .* --out"):
            folder.require_space(1000, "the map")


def test_a_write_that_fails_leaves_the_old_file_and_no_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with RunFolder(tmp_path / "out") as folder:
        folder.write_manifest({"status": "running"})
        folder.write_text("timing.csv", "old")
        with monkeypatch.context() as patched:

            def full(source: object, target: object) -> None:
                raise OSError(28, "No space left on device")

            patched.setattr(os, "replace", full)
            with pytest.raises(OutputError, match=r"timing\.csv cannot be written: No space left"):
                folder.write_text("timing.csv", "new")
        assert (folder.path / "timing.csv").read_text() == "old"
    assert names(tmp_path / "out") == {MANIFEST, "timing.csv", "log.txt"}


def test_a_folder_without_a_status_is_not_left_behind(tmp_path: Path) -> None:
    with RunFolder(tmp_path / "out") as folder:
        folder.write_text("config.toml", "a = 1\n")
    assert not (tmp_path / "out").exists()


def test_the_log_is_kept_also_for_callers_without_logging(tmp_path: Path) -> None:
    log = logging.getLogger("lslam")
    level = log.level
    with RunFolder(tmp_path / "out") as folder:
        folder.write_manifest({"status": "running"})
        log.info("a decision")
    log.info("after the run")
    text = (tmp_path / "out" / "log.txt").read_text()
    assert "INFO a decision" in text
    assert "after the run" not in text
    assert log.level == level


def test_a_full_disk_does_not_break_the_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    class Full(io.StringIO):
        def write(self, text: str) -> int:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with RunFolder(tmp_path / "out"):
        handler = next(h for h in logging.getLogger("lslam").handlers if isinstance(h, logging.FileHandler))
        handler.setStream(Full())
        logging.getLogger("lslam").warning("nobody can keep this")
    assert "Traceback" not in capsys.readouterr().err


def test_default_names_stay_below_runs_and_do_not_collide(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    first = default_folder("seq07", "icp", 0.0)
    assert first.parent == Path("runs")
    assert first.name.startswith("seq07-icp-19")
    first.mkdir(parents=True)
    assert default_folder("seq07", "icp", 0.0) == first.with_name(first.name + "-2")
    for name in ("../../etc", "a/b", "..", "", "ä b:c", "x" * 400, "ä" * 400):
        folder = default_folder(name, "icp", 0.0)
        assert len(os.fsencode(folder.name)) <= 200
        assert folder.parent == Path("runs")
        assert ".." not in folder.parts
        assert not folder.name.startswith(("-", "."))
