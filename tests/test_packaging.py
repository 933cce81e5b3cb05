"""What a fresh machine relies on: declared dependencies, light imports, packed data, a small repository."""

from __future__ import annotations

import ast
import importlib
import json
import os
import re
import resource
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Mapping
from functools import cache
from importlib.metadata import distribution, entry_points, packages_distributions
from pathlib import Path
from typing import Any

import pytest
from packaging.markers import Marker
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet

from lslam.core.extras import install_command

ROOT = Path(__file__).resolve().parents[1]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]

DEPENDENCIES = [Requirement(text) for text in PROJECT["dependencies"]]
TEST_EXTRA = [Requirement(text) for text in PROJECT["optional-dependencies"]["test"] if text != "lslam[docs]"]
# What a user may install beside: `pip install 'lslam[small-gicp]'`.
CHOICES = [
    Requirement(t)
    for name, texts in PROJECT["optional-dependencies"].items()
    if name not in ("test", "peers", "docs", "browser", "all")
    for t in texts
]
DOCS = [Requirement(t) for t in PROJECT["optional-dependencies"]["docs"]]
# What some tests ask for and are skipped without.
PEERS = [Requirement(t) for name in ("peers", "browser") for t in PROJECT["optional-dependencies"][name]]
# One module by two names: a machine has one of them.
EITHER = {"open3d", "open3d-cpu"}
# Run as commands, not imported.
TOOLS = {"ipykernel", "mypy", "pytest-xdist", "ruff", "scipy-stubs", "types-defusedxml", "types-requests"}
# Comes with pytest.
WITH_PYTEST = {"packaging"}
# Imported by a script that runs in an environment of its own: it wants an older numpy than other peers.
ELSEWHERE = {"kiss-slam"}


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def files() -> list[Path]:
    """The files of the repository: what git tracks, or everything but litter where there is no git."""
    if shutil.which("git") and (ROOT / ".git").exists():
        listing = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
        if listing.returncode == 0 and listing.stdout:
            found = [ROOT / name for name in listing.stdout.split("\0") if name]
            return [path for path in found if path.is_file()]
    litter = {"build", "dist", "runs", "site", "venv", "__pycache__", "lslam.egg-info"}
    return [
        path for path in ROOT.rglob("*")
        if path.is_file() and not any(p in litter or (p.startswith(".") and p != ".ci") for p in path.relative_to(ROOT).parts)
    ]  # fmt: skip


def third_party(folder: Path) -> dict[str, list[str]]:
    """Top names imported anywhere below `folder`, lazily too, that are neither Python's nor ours; with the files."""
    # Test modules and their folders import each other by their bare names; a method's file may bear the name of what it wraps.
    here = [path for path in folder.rglob("*.py") if folder.name == "tests"]
    ours = {"lslam"} | {path.stem for path in here} | {path.parent.name for path in here}
    found: dict[str, list[str]] = {}
    for path in folder.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names = [node.module]
            for name in {name.partition(".")[0] for name in names} - ours - set(sys.stdlib_module_names) - LATER:
                found.setdefault(name, []).append(str(path.relative_to(ROOT)))
    return found


# Of Python itself, from 3.14 on.
LATER = {"compression"}
# Too large to be installed for tests: their packages by the modules they provide.
ABSENT = {"rerun": "rerun-sdk"}


@cache
def distributions() -> Mapping[str, list[str]]:
    """Of every installed top module; listing them takes a second."""
    return packages_distributions()


def provider(module: str) -> set[str]:
    return {canonical(name) for name in distributions().get(module, [ABSENT.get(module, module)])}


# -- what is declared


def test_console_script_points_at_a_function() -> None:
    (script,) = [s for s in entry_points(group="console_scripts") if s.name == "lslam"]
    assert script.value == PROJECT["scripts"]["lslam"]
    module, _, name = script.value.partition(":")
    assert callable(getattr(importlib.import_module(module), name))


def test_every_import_of_the_package_is_declared() -> None:
    declared = {canonical(r.name) for r in DEPENDENCIES + CHOICES}
    imported = third_party(ROOT / "lslam")
    missing = {name: where for name, where in imported.items() if not provider(name) & declared}
    assert not missing
    used = {name for module in imported for name in provider(module)}
    assert declared - used <= EITHER, "declared and never imported"


def test_every_import_of_the_tests_is_declared() -> None:
    extra = {canonical(r.name) for r in TEST_EXTRA}
    declared = {canonical(r.name) for r in DEPENDENCIES + PEERS} | extra | WITH_PYTEST | ELSEWHERE
    imported = third_party(ROOT / "tests")
    assert not {name: where for name, where in imported.items() if not provider(name) & declared}
    assert extra - {name for module in imported for name in provider(module)} <= TOOLS | EITHER


