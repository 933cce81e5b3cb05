"""The two tiers: what is listed exists, each room keeps quick tests, and a command selects the tier that it says."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from textwrap import dedent

import pytest
import tiers

LISTED = tiers.read_table()
QUICK_MARK = re.compile(r"^@pytest\.mark\.quick\n(?:[@ )\]].*\n)*def (\w+)\(", re.MULTILINE)


def called_quick(path: str) -> set[str]:
    """The functions of a file that are marked as quick by hand."""
    return set(QUICK_MARK.findall((tiers.ROOT / path).read_text()))


def test_what_is_listed_exists_and_is_not_called_quick() -> None:
    assert [function for function in LISTED if not tiers.is_there(function)] == []
    called = {path: called_quick(path) for path in {function.partition("::")[0] for function in LISTED}}
    assert [f for f in LISTED if f.partition("::")[2] in called[f.partition("::")[0]]] == []
    assert list(LISTED) == sorted(LISTED)
    assert min(LISTED.values()) >= tiers.SLOW_S


def test_each_room_keeps_quick_tests() -> None:
    rooms: dict[Path, set[str]] = {}
    for path in (tiers.ROOT / "tests").rglob("test_*.py"):
        names = re.findall(r"^def (test_\w+)", path.read_text(), re.MULTILINE)
        rooms.setdefault(path.parent, set()).update(f"{path.relative_to(tiers.ROOT).as_posix()}::{n}" for n in names)
    assert [room.name for room, functions in rooms.items() if not functions - LISTED.keys()] == []


ADDOPTS = "-q --import-mode importlib -p no:xdist -p no:cacheprovider -p no:dash"
Ran = Callable[..., set[str]]


@pytest.fixture
def ran(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Ran:
    """`ran(*words)`: the tests that a command runs in a folder of six."""
    (tmp_path / "pytest.ini").write_text(f"[pytest]\ntestpaths = tests\naddopts = {ADDOPTS}\n")
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "test_a.py").write_text(
        dedent("""
        import time, pytest
        @pytest.fixture(scope="module")
        def made():
            end = time.process_time() + 0.06
            while time.process_time() < end: pass
        @pytest.mark.parametrize("k", [1, 2])
        def test_listed(k): pass
        @pytest.mark.slow
        def test_by_hand(): pass
        @pytest.mark.quick
        def test_quick(made): pass
        def test_first(made): pass
        def test_second(made): pass
        def test_third(): pass
        """)
    )
    table = tmp_path / "tests" / "table.txt"
    table.write_text(
        "2.0 tests/test_a.py::test_listed\n2.0 tests/test_a.py::test_quick\n3.0 tests/test_a.py::test_gone\n"
    )
    monkeypatch.setattr(tiers, "TABLE", table)
    monkeypatch.setattr(tiers, "ROOT", tmp_path)
    monkeypatch.setattr(tiers, "SLOW_S", 0.05)
    monkeypatch.chdir(tmp_path)

    def run(*words: str) -> set[str]:
        seen = set[str]()

        class Names:
            def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
                seen.add(tiers.function_of(report.nodeid).partition("::test_")[2])

        assert pytest.main([*words], plugins=[tiers, Names()]) == pytest.ExitCode.OK
        return seen

    return run


QUICK = {"quick", "first", "second", "third"}
ALL = QUICK | {"listed", "by_hand"}


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ((), QUICK),
        (("-m", "slow"), ALL - QUICK),
        (("tests/test_a.py",), ALL),
        (("tests",), ALL),
        (("-k", "hand or third"), {"third"}),
    ],
)
def test_a_command_selects_its_tier(words: tuple[str, ...], expected: set[str], ran: Ran) -> None:
    assert ran(*words) == expected


def test_the_table_counts_a_shared_fixture_for_each_that_asks_for_it(ran: Ran) -> None:
    assert ran("--time-tests") == ALL
    assert tiers.read_table().keys() == {"tests/test_a.py::test_first", "tests/test_a.py::test_second"}
