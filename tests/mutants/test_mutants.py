"""Which changes count as small faults, and that a fault is detected."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from mutants.campaign import drawn, summary
from mutants.sites import Mutant, mutants
from mutants.trial import Copy

SOURCE = '''"""Words."""
from math import pi
LIMIT: int = 12

@cache(3)
def f(x: Literal[1], y=-0.5) -> Literal[2]:
    log.info("%d", 1 + 2)
    if not x or y <= LIMIT:
        raise ValueError(f"{x + 1} of {3 * y}")
    x += min(y, 2) - -(x // 7)
    return cast("Literal[4]", x) if x is not None else (x * 1.0 and y in "é")
'''


def changed(tmp_path: Path) -> list[tuple[int, str, str]]:
    (tmp_path / "f.py").write_text(SOURCE)
    text = SOURCE.encode()
    return [(m.line, text[m.start : m.end].decode(), m.new) for m in mutants(tmp_path, "f.py")]


def test_numbers_operators_conditions_and_choices_change_and_words_and_types_do_not(tmp_path: Path) -> None:
    assert sorted(changed(tmp_path)) == sorted([
        (3, "12", "36"), (3, "12", "4"),
        (6, "-", ""), (6, "0.5", "1.5"), (6, "0.5", "0.16666666666666666"),
        (8, "not x or y <= LIMIT", "False"), (8, "not", ""), (8, "or", "and"), (8, "<=", ">"),
        (10, "+=", "-="), (10, "min", "max"), (10, "2", "3"), (10, "-", "+"), (10, "-", ""), (10, "7", "21"), (10, "7", "2"),
        (11, "x is not None", "not (x is not None)"), (11, "is not", "is"), (11, "and", "or"), (11, "*", "/"),
        (11, "1.0", "0.5"), (11, "1.0", "2.0"), (11, "in", "not in"),
    ])  # fmt: skip


def test_every_mutant_compiles_and_is_another_program(tmp_path: Path) -> None:
    (tmp_path / "f.py").write_text(SOURCE)
    for mutant in mutants(tmp_path, "f.py"):
        text = mutant.of(SOURCE.encode())
        assert text != SOURCE.encode()
        compile(text, "f.py", "exec")


def test_a_mutant_keeps_its_name_when_lines_before_it_change(tmp_path: Path) -> None:
    (tmp_path / "f.py").write_text(SOURCE)
    before = {m.name for m in mutants(tmp_path, "f.py")}
    (tmp_path / "f.py").write_text(SOURCE.replace("LIMIT: int = 12", "LIMIT: int = 34 + 56"))
    after = {m.name for m in mutants(tmp_path, "f.py")}
    assert len(before) == len(changed(tmp_path))
    assert {name.split(":")[1] for name in before - after} == {"LIMIT"}
    assert len(before - after) == 2


def test_a_seed_draws_the_same_mutants_again() -> None:
    first, other = drawn(40, 3, 0.25), drawn(40, 4, 0.25)
    assert first == drawn(40, 3, 0.25)
    assert first != other
    assert sum("/kernels/" in m.file for m in first) == 10


@pytest.mark.parametrize(("new", "is_killed"), [("2", True), ("1.0", False)])
def test_a_mutant_is_killed_by_a_test_that_runs_its_line(tmp_path: Path, new: str, is_killed: bool) -> None:
    (tmp_path / "lslam").mkdir()
    (tmp_path / "tests").mkdir()
    # Without it a regular package of that name, if one is installed, goes first.
    (tmp_path / "lslam" / "__init__.py").touch()
    (tmp_path / "lslam" / "one.py").write_text("def one():\n    return 1\n")
    (tmp_path / "tests" / "test_one.py").write_text(
        "from lslam.one import one\n\ndef test_one():\n    assert one() == 1\n"
    )
    copy = Copy.__new__(Copy)
    copy.root = tmp_path
    covered = {"tests/test_one.py": {"seconds": 0.1, "lines": {"lslam/one.py": [2]}}}
    row = copy.judge(Mutant("lslam/one.py", 2, 2, 22, 23, new, "lslam/one.py:1"), covered)
    assert (row["was"], row["now"], row["is_killed"]) == ("return 1", f"return {new}", is_killed)
    assert row["by"] == ("tests/test_one.py::test_one" if is_killed else "")
    assert (tmp_path / "lslam" / "one.py").read_text() == "def one():\n    return 1\n"
    assert list(summary([row]))[-1] == f"| all | 1 | {int(is_killed)} | {100 * is_killed} % |"