@pytest.mark.parametrize("requirement", DEPENDENCIES + CHOICES + PEERS + DOCS + TEST_EXTRA, ids=str)
def test_lower_bounds_are_stated(requirement: Requirement) -> None:
    operators = [s.operator for s in requirement.specifier]
    assert ">=" in operators
    # Pins of libraries clash with those of others; the bound on Python is the one that is known.
    assert not {"==", "<", "<="} & set(operators)


def test_python_bounds() -> None:
    python = SpecifierSet(PROJECT["requires-python"])
    assert [v for v in ("3.10", "3.11", "3.12", "3.13", "3.14") if v in python] == ["3.11", "3.12", "3.13", "3.14"]
    assert "Python 3.11 to 3.14" in (ROOT / "README.md").read_text(), "what is tested"
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

    for extra in (CHOICES, TEST_EXTRA):
        assert [r.name for r in extra if r.name.startswith("open3d") and applies(r.marker)] == [expected]


def test_python_without_a_wheel_of_kiss_icp_installs_all_else() -> None:
    skipped = [r.name for r in DEPENDENCIES if r.marker and not r.marker.evaluate({"python_version": "3.14"})]
    assert skipped == ["backports.zstd", "kiss-icp"]


def test_all_is_every_extra_for_users() -> None:
    (everything,) = [Requirement(text) for text in PROJECT["optional-dependencies"]["all"]]
    assert everything.extras == set(PROJECT["optional-dependencies"]) - {"all", "test", "peers", "docs", "browser"}


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ({"url": ROOT.as_uri(), "dir_info": {"editable": True}}, f"{ROOT}[geo]"),
        ({"url": "file:///no/such/folder", "dir_info": {}}, "lslam[geo]"),  # a container into which the build was copied
        ({"url": "https://a.b/lslam.whl", "archive_info": {}}, "lslam[geo] @ https://a.b/lslam.whl"),
        ({"url": "https://a.b/l.git", "vcs_info": {"vcs": "git", "commit_id": "7f5c"}}, "lslam[geo] @ git+https://a.b/l.git@7f5c"),
        ({}, "lslam[geo]"),  # from an index
    ],
)  # fmt: skip
def test_the_install_command_names_what_is_installed(
    source: dict[str, object], said: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """As PEP 610 records where a package came from; sources on the path have no such record."""
    monkeypatch.setattr("lslam.core.extras._SOURCES", tmp_path)

    class Installed:
        def read_text(self, name: str) -> str | None:
            assert name == "direct_url.json"
            return json.dumps(source) if source else None

    monkeypatch.setattr("importlib.metadata.distribution", lambda name: Installed())
    pip, install, requirement = shlex.split(install_command("geo"))
    assert (pip, install, requirement) == ("pip", "install", said)
    # As pip reads it.
    assert Requirement(requirement).extras == {"geo"} if requirement.startswith("lslam") else Path(said[:-5]).is_dir()
    (tmp_path / "pyproject.toml").touch()
    assert source or install_command("geo") == f"pip install '{tmp_path}[geo]'"


def test_no_text_names_an_extra_but_by_the_install_command() -> None:
    """Where lslam came from a folder, `pip install lslam[geo]` asks an index for another."""
    assert not [path for path in (ROOT / "lslam").rglob("*.py") if re.search(r"lslam\[[a-z]", path.read_text())]


def test_data_files_of_the_package_are_packed() -> None:
    patterns = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]["lslam"]
    package = ROOT / "lslam"
    packed = {path for pattern in patterns for path in package.glob(pattern)}
    data = {p for p in files() if package in p.parents and p.suffix != ".py"}
    assert data
    assert data <= packed, "not in package-data of pyproject.toml"


# -- light imports


@pytest.mark.parametrize(
    ("arguments", "unwanted"),
    [
        (["--help"], {"numpy", "numba", "pydantic", "rich"}),
        (["run", "sample_data", "--count", "5", "--out", "OUT"], {"kiss_icp", "embreex", "shapely"}),
        (["run", "sample_data", "--count", "5", "--method", "kiss-icp", "--out", "OUT"], {"embreex", "shapely"}),
        (["eval", "sample_data/poses/00.txt", "sample_data/poses/00.txt"], {"kiss_icp", "embreex", "shapely", "numba"}),
    ],
    ids=["help", "run", "run-kiss-icp", "eval"],
)
def test_commands_load_only_what_they_need(arguments: list[str], unwanted: set[str], tmp_path: Path) -> None:
    heavy = unwanted | {"open3d", "gtsam", "requests", "matplotlib", "evo", "small_gicp", "pandas"}
    words = [str(tmp_path / "out") if word == "OUT" else word for word in arguments]
    script = (
        "import atexit, sys\n"
        f"sys.argv = {['lslam', *words]!r}\n"
        f"atexit.register(lambda: print('loaded', sorted(set({sorted(heavy)!r}) & sys.modules.keys()), file=sys.stderr))\n"
        "from lslam.cli.main import main\n"
        "main()\n"
    )
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr.splitlines()[-1] == "loaded []"


