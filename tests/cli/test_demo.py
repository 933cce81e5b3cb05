"""`lslam demo`: from nothing to a page, in one command."""

from __future__ import annotations

import json
import shlex
import webbrowser
from pathlib import Path

import pytest
from calling import SAMPLE, assert_one_sentence, lslam

from lslam.cli import console, demo


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """As `lslam demo`, of few scans."""
    monkeypatch.setattr(demo, "SCANS", 12)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)


def test_it_makes_a_recording_and_a_run_and_its_commands_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webbrowser, "open", lambda address: pytest.fail("there is no display"))
    done = lslam("demo", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    folder = tmp_path / "lslam-demo"
    page = folder / "run/report.html"
    assert page.is_file()
    manifest = json.loads((folder / "run/manifest.json").read_text())
    assert manifest["counts"]["ok"] == 12
    assert "status       done" in done.stdout
    assert f"The page is to be opened in a browser: {page}" in done.stdout
    lines = done.stdout.partition("To go on:\n")[2].splitlines()
    assert len(lines) == 3
    assert "\n".join(lines) in (SAMPLE.parent / "docs/tasks/installing.md").read_text()
    for line in lines:
        name, *words = shlex.split(line)
        assert name == "lslam"
        again = lslam(*words, cwd=tmp_path)
        assert again.returncode == 0, f"{line}: {again.stderr}"
    assert (folder / "georeferenced/map.laz").is_file()
    assert (folder / "compared/compare.html").is_file()
    once_more = lslam("demo", cwd=tmp_path)
    assert once_more.returncode == 2
    assert_one_sentence(once_more.stderr)
    assert "--overwrite" in once_more.stderr
    assert lslam("demo", "--overwrite", "-q", cwd=tmp_path).stderr == ""


def test_the_page_opens_where_there_is_a_display(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(webbrowser, "open", lambda address: bool(opened.append(address)) or True)
    out = tmp_path / "an odd name"
    done = lslam("demo", "--out", out)
    assert done.returncode == 0, done.stderr
    assert opened == [(out / "run/report.html").as_uri()]
    assert "The page is open in your browser" in done.stdout
    assert f"lslam info '{out}/recording'" in done.stdout
    shut = lslam("demo", "--out", out, "--no-browser", "--overwrite", "--json")
    assert len(opened) == 1
    assert json.loads(shut.stdout)["folder"] == str(out / "run")


def test_a_browser_that_fails_is_no_failure(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(address: str) -> bool:
        raise webbrowser.Error("no browser")

    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(webbrowser, "open", fail)
    assert console.open_page(tmp_path / "page.html") is False


def test_lslam_alone_says_to_try_it() -> None:
    done = lslam()
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].startswith("New here? `lslam demo`")
    assert "demo " in lslam("--help").stdout
