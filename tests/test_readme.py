"""The README: short, its commands and outputs true."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

from pages import ROOT, page, task_pages

README = page("README.md")
# What runs elsewhere takes the tests' own lslam: the one that is installed would compile its kernels once more.
HERE = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])}


def test_the_readme_is_short() -> None:
    assert len(README.text.splitlines()) <= 150


def test_ci_runs_exactly_the_readmes_test_commands() -> None:
    commands = [line for line in README.shell_lines() if "pytest" in line]
    assert [line.rpartition("python -m ")[2] for line in commands] == ["pytest", "pytest -m slow"]
    script = (ROOT / ".ci" / "run").read_text().splitlines()
    assert [line.removesuffix(" || exit 1") for line in script if "pytest" in line] == commands
    assert {"ruff check .", "ruff format --check .", "mypy", "mkdocs build --strict"} <= set(script)


def test_one_command_installs_and_runs_the_main_job() -> None:
    first = README.shell_lines()[0]
    steps = [shlex.split(step) for step in first.split("&&")]
    install = ["pip", "install", "--no-compile", "."]
    assert steps[:3] == [["python3", "-m", "venv", ".venv"], [".", ".venv/bin/activate"], install]
    assert steps[3][:3] == ["lslam", "run", "sample_data"]
    assert (ROOT / "sample_data").is_dir()


def test_twelve_things_are_twelve() -> None:
    section = README.text.split("## Twelve things people do")[1].split("\n## ")[0]
    assert [int(n) for n in re.findall(r"  # +(\d+) ", section)] == list(range(1, 13))


def test_no_benchmark_in_a_how_to() -> None:
    for shown in task_pages():
        assert not re.findall(r"medians? of|worst of|of five seeds", shown.prose)
        assert "<!-- table" not in shown.text


def test_output_of_the_readme_is_what_a_run_prints(tmp_path: Path) -> None:
    shown = README.block("text", "status")
    call = [sys.executable, "-m", "lslam", "run", str(ROOT / "sample_data"), "--out", str(tmp_path / "first"), "-q"]
    done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, check=False, env=HERE)
    assert done.returncode == 0, done.stderr

    def facts(text: str) -> list[list[str]]:
        # Times belong to the machine and paths to the user; digits may differ between versions of NumPy.
        rows = [re.split(r"\s{2,}", line.strip(), maxsplit=1) for line in text.splitlines()]
        return [[row[0]] + row[1:] * (row[0] in {"status", "scans", "path"}) for row in rows]

    assert facts(shown) == facts(done.stdout)
    section = page("docs/tasks/run_folder.md").text.split("\n## ")[0]
    listed = {
        name for row in re.findall(r"^\| (`.*?) \|", section, re.MULTILINE) for name in re.findall(r"`(\S+?)`", row)
    }
    assert {path.name for path in (tmp_path / "first").iterdir()} == listed


def test_python_of_the_page_runs(tmp_path: Path) -> None:
    (tmp_path / "sample_data").symlink_to(ROOT / "sample_data")
    call = [sys.executable, "-c", page("docs/tasks/python.md").block("python")]
    done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, check=False, env=HERE)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout.split()[0]) < 0.1
