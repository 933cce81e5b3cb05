"""Two tiers: `python -m pytest` runs what is quick, `python -m pytest -m slow` the rest; files that are named run whole.

slow_tests.txt lists the functions one example of which takes `SLOW_S` or more of a core alone, with all that its fixtures make.
`python -m pytest -m "" --time-tests` writes it anew. `@pytest.mark.slow` and `@pytest.mark.quick` say it by hand.
"""

from __future__ import annotations

import resource
import time
from collections import Counter
from collections.abc import Generator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pytest

SLOW_S = 0.5
COST = "core_s"
USUAL_S = 0.03  # of a test that the table does not list
ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "tests" / "slow_tests.txt"


def read_table() -> dict[str, float]:
    """Seconds by function, `tests/room/test_x.py::test_y`."""
    rows = [line.split() for line in TABLE.read_text().splitlines() if not line.startswith("#")]
    return {function: float(seconds) for seconds, function in rows}


def write_table(costs: Mapping[str, float]) -> None:
    """Functions that cost `SLOW_S` or more, by name."""
    head = '# Core seconds of the slowest example; written by `python -m pytest -m "" --time-tests`, read by tests/tiers.py.\n'
    TABLE.write_text(head + "".join(f"{costs[name]:.1f} {name}\n" for name in sorted(costs) if costs[name] >= SLOW_S))


def function_of(nodeid: str) -> str:
    """Node id without the name of the example."""
    return nodeid.partition("[")[0]


def is_there(function: str) -> bool:
    """Whether its file has such a function."""
    path, _, name = function.partition("::")
    return (ROOT / path).is_file() and f"\ndef {name}(" in (ROOT / path).read_text()


@cache
def slow_files(root: Path) -> frozenset[Path]:
    """Files that have a slow test."""
    files = {root / function.partition("::")[0] for function in read_table()}
    return frozenset(files | {path for path in (root / "tests").rglob("test_*.py") if "mark.slow" in path.read_text()})


def is_passed_over(path: Path, config: pytest.Config) -> bool:
    """Whether a file need not be imported: nothing in it is slow, and nothing else is asked for."""
    is_test = path.name.startswith("test_") and path.suffix == ".py"
    return config.option.markexpr == "slow" and is_test and path not in slow_files(ROOT)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    return True if is_passed_over(collection_path, config) else None


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.getgroup("tiers").addoption("--time-tests", action="store_true", help=f"write {TABLE.name} anew")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "slow: not in the fast tier")
    config.addinivalue_line("markers", "quick: in the fast tier, whatever the table says: the one test of its kind")
    is_named = config.args_source is pytest.Config.ArgsSource.ARGS
    if not (config.option.markexpr or is_named or config.option.time_tests):
        config.option.markexpr = "not slow"
    config.option.loadscopereorder = False  # xdist keeps the order of `LongestFirst`
    config.pluginmanager.register(LongestFirst(), "longest-first")
    if config.option.time_tests:
        config.pluginmanager.register(Clock(config), "clock")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what the table lists, before `-m` is asked."""
    listed = read_table()
    for item in items:
        if function_of(item.nodeid) in listed and not item.get_closest_marker("quick"):
            item.add_marker("slow")


class LongestFirst:
    """Orders files by what they take, so that no worker is left alone with a long one at the end."""

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Sort what `-m` has left; within a file the order stays."""
        listed, costs = read_table(), Counter[Path]()
        for item in items:
            costs[item.path] += listed.get(function_of(item.nodeid), USUAL_S)  # type: ignore[assignment]
        items.sort(key=lambda item: -costs[item.path])


def cpu_s() -> float:
    """Seconds of a core that this process took, and those that it started and that have ended."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


class Clock:
    """Times what each example takes alone: fixtures of a module or session count for each test that asks for them."""

    def __init__(self, config: pytest.Config) -> None:
        self._is_worker = hasattr(config, "workerinput")
        self._fixtures: dict[tuple[str, str], float] = {}
        self._costs: dict[str, float] = {}

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any, request: Any) -> Generator[None, Any, Any]:
        """What a fixture asks for by name has been set up before it."""
        begin = cpu_s()
        made = yield
        self._fixtures[request.node.nodeid, fixturedef.argname] = cpu_s() - begin
        return made

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Function) -> Generator[None, None, None]:
        """Send the seconds with the report."""
        begin = cpu_s()
        yield
        asked = [(node.nodeid, name) for node in item.listchain() for name in item.fixturenames]
        cost = cpu_s() - begin + sum(self._fixtures.get(key, 0.0) for key in asked)
        item.user_properties.append((COST, cost))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Keep the slowest example of each function."""
        sent = dict(report.user_properties)
        if report.when == "call" and COST in sent:
            name = function_of(report.nodeid)
            cost = 0.0 if "quick" in report.keywords else float(str(sent[COST]))
            self._costs[name] = max(cost, self._costs.get(name, 0.0))

    def pytest_sessionfinish(self) -> None:
        """Write the table; what did not run stays as it was."""
        if not self._is_worker:
            before = {name: cost for name, cost in read_table().items() if is_there(name)}
            write_table({**before, **self._costs})