@pytest.mark.parametrize(
    ("tool", "folder", "programs"),
    [("pipx", "PIPX_HOME", "PIPX_BIN_DIR"), ("uv", "UV_TOOL_DIR", "UV_TOOL_BIN_DIR")],
)
def test_installers_of_programs_install_a_command_that_runs(
    tool: str, folder: str, programs: str, tmp_path: Path
) -> None:
    """Where they are: they install into an environment of their own."""
    if shutil.which(tool) is None:
        pytest.skip(f"no {tool}")
    source = tmp_path / "source"
    for path in files():
        if path.is_relative_to(ROOT / "lslam") or path.parent == ROOT:
            (source / path.relative_to(ROOT)).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, source / path.relative_to(ROOT))
    words = {
        "pipx": ["pipx", "install", "--python", sys.executable],
        "uv": ["uv", "tool", "install", "--python", sys.executable],
    }
    env = {**os.environ, folder: str(tmp_path / "tools"), programs: str(tmp_path / "bin")}
    env.pop("PYTHONPATH", None)
    done = subprocess.run([*words[tool], str(source)], env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    sample = (str(tmp_path / "bin" / "lslam"), "run", str(ROOT / "sample_data"), "--count", "5", "--json", "-q")
    run = subprocess.run([*sample, "--out", "run"], env=env, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert json.loads(run.stdout)["manifest"]["counts"]["ok"] == 5


@pytest.mark.slow
def test_a_wheel_needs_no_checkout_for_the_demo(tmp_path: Path) -> None:
    """Its libraries are those of the tests, which are first asked for lslam: what the wheel lacks is missing here."""
    source, site = tmp_path / "source", tmp_path / "site"
    for path in files():
        if path.is_relative_to(ROOT / "lslam") or path.parent == ROOT:
            (source / path.relative_to(ROOT)).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, source / path.relative_to(ROOT))
    pip = [sys.executable, "-m", "pip", "-q", "--disable-pip-version-check"]
    wheel = [*pip, "wheel", "--no-deps", "-w", str(tmp_path), str(source)]
    made = subprocess.run(wheel, capture_output=True, text=True, check=False)
    if "No matching distribution found for setuptools" in made.stderr:
        pytest.skip("no index of packages is within reach")
    assert made.returncode == 0, made.stderr
    (built,) = tmp_path.glob("lslam-*.whl")
    subprocess.run([*pip, "install", "--no-deps", "--no-index", "--target", str(site), str(built)], check=True)
    shutil.rmtree(source)
    env = {**os.environ, "PYTHONPATH": str(site), "NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    start = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-P", "-m", "lslam", "demo", "--no-browser", "--json"],
        env=env, cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    end = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["manifest"]["counts"]["ok"] == 95
    assert (tmp_path / "lslam-demo/run/report.html").is_file()
    kept = {path.parent.name.rpartition("_")[0] for path in (tmp_path / "kernels").rglob("*.nbi")}
    assert kept, "kernels of the wheel's own files are compiled"
    # Of both cores, with an empty cache: a minute of the clock where nothing else runs.
    assert end.ru_utime - start.ru_utime < 60


def test_help_is_instant() -> None:
    def seconds() -> float:
        """Of a core, not of the clock: a busy machine is not a slow command."""
        start = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run([sys.executable, "-m", "lslam", "--help"], cwd=ROOT, capture_output=True, check=True)
        end = resource.getrusage(resource.RUSAGE_CHILDREN)
        return end.ru_utime + end.ru_stime - start.ru_utime - start.ru_stime

    assert min(seconds() for _ in range(3)) < 0.3


# -- a small repository of the house's shape


def test_top_level_holds_nothing_else() -> None:
    top = {path.relative_to(ROOT).parts[0] for path in files()}
    required = {
        "pyproject.toml",
        "lslam",
        "tests",
        "docs",
        "sample_data",
        "README.md",
        "CHANGELOG.md",
        "CONTRIBUTING.md",
        "mkdocs.yml",
        "LICENSE",
        "CITATION.cff",
        "Dockerfile",
        ".ci",
        ".dockerignore",
        ".gitignore",
    }
    assert required - {".ci", ".dockerignore", ".gitignore"} <= top <= required


def test_the_image_has_two_stages_and_no_root() -> None:
    lines = [
        line.split() for line in (ROOT / "Dockerfile").read_text().splitlines() if line and not line.startswith("#")
    ]
    stages = [n for n, words in enumerate(lines) if words[0] == "FROM"]
    assert [lines[n][1] for n in stages] == ["python:3.11-slim"] * 2
    last = lines[stages[1] :]
    assert ["USER", "lslam"] in last
    assert last[-1][0] == "ENTRYPOINT"
    # What built it stays behind: of the first stage only the environment is taken.
    assert [words[1:] for words in last if words[0] == "COPY"] == [["--from=build", "/opt/lslam", "/opt/lslam"]]


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
