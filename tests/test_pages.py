"""The pages: links, commands, keys, files, constants and papers that they name exist and say what the code says."""

from __future__ import annotations

import ast
import re
from importlib import import_module
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from pages import ROOT, Page, every_page, page, slug, task_pages
from test_import_graph import LAYERS

PAGES, TASKS = every_page(), task_pages()
STUDIES, METHODS, ARCHITECTURE = (page(f"docs/{name}.md") for name in ("tasks/comparing", "algorithms", "architecture"))
PACKAGE = ROOT / "lslam"

# -- links


@pytest.mark.parametrize("shown", PAGES, ids=lambda shown: shown.name)
def test_links_lead_somewhere(shown: Page) -> None:
    for link in shown.links():
        if re.match(r"https?://", link):
            continue
        path, _, anchor = link.partition("#")
        target = (ROOT / shown.name).parent / path if path else ROOT / shown.name
        assert target.is_file(), f"{shown.name} links to {link}"
        if anchor:
            assert anchor in page(target.resolve().relative_to(ROOT).as_posix()).anchors(), f"{shown.name}: {link}"


@pytest.mark.parametrize("shown", PAGES, ids=lambda shown: shown.name)
def test_anchors_are_alike_on_every_host(shown: Page) -> None:
    # GitHub keeps a hyphen for each space, mkdocs joins them.
    titles = re.findall(r"^#+ (.+)$", shown.prose, re.MULTILINE)
    assert not [title for title in titles if "--" in slug(title)]


