"""The tutorials run from their first command to their last, print what they show, and make their pictures."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from pages import ROOT, Page, every_page

TUTORIALS = [shown for shown in every_page() if shown.name.startswith("docs/tutorials/")]


def shape(line: str) -> str:
    """A line without its numbers and the width of its columns: times and digits belong to the machine."""
    return " ".join(re.sub(r"\d[\d.]*(e[+-]?\d+)?", "0", line).split())


def missing_lines(shown: str, printed: str) -> list[str]:
    """Lines of a block of output that no printed line is like; `...` stands for the rest of a line."""
    lines = [shape(line) for line in printed.splitlines()]

    def is_printed(line: str) -> bool:
        start, is_cut, _ = shape(line).partition("...")
        return any(one.startswith(start.rstrip()) if is_cut else one == start for one in lines)

    return [line for line in shown.splitlines() if line.strip() and not is_printed(line)]


@pytest.mark.slow
@pytest.mark.parametrize("tutorial", TUTORIALS, ids=lambda shown: shown.name)
def test_a_tutorial_runs_and_prints_what_it_shows(tutorial: Page, tmp_path: Path) -> None:
    (tmp_path / "bin").mkdir()
    for name, call in (("lslam", f"{sys.executable} -m lslam"), ("python", sys.executable)):
        script = tmp_path / "bin" / name
        script.write_text(f'#!/bin/sh\nexec {call} "$@"\n')
        script.chmod(0o755)
    work = tmp_path / "work"
    work.mkdir()
    shutil.copytree(ROOT / "sample_data", work / "sample_data")
    path = os.pathsep.join([str(tmp_path / "bin"), os.environ["PATH"]])
    environment = {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    printed = ""
    for language, text in tutorial.blocks:
        if language == "bash":
            call = ["bash", "-euo", "pipefail", "-c", text]
            done = subprocess.run(call, cwd=work, capture_output=True, text=True, check=False, env=environment)
            assert done.returncode == 0, done.stderr
            printed = done.stdout
        elif language == "text":
            assert missing_lines(text, printed) == []
        else:
            (work / text.splitlines()[0].removeprefix("# ")).write_text(text)
    pictures = [Path(link).name for link in tutorial.links() if link.endswith(".png")]
    assert all((work / name).is_file() for name in pictures)


def test_output_that_nobody_printed_is_missed() -> None:
    printed = "  scans        95 of 95 registered\n  path         114.4 m in 9.4 s\n"
    assert missing_lines("  scans   94 of 94 registered\n  path ...\n", printed) == []
    assert missing_lines("  scans   94 of 94 placed\n  way ...\n", printed) == [
        "  scans   94 of 94 placed",
        "  way ...",
    ]
