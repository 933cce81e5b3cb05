"""The page that `lslam view` serves: this version's may talk to the server, any other reaches nothing."""

from __future__ import annotations

import logging
import re
from pathlib import Path

import pytest

from lslam.core.errors import InputError
from lslam.pipeline.view.sites import page_of, require_page
from lslam.reports.shell import RUN, policy, script_of, template


def written(folder: Path, text: str) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "report.html").write_text(text)
    return folder


def shell() -> str:
    script = script_of(RUN)
    return template("shell.html.j2").render(version="1", script=script, policy=policy(script))


def test_the_page_of_this_version_may_ask_the_server_and_runs_no_other_script(tmp_path: Path) -> None:
    folder = written(tmp_path / "run<b>", shell())
    answer = page_of(folder)
    text, rules = answer.body.decode(), dict(answer.headers)["Content-Security-Policy"]
    for said in (rules, re.findall('Content-Security-Policy" content="([^"]*)"', text)[0]):
        assert said.endswith("; connect-src 'self'")
        assert said.startswith("default-src 'none'")
        assert script_of(RUN).digest in said
        assert "script-src 'unsafe" not in said
    assert text.count('<script type="application/json" id="served">{}</script>') == 1
    assert "connect-src" not in (folder / "report.html").read_text()


def test_a_page_of_another_version_is_shown_by_itself_and_said(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = shell().replace(script_of(RUN).digest, "sha256-other")
    folder = written(tmp_path / "run", old)
    (folder / "trajectory.tum").touch()
    answer = page_of(folder)
    assert answer.body.decode() == old
    assert dict(answer.headers)["Content-Security-Policy"] == "sandbox allow-scripts allow-downloads"
    monkeypatch.setattr(logging.getLogger("lslam"), "propagate", True)
    with caplog.at_level(logging.WARNING, "lslam"):
        require_page(folder)
    assert f"lslam graph {folder} makes a new one" in caplog.text


def test_a_run_without_a_page_is_said(tmp_path: Path) -> None:
    (tmp_path / "trajectory.tum").touch()
    with pytest.raises(InputError, match=r"has no report\.html: make one with lslam graph"):
        require_page(tmp_path)
    with pytest.raises(InputError, match=r"report\.html"):
        page_of(tmp_path)
