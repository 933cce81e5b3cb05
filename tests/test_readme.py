"""The README's commands, outputs, options and files: each is run or parsed here, so that none of them can grow stale."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import click
import pytest

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()
# What runs elsewhere takes the tests' own lslam: the one that is installed would compile its kernels once more.
HERE = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])}
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


def shell_lines() -> list[str]:
    return [line.split("  #")[0].strip() for kind, text in BLOCKS if kind == "bash" for line in text.splitlines()]


def test_ci_runs_exactly_the_readmes_test_command() -> None:
    commands = [line for line in shell_lines() if "pytest" in line]
    assert len(commands) == 1
    script = (ROOT / ".ci" / "run").read_text().splitlines()
    assert [line.removesuffix(" || exit 1") for line in script if "pytest" in line] == commands
    assert {"ruff check .", "ruff format --check .", "mypy"} <= set(script)


def test_one_command_installs_and_runs_the_main_job() -> None:
    first = shell_lines()[0]
    steps = [shlex.split(step) for step in first.split("&&")]
    assert steps[:3] == [["python3", "-m", "venv", ".venv"], [".", ".venv/bin/activate"], ["pip", "install", "."]]
    assert steps[3][:3] == ["lslam", "run", "sample_data"]
    assert (ROOT / "sample_data").is_dir()


def lslam_calls() -> list[list[str]]:
    """Each `lslam ...` of the README: its shell blocks, and its text in backticks."""
    quoted = re.findall(r"`(lslam [^`]+)`", re.sub(r"^```.*?^```$", "", README, flags=re.MULTILINE | re.DOTALL))
    steps = [step.strip() for line in [*shell_lines(), *quoted] for step in line.split("&&")]
    return [shlex.split(step.partition(" > ")[0])[1:] for step in steps if step.startswith("lslam ")]


@pytest.mark.parametrize("call", lslam_calls(), ids=" ".join)
def test_commands_of_the_readme_exist_with_their_options(call: list[str]) -> None:
    from lslam.cli.main import cli

    command: click.Command = cli
    words = call
    while isinstance(command, click.Group):
        found = command.get_command(click.Context(command), words[0])
        assert found is not None, f"no command {words[0]}"
        command, words = found, words[1:]
    # Parsing alone: types, choices and unknown options, without running anything.
    command.make_context(command.name, list(words))


def test_flags_the_readme_mentions_exist() -> None:
    from lslam.cli.main import COMMANDS, cli

    known = {"--help", "--version", "--nworkers", "--nthreads"}  # the last two of `dask worker`
    for name in COMMANDS:
        command = cli.get_command(click.Context(cli), name)
        assert command is not None
        inner = list(command.commands.values()) if isinstance(command, click.Group) else []
        known |= {o for c in [command, *inner] for p in c.params for o in p.opts + p.secondary_opts}
    assert set(re.findall(r"(?<![\w-])--[a-z][\w-]+", README)) <= known


def test_configuration_keys_of_the_readme_exist() -> None:
    from lslam.config import load_config
    from lslam.simulation.scenario_files import scenario_named

    # Of `simulate` they are a scenario's.
    lines = [line for line in shell_lines() if not line.startswith("lslam simulate")]
    settings = re.findall(r"--set (\S+)", "\n".join(lines))
    simulated = [line for line in shell_lines() if line.startswith("lslam simulate") and "--set" in line]
    assert simulated
    for line in simulated:
        scenario_named(line.split()[2], re.findall(r"--set (\S+)", line))
    variables = set(re.findall(r"LSLAM_[A-Z_]+", README)) - {"LSLAM_DATA"}
    assert settings
    assert variables
    load_config(None, settings, {})
    for name in variables:
        section, _, key = name.removeprefix("LSLAM_").lower().partition("_")
        assert key in type(getattr(load_config(), section)).model_fields


def test_sequence_toml_of_the_readme_is_understood(tmp_path: Path) -> None:
    from lslam.formats.sequence_toml import read_sequence_toml

    (text,) = [text for kind, text in BLOCKS if kind == "toml" and "[parameters]" not in text]
    (tmp_path / "sequence.toml").write_text(text)
    info = read_sequence_toml(tmp_path / "sequence.toml")
    assert (info.rows, info.cols, info.ground_truth_frame) == (64, 1024, "lidar")


def test_study_of_the_readme_is_understood_and_says_what_was_printed() -> None:
    import tomllib

    from lslam.config.study import parse_study

    (text,) = [text for kind, text in BLOCKS if kind == "toml" and "[parameters]" in text]
    study = parse_study(tomllib.loads(text), "README", "shares")
    assert len(study.points()) == 8
    (shown,) = [text for kind, text in BLOCKS if kind == "text" and "best at" in text]
    assert all(finding.text in shown for finding in study.finding)
    assert {f"{study.methods[0]}+imu", f"{study.beside[0]}+imu"} <= set(shown.split())


def test_python_of_the_readme_runs(tmp_path: Path) -> None:
    (text,) = [text for kind, text in BLOCKS if kind == "python"]
    (tmp_path / "sample_data").symlink_to(ROOT / "sample_data")
    call = [sys.executable, "-c", text]
    done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, check=False, env=HERE)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout.split()[0]) < 0.1


def test_output_of_the_readme_is_what_a_run_prints(tmp_path: Path) -> None:
    (shown,) = [text for kind, text in BLOCKS if kind == "text" and "status" in text]
    call = [sys.executable, "-m", "lslam", "run", str(ROOT / "sample_data"), "--out", str(tmp_path / "first"), "-q"]
    done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, check=False, env=HERE)
    assert done.returncode == 0, done.stderr

    def facts(text: str) -> list[list[str]]:
        # Times belong to the machine and paths to the user; digits may differ between versions of NumPy.
        rows = [re.split(r"\s{2,}", line.strip(), maxsplit=1) for line in text.splitlines()]
        return [[row[0]] + row[1:] * (row[0] in {"status", "scans", "path"}) for row in rows]

    assert facts(shown) == facts(done.stdout)
    listed = {
        name for row in re.findall(r"^\| (`.*?) \|", README, re.MULTILINE) for name in re.findall(r"`(\S+?)`", row)
    }
    assert {path.name for path in (tmp_path / "first").iterdir()} == listed


def test_exit_codes_of_the_readme_are_those_of_the_errors() -> None:
    from lslam import errors

    listed = {int(code) for code in re.findall(r"^\| (\d+) \|", README, re.MULTILINE)}
    classes = [c for c in vars(errors).values() if isinstance(c, type) and issubclass(c, errors.LslamError)]
    assert listed == {0} | {c.exit_code for c in classes}


def test_files_the_readme_links_to_exist() -> None:
    linked = re.findall(r"\]\(([^):]+)\)", README)
    named = re.findall(r"`(sample_data\S*|LICENSE|CITATION\.cff)`", README)
    assert linked
    assert named
    assert all((ROOT / name).is_file() for name in linked + named)