def test_the_site_has_every_page() -> None:
    listed = re.findall(r"^ +- [^:]+: (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE)
    docs = ROOT / "docs"
    assert sorted(listed) == sorted(path.relative_to(docs).as_posix() for path in docs.rglob("*.md"))


def test_the_api_page_names_what_exists() -> None:
    for name in re.findall(r"^::: (\S+)$", page("docs/api.md").text, re.MULTILINE):
        try:
            import_module(name)
        except ModuleNotFoundError:
            module, _, attribute = name.rpartition(".")
            assert hasattr(import_module(module), attribute), name


def test_code_cites_only_pages_that_are_here() -> None:
    wrong = []
    for path in [*PACKAGE.rglob("*.py"), *(ROOT / "tests").rglob("*.py")]:
        text = path.read_text(encoding="utf-8")
        cited = re.findall(r"\bdocs/[\w/]+\.md\b|\b[A-Z]+\.md\b", text)
        wrong += [f"{path.relative_to(ROOT)}: {name}" for name in cited if not (ROOT / name).is_file()]
        # Pages in capitals that nobody outside of the project's making has.
        wrong += [
            f"{path.relative_to(ROOT)}: {name}" for name in re.findall(r"\bCONVEN[T]IONS\b|\bALGO[R]ITHMS, ", text)
        ]
    assert not wrong


# -- commands


def calls() -> list[Any]:
    return [pytest.param(call, id=f"{shown.name} {' '.join(call)}") for shown in PAGES for call in shown.lslam_calls()]


@pytest.mark.parametrize("call", calls())
def test_commands_exist_with_their_options(call: list[str]) -> None:
    from lslam.cli.main import cli

    command: click.Command = cli
    words = call
    while isinstance(command, click.Group):
        found = command.get_command(click.Context(command), words[0])
        assert found is not None, f"no command {words[0]}"
        command, words = found, words[1:]
    if words:
        # Parsing alone: types, choices and unknown options, without running anything.
        command.make_context(command.name, list(words))


@pytest.mark.parametrize("shown", [*TASKS, page("docs/conventions.md"), ARCHITECTURE], ids=lambda shown: shown.name)
def test_flags_exist(shown: Page) -> None:
    from lslam.cli.main import COMMANDS as NAMES
    from lslam.cli.main import cli

    known = {"--help", "--version", "--nworkers", "--nthreads", "--no-compile", "--file"}
    # Of `dask worker`, `pip install` and `pyproj sync`.
    for command_name in NAMES:
        command = cli.get_command(click.Context(cli), command_name)
        assert command is not None
        inner = list(command.commands.values()) if isinstance(command, click.Group) else []
        known |= {o for c in [command, *inner] for p in c.params for o in p.opts + p.secondary_opts}
    assert set(re.findall(r"(?<![\w-])--[a-z][\w-]+", shown.text)) <= known


def test_configuration_keys_exist() -> None:
    from lslam.core.config import load_config
    from lslam.simulation.scenario_files import find_scenario

    lines = [line for shown in PAGES for line in shown.shell_lines()]
    # Of `simulate` they are a scenario's.
    settings = re.findall(r"--set (\S+)", "\n".join(line for line in lines if not line.startswith("lslam simulate")))
    simulated = [line for line in lines if line.startswith("lslam simulate") and "--set" in line]
    assert simulated
    for line in simulated:
        find_scenario(line.split()[2], re.findall(r"--set (\S+)", line))
    assert settings
    load_config(None, settings, {})
    variables = {name for shown in PAGES for name in re.findall(r"LSLAM_[A-Z_]+", shown.text)} - {"LSLAM_DATA"}
    assert variables
    for name in variables:
        section, _, key = name.removeprefix("LSLAM_").lower().partition("_")
        assert key in type(getattr(load_config(), section)).model_fields


def test_keys_in_the_text_exist() -> None:
    from lslam.core.config.config import Config

    sections = {name: type(getattr(Config(), name)) for name in Config.model_fields}
    files = ("csv", "html", "json", "laz", "md", "npz", "ply", "py", "toml", "txt")
    # Results speak of keys of the manifest, too.
    for shown in (shown for shown in PAGES if shown.name not in ("docs/results.md", "docs/notes.md")):
        for section, key in re.findall(r"`([a-z]+)\.([a-z_]+)\b(?!\.)[^`]*`", shown.prose):
            if section in sections and key not in files:
                assert key in sections[section].model_fields, f"{shown.name}: {section}.{key}"


def test_sequence_toml_is_understood(tmp_path: Path) -> None:
    from lslam.io.formats.sequence_toml import read_sequence_toml

    (tmp_path / "sequence.toml").write_text(page("README.md").block("toml", "motion_compensated"))
    info = read_sequence_toml(tmp_path / "sequence.toml")
    assert (info.rows, info.cols, info.ground_truth_frame) == (64, 1024, "lidar")


def test_keys_of_sequence_toml_are_all_described() -> None:
    from dataclasses import fields

    from lslam.io.formats.sequence_toml import SequenceInfo

    section = Page("", page("docs/conventions.md").text.split("## `sequence.toml`")[1].split("\n## ")[0])
    named = {name for row in section.rows() for name in re.findall(r"`(\w+)`", row[0])}
    assert {field.name for field in fields(SequenceInfo)} <= named


def test_the_study_is_understood_and_says_what_was_printed() -> None:
    import tomllib

    from lslam.core.config.study import parse_study

    study = parse_study(tomllib.loads(STUDIES.block("toml", "[parameters]")), "commands", "shares")
    assert len(study.points()) == 8
    shown = STUDIES.block("text", "best at")
    assert all(finding.text in shown for finding in study.finding)
    assert {f"{study.methods[0]}+imu", f"{study.beside[0]}+imu"} <= set(shown.split())


@pytest.mark.parametrize("name", ["README.md", "docs/tasks/running.md"])
def test_exit_codes_are_those_of_the_errors(name: str) -> None:
    from lslam.core import errors

    listed = {int(row[0]) for row in page(name).rows() if row[0].isdigit()}
    classes = [c for c in vars(errors).values() if isinstance(c, type) and issubclass(c, errors.LslamError)]
    assert listed == {0} | {c.exit_code for c in classes}


@pytest.mark.parametrize("shown", TASKS, ids=lambda shown: shown.name)
def test_files_in_the_text_exist(shown: Page) -> None:
    for file in re.findall(r"`((?:sample_data|tests)/\S*|LICENSE|CITATION\.cff)`", shown.prose):
        assert (ROOT / file).exists(), file


# -- architecture


def test_files_and_functions_of_the_architecture_exist() -> None:
    files = set(re.findall(r"`((?:lslam|tests)/[\w/.]+)`", ARCHITECTURE.prose))
    assert len(files) > 30
    assert [name for name in sorted(files) if not (ROOT / name).exists()] == []
    answers = [row for row in ARCHITECTURE.rows() if len(row) == 3 and "`lslam/" in row[1]]
    assert len(answers) > 12
    for row in answers:
        paths = [ROOT / name for name in re.findall(r"`(\S+)`", row[1])]
        nodes = [node for path in paths for node in ast.parse(path.read_text(encoding="utf-8")).body]
        names = set(re.findall(r"`([\w.]+)`", row[2]))
        assert names
        defined = set().union(*map(_defined, nodes))
        assert names <= defined, row


def _defined(node: ast.stmt) -> set[str]:
    """What a statement of a module defines: a function, a table, a class and its methods."""
    if isinstance(node, ast.ClassDef):
        return {node.name} | {f"{node.name}.{f.name}" for f in node.body if isinstance(f, ast.FunctionDef)}
    if isinstance(node, ast.Assign):
        return {target.id for target in node.targets if isinstance(target, ast.Name)}
    return {node.name} if isinstance(node, ast.FunctionDef) else set()


def test_layers_of_the_architecture_are_those_that_are_tested() -> None:
    shown = ARCHITECTURE.block("text", "cli\n")
    assert [line.split(" | ") for line in shown.splitlines()] == LAYERS


@pytest.mark.parametrize("name", ["docs/algorithms.md", "docs/conventions.md"])
def test_files_that_a_page_names_exist(name: str) -> None:
    named = re.findall(r"`((?:lslam/)?[a-z]+/[\w/*]+\.py)`", page(name).prose)
    assert named
    assert [file for file in named if not list(PACKAGE.glob(file.removeprefix("lslam/")))] == []


# -- the register of constants

_ROW = re.compile(r"^\| `([\w.]+)` \| (.+?) \| (.*?) \| `(\S+)` \| (.+?) \|$", re.MULTILINE)
REGISTER = [match.groups() for match in _ROW.finditer(METHODS.text.split("## Register of constants")[1])]
# Not quantities: empty arrays, indices, sizes, keys and marks.
MARKS = {
    "ORDER",
    "YAW_SCALE",
    "YAW_OFFSET",
    "OFFSET_S",
    "SHARED",
    "STATE_SIZE",
    "PLANE_SIZE",
    "EVERYWHERE",
    "NO_TIMES",
    "PLANAR",
    "FIX_NOISE",
    "GRAVITY_KEY",
    "SPEED_KEY",
    "BIAS_KEY",
    "STATE",
    "FREE",
    "EMPTY",
    "BLOB",
    "USED",
    "FREED",
    "HAND",
    "LIVE",
    "FACTORS",
    "NO_RING",
    "MOUNTING",
    "GRAVITY",
    "PLACE_NOISE",
    "TURN_NOISE",
    "MAY_BE_EDGE",
    "MAY_BE_FLAT",
    "MAY_BE_PLANE",
    "EDGE",
    "LESS_EDGE",
    "NEITHER",
    "LESS_PLANE",
    "PLANE",
    "NO_LINE",
    "INFORMATION",
    "SQUARED",
    "INLIERS",
    "MATCHED",
    "LEVER",
    "ROBUST",
    "POPULATION",
    "COUNT",
}
SECTIONS = ("preprocess", "registration", "recovery", "keyframes", "loops", "graph")
HELD = ("registration", "backend/loops", "backend/graph", "odometry", "odometry/integrity")


def file_of(section: Any) -> str:
    """Of a section of the configuration, from the package: `core/config/input.py`."""
    return type(section).__module__.removeprefix("lslam.").replace(".", "/") + ".py"


def value_in_code(name: str, file: str) -> Any:
    if file.startswith("core/config/"):
        from lslam.core.config.config import Config

        section, key = name.split(".")
        assert file == file_of(getattr(Config(), section))
        return getattr(getattr(Config(), section), key)
    value: Any = import_module("lslam." + file.removesuffix(".py").replace("/", "."))
    for part in name.split("."):
        value = getattr(value, part)
    return value


@pytest.mark.parametrize(("name", "stated", "unit", "file", "why"), REGISTER, ids=[f"{r[3]} {r[0]}" for r in REGISTER])
def test_the_register_says_what_the_code_says(name: str, stated: str, unit: str, file: str, why: str) -> None:
    value = value_in_code(name, file)
    assert why
    if stated == "absent":
        assert value is None
        return
    numbers = np.array([float(part) for part in stated.split(",")])
    if unit.startswith("deg") and "deg" not in name.lower():
        numbers = np.radians(numbers)
    found = np.asarray(value, float)
    np.testing.assert_allclose(
        np.ravel(np.diag(found) if found.shape in ((3, 3), (6, 6)) else found), numbers, rtol=1e-5
    )


def constants_of(path: Path) -> set[str]:
    """Names in capitals that a module, or a class in it, gives a number or a few."""
    module = import_module("lslam." + ".".join(path.relative_to(PACKAGE).with_suffix("").parts))
    found = set()
    tree = ast.parse(path.read_text(encoding="utf-8"))
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    owners = [("", module, tree.body), *((f"{c.name}.", getattr(module, c.name), c.body) for c in classes)]
    for prefix, owner, body in owners:
        for node in body:
            targets = node.targets if isinstance(node, ast.Assign) else []
            for target in [e for t in targets for e in (t.elts if isinstance(t, ast.Tuple) else [t])]:
                if (
                    not isinstance(target, ast.Name)
                    or not target.id.isupper()
                    or target.id in MARKS
                    or target.id.startswith("_")
                ):
                    continue
                value = getattr(owner, target.id)
                if isinstance(value, (int, float, tuple, np.ndarray)) and np.asarray(value).dtype.kind in "if":
                    found.add(prefix + target.id)
    return found


def test_no_constant_is_missing_in_the_register() -> None:
    from lslam.core.config.config import Config

    listed = {(file, name) for name, _, _, file, _ in REGISTER}
    files = {path for package in HELD for path in (PACKAGE / package).glob("*.py")}
    files |= {PACKAGE / file for file, _ in listed if not file.startswith("core/config/")}
    held = {(path.relative_to(PACKAGE).as_posix(), name) for path in files for name in constants_of(path)}
    for section in SECTIONS:
        model = getattr(Config(), section)
        for key, field in type(model).model_fields.items():
            if re.search(r"\b(int|float)\b", str(field.annotation)):
                held.add((file_of(model), f"{section}.{key}"))
    assert sorted(held - listed) == []


# -- the bibliography


def test_every_paper_that_code_cites_is_in_the_bibliography() -> None:
    papers = METHODS.text.split("## Bibliography")[1]
    cited = re.compile(r"\b([A-Z][a-z]{2,})(?: et al\.?| and [A-Z][a-z]+)?,? \(?(?:[A-Z]{4} )?((?:19|20)\d\d)\b")
    no_authors = {"ECMR", "Padua", "Milano"}
    missing = set()
    for path in PACKAGE.rglob("*.py"):
        text = re.sub(r"\s+(#\s*)?", " ", path.read_text(encoding="utf-8"))
        for author, year in cited.findall(text):
            if author not in no_authors and not re.search(rf"{author}\b[^\n]*\b{year}", papers):
                missing.add(f"{path.relative_to(ROOT)}: {author} {year}")
    assert sorted(missing) == []


def test_both_theses_stand_with_their_titles() -> None:
    papers = METHODS.text.split("## Bibliography")[1]
    assert re.search(r"Girolimetto.*\*.+\*", papers)
    assert re.search(r"Del Tufo.*\*.+\*", papers)
