"""What a person with a fresh machine relies on: the README's commands, the declared dependencies, a small repository."""

from __future__ import annotations

import ast
import importlib
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import distribution, entry_points, packages_distributions
from pathlib import Path
from typing import Any

import click
import pytest
from packaging.markers import Marker
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

ROOT = Path(__file__).resolve().parents[1]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"^```(\w*)\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)

DEPENDENCIES = [Requirement(text) for text in PROJECT["dependencies"]]
TEST_EXTRA = [Requirement(text) for text in PROJECT["optional-dependencies"]["test"]]
# Promised to the user though nothing imports them by name yet: the pose graph, OpenStreetMap, outlier removal.
PROMISED = {"gtsam", "requests", "open3d", "open3d-cpu"}
# Run as commands, not imported.
TOOLS = {"mypy", "ruff", "scipy-stubs"}
# Comes with pytest.
WITH_PYTEST = {"packaging"}


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def shell_lines() -> list[str]:
    return [line.split("  #")[0].strip() for kind, text in BLOCKS if kind == "bash" for line in text.splitlines()]


def files() -> list[Path]:
    """The files of the repository: what git tracks, or everything but litter where there is no git."""
    if shutil.which("git") and (ROOT / ".git").exists():
        listing = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
        if listing.returncode == 0 and listing.stdout:
            found = [ROOT / name for name in listing.stdout.split("\0") if name]
            return [path for path in found if path.is_file()]
    litter = {"build", "dist", "runs", "venv", "__pycache__", "lslam.egg-info"}
    return [
        path for path in ROOT.rglob("*")
        if path.is_file() and not any(p in litter or (p.startswith(".") and p != ".ci") for p in path.relative_to(ROOT).parts)
    ]  # fmt: skip


def third_party(folder: Path) -> dict[str, list[str]]:
    """Top names imported anywhere below `folder`, lazily too, that are neither Python's nor ours; with the files."""
    ours = {"lslam"} | {path.stem for path in folder.rglob("*.py")}
    found: dict[str, list[str]] = {}
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names = [node.module]
            for name in {name.partition(".")[0] for name in names} - ours - set(sys.stdlib_module_names):
                found.setdefault(name, []).append(str(path.relative_to(ROOT)))
    return found


def provider(module: str) -> set[str]:
    return {canonical(name) for name in packages_distributions().get(module, [module])}


# -- the README's commands


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
    return [shlex.split(step)[1:] for step in steps if step.startswith("lslam ")]


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

    known = {"--help", "--version"}
    for name in COMMANDS:
        command = cli.get_command(click.Context(cli), name)
        assert command is not None
        inner = list(command.commands.values()) if isinstance(command, click.Group) else []
        known |= {o for c in [command, *inner] for p in c.params for o in p.opts + p.secondary_opts}
    assert set(re.findall(r"(?<![\w-])--[a-z][\w-]+", README)) <= known


def test_configuration_keys_of_the_readme_exist() -> None:
    from lslam.config import load_config

    settings = re.findall(r"--set (\S+)", "\n".join(shell_lines()))
    variables = set(re.findall(r"LSLAM_[A-Z_]+", README)) - {"LSLAM_DATA"}
    assert settings
    assert variables
    load_config(None, settings, {})
    for name in variables:
        section, _, key = name.removeprefix("LSLAM_").lower().partition("_")
        assert key in type(getattr(load_config(), section)).model_fields


def test_sequence_toml_of_the_readme_is_understood(tmp_path: Path) -> None:
    from lslam.formats.sequence_toml import read_sequence_toml

    (text,) = [text for kind, text in BLOCKS if kind == "toml"]
    (tmp_path / "sequence.toml").write_text(text)
    info = read_sequence_toml(tmp_path / "sequence.toml")
    assert (info.rows, info.cols, info.ground_truth_frame) == (64, 1024, "lidar")


def test_python_of_the_readme_runs(tmp_path: Path) -> None:
    (text,) = [text for kind, text in BLOCKS if kind == "python"]
    (tmp_path / "sample_data").symlink_to(ROOT / "sample_data")
    done = subprocess.run([sys.executable, "-c", text], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout.split()[0]) < 0.1


def test_output_of_the_readme_is_what_a_run_prints(tmp_path: Path) -> None:
    (shown,) = [text for kind, text in BLOCKS if kind == "text" and "status" in text]
    call = [sys.executable, "-m", "lslam", "run", str(ROOT / "sample_data"), "--out", str(tmp_path / "first"), "-q"]
    done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, check=False)
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


# -- what is declared


