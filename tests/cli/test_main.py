"""The command by itself: help at once, versions, completion, methods, configuration, names that are nearly right."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from calling import COMMAND, assert_one_sentence, environment, lslam, lslam_process, strict_json

from lslam.cli.main import COMMANDS
from lslam.core.config.odometry import TIGHTLY_COUPLED
from lslam.odometry import METHODS


def test_help_is_instant_and_imports_nothing_heavy() -> None:
    """Counted in modules, since what it takes is what is imported; `tests/benchmarks/waits.py` has the seconds."""
    code = (
        "import sys\nfrom lslam.cli.main import main\nsys.argv = ['lslam', '--help']\ntry:\n    main()\n"
        "finally:\n    print(*sys.modules, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment())
    for name in COMMANDS:
        assert f"  {name} " in done.stdout
    imported = done.stderr.split()
    roots = {name.split(".")[0] for name in imported} - set(sys.stdlib_module_names)
    # Debian's interpreter has a sitecustomize of its own.
    assert {root for root in roots if not root.startswith("_")} - {"sitecustomize"} == {"lslam", "click"}
    ours = {name for name in imported if name.split(".")[0] == "lslam"}
    small = {"lslam.core.errors", "lslam.core", "lslam.core.machine", "lslam.core.stopping"}
    assert ours == {"lslam", "lslam.cli", "lslam.cli.main", *small}
    # A bare interpreter has some 30 modules, click and what it needs of the standard library some 80.
    assert len(imported) < 200


def test_every_command_has_help_with_an_example() -> None:
    for name in COMMANDS:
        done = lslam(name, "--help")
        assert done.returncode == 0
        assert "Usage: " in done.stdout
        assert f"lslam {name}" in done.stdout.split("Usage: ")[1].split("\n", 1)[1], f"{name} shows no example"


def test_version_names_the_libraries() -> None:
    done = lslam("--version")
    assert done.returncode == 0
    assert done.stdout.startswith("lslam ")
    for name in ("numpy", "numba", "kiss-icp"):
        assert f"\n  {name} " in done.stdout


@pytest.mark.parametrize(
    ("shell", "words"), [("bash", "complete -o"), ("zsh", "#compdef lslam"), ("fish", "complete ")]
)
def test_completion_scripts(shell: str, words: str) -> None:
    done = lslam("completion", shell)
    assert (done.returncode, done.stderr) == (0, "")
    assert words in done.stdout


def test_completion_completes() -> None:
    env = environment(_LSLAM_COMPLETE="bash_complete", COMP_WORDS="lslam ru", COMP_CWORD="1")
    code = "import sys; sys.argv = ['lslam']; from lslam.cli.main import cli; cli(prog_name='lslam')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=env)
    assert done.stdout == "plain,run\n"


def test_methods_are_listed() -> None:
    done = lslam("methods")
    assert (done.returncode, done.stderr) == (0, "")
    groups = {
        lines[0]: [line.split()[0] for line in lines[1:]]
        for lines in (part.splitlines() for part in done.stdout.split("\n\n"))
    }
    loose, tight, baselines, given = groups.values()
    assert loose[0] == "icp", "the default comes first"
    assert {"gicp", "loam", "floam", "lego-loam"} < set(loose)
    assert tight == list(TIGHTLY_COUPLED)
    assert "kiss-icp" in baselines
    assert given == ["poses"]
    listed = {each["name"]: each for each in strict_json(lslam("methods", "--json").stdout)["methods"]}
    assert set(listed) == set(METHODS) == {*loose, *tight, *baselines, *given}
    assert (listed["kiss-icp"]["coupling"], listed["kiss-icp"]["is_baseline"]) == ("none", True)
    assert (listed["fast-lio2"]["coupling"], listed["fast-lio2"]["is_baseline"]) == ("tight", False)


def test_config_show_can_be_checked_and_shown_again(tmp_path: Path) -> None:
    shown = lslam("config", "show", "--set", "map.voxel=0.1")
    assert (shown.returncode, shown.stderr) == (0, "")
    assert tomllib.loads(shown.stdout)["map"]["voxel"] == 0.1
    (tmp_path / "my.toml").write_text(shown.stdout)
    assert lslam("config", "check", tmp_path / "my.toml").stdout.endswith(": ok\n")
    assert lslam("config", "show", "--config", tmp_path / "my.toml").stdout == shown.stdout
    described = lslam("config", "show", "--describe").stdout
    assert "one averaged point per voxel" in described
    assert "# count =  # number of scans used" in described
    (tmp_path / "described.toml").write_text(described)
    assert lslam("config", "show", "--config", tmp_path / "described.toml").stdout == lslam("config", "show").stdout


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[map]\nvoxl = 1\n", "did you mean 'voxel'"),
        ("[registratoin]\nsigma = 1\n", "did you mean 'registration'"),
        ("[odometry]\nmethod = 'icpp'\n", "did you mean 'icp'"),
        ("[eval]\ndelta = ['10 furlongs']\n", "10m/all"),
        ("[map]\nvoxel = -1\n", "map.voxel = -1"),
        ("not toml", "not valid TOML"),
    ],
)
def test_config_check_reports_errors(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "my.toml").write_text(text)
    done = lslam("config", "check", tmp_path / "my.toml")
    assert (done.returncode, done.stdout) == (2, "")
    assert_one_sentence(done.stderr)
    assert words in done.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["runn", "x"], "no command 'runn'; did you mean 'run'?"),
        (["run"], "Missing argument 'SEQUENCE'; see"),
        (["run", "x", "--coutn", "3"], "'--count'"),
        (["run", "x", "--count", "many"], "'many' is not a valid integer"),
        (["--verzion"], "--version"),
        (["run", "--out"], "requires an argument; see lslam run --help"),
        (["osm", "fetch", "--bbox"], "requires an argument; see lslam osm fetch --help"),
        (["run", "x", "--method", "KISS-ICP"], "did you mean 'kiss-icp'"),
        (["completion", "tcsh"], "'bash', 'zsh', 'fish'"),
    ],
)
def test_wrong_usage_is_one_sentence_and_exit_2(arguments: list[str], words: str) -> None:
    done = lslam(*arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert_one_sentence(done.stderr)
    assert words in done.stderr


def test_without_a_command_the_help_is_shown() -> None:
    done = lslam()
    assert done.returncode == 2
    assert "Commands:" in done.stderr


def test_a_reader_that_leaves_is_no_error() -> None:
    first = subprocess.Popen([*COMMAND, "config", "show"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert first.stdout is not None
    first.stdout.close()
    assert first.stderr is not None
    assert first.stderr.read() == ""
    assert first.wait(60) == 0


def test_a_stdout_that_takes_nothing_is_exit_3(tmp_path: Path) -> None:
    """Opened for reading: every system refuses what is written there, as a full disk does."""
    (tmp_path / "out.txt").touch()
    with (tmp_path / "out.txt").open() as closed:
        done = subprocess.run([*COMMAND, "methods"], stdout=closed, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 3
    assert_one_sentence(done.stderr)
    assert "standard output cannot be used" in done.stderr


def test_an_ascii_terminal_gets_question_marks_not_errors() -> None:
    done = lslam_process("eval", "--help", env=environment(PYTHONIOENCODING="ascii"))
    assert done.returncode == 0
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("words", [("--help",), ("--version",), ("run", "--help")])
def test_a_reader_that_has_left_is_no_error_for_help_either(words: tuple[str, ...]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "wb") as nobody:
        done = subprocess.run([*COMMAND, *words], stdout=nobody, stderr=subprocess.PIPE, env=environment(), check=False)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize(("words", "code"), [("methods", 0), ("methods --no-such", 2)])
def test_a_stderr_that_was_closed_before_keeps_the_exit_code(words: str, code: int) -> None:
    command = shlex.join([*COMMAND, *words.split()])
    assert subprocess.run(["sh", "-c", f"{command} 2>&-"], stdout=subprocess.DEVNULL, check=False).returncode == code


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_an_error_that_nobody_reads_keeps_its_exit_code(unbuffered: str) -> None:
    """As of `lslam view` whose terminal was closed. What a pipe refused stays in a buffer, which Python writes again at exit."""
    reader, writer = os.pipe()
    os.close(reader)
    env = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    try:
        command = [*COMMAND, "methods", "--no-such"]
        done = subprocess.run(command, stderr=writer, stdout=subprocess.DEVNULL, env=env, check=False)
    finally:
        os.close(writer)
    assert done.returncode == 2