def test_console_script_points_at_a_function() -> None:
    (script,) = [s for s in entry_points(group="console_scripts") if s.name == "lslam"]
    assert script.value == PROJECT["scripts"]["lslam"]
    module, _, name = script.value.partition(":")
    assert callable(getattr(importlib.import_module(module), name))


def test_every_import_of_the_package_is_declared() -> None:
    declared = {canonical(r.name) for r in DEPENDENCIES}
    imported = third_party(ROOT / "lslam")
    missing = {name: where for name, where in imported.items() if not provider(name) & declared}
    assert not missing
    used = {name for module in imported for name in provider(module)}
    assert declared - used <= PROMISED, "declared and never imported"


def test_every_import_of_the_tests_is_declared() -> None:
    extra = {canonical(r.name) for r in TEST_EXTRA}
    declared = {canonical(r.name) for r in DEPENDENCIES} | extra | WITH_PYTEST
    imported = third_party(ROOT / "tests")
    assert not {name: where for name, where in imported.items() if not provider(name) & declared}
    assert extra - {name for module in imported for name in provider(module)} <= TOOLS


@pytest.mark.parametrize("requirement", DEPENDENCIES + TEST_EXTRA, ids=str)
def test_lower_bounds_are_stated(requirement: Requirement) -> None:
    operators = [s.operator for s in requirement.specifier]
    assert ">=" in operators
    # Pins of libraries clash with those of others; the bound on Python is the one that is known.
    assert not {"==", "<", "<="} & set(operators)


def test_python_bounds() -> None:
    python = SpecifierSet(PROJECT["requires-python"])
    assert [v for v in ("3.10", "3.11", "3.12", "3.13", "3.14") if v in python] == ["3.11", "3.12", "3.13"]
    assert "Python 3.11 to 3.13" in README
    installed = distribution("lslam").metadata["Requires-Python"]
    assert SpecifierSet(installed) == python


@pytest.mark.parametrize(
    ("system", "machine", "expected"),
    [("linux", "x86_64", "open3d-cpu"), ("linux", "aarch64", "open3d"), ("darwin", "arm64", "open3d")],
)
def test_one_open3d_for_every_machine(system: str, machine: str, expected: str) -> None:
    environment = {"sys_platform": system, "platform_machine": machine}

    def applies(marker: Marker | None) -> bool:
        return marker is None or marker.evaluate(environment)

    chosen = [r.name for r in DEPENDENCIES if r.name.startswith("open3d") and applies(r.marker)]
    assert chosen == [expected]


def test_data_files_of_the_package_are_packed() -> None:
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]["lslam"]
    package = ROOT / "lslam"
    packed = {path for pattern in patterns for path in package.glob(pattern)}
    data = {p for p in files() if package in p.parents and p.suffix != ".py"}
    assert data
    assert data <= packed, "not in package-data of pyproject.toml"


# -- a small repository of the house's shape


def test_top_level_holds_nothing_else() -> None:
    top = {path.relative_to(ROOT).parts[0] for path in files()}
    required = {
        "pyproject.toml",
        "lslam",
        "tests",
        "sample_data",
        "README.md",
        "LICENSE",
        "CITATION.cff",
        ".ci",
        ".gitignore",
    }
    assert required - {".ci", ".gitignore"} <= top <= required


def test_repository_is_small() -> None:
    sizes = {path: path.stat().st_size for path in files()}
    assert not [str(path) for path, size in sizes.items() if size > 2_000_000]
    assert sum(size for path, size in sizes.items() if ROOT / "sample_data" in path.parents) < 10_000_000


def test_no_path_of_a_machine_is_written_down() -> None:
    # Assembled, so that this file does not hold what it looks for.
    homes = re.compile(
        "|".join("/" + name + "/" for name in ("home", "root", "Users", "tmp", "work", "mnt", "workspace"))
    )
    found = []
    for path in files():
        if path.suffix in {".bin", ".npz", ".png"}:
            continue
        lines = path.read_text(encoding="utf-8").splitlines()
        found += [f"{path.relative_to(ROOT)}:{n}" for n, line in enumerate(lines, 1) if homes.search(line)]
    assert not found


def test_version_is_one() -> None:
    from lslam import __version__

    citation = re.search(r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert citation
    assert citation.group(1) == __version__ == distribution("lslam").version


def test_files_the_readme_links_to_exist() -> None:
    linked = re.findall(r"\]\(([^):]+)\)", README)
    named = re.findall(r"`(sample_data\S*|LICENSE|CITATION\.cff)`", README)
    assert linked
    assert named
    assert all((ROOT / name).is_file() for name in linked + named)
