"""Tables that know their age: code that a benchmark reaches makes its table old, comments and other code do not."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests" / "benchmarks"))

import ages  # noqa: E402
from ages import Ages  # noqa: E402
from code_digest import Code  # noqa: E402

COMMAND = "python tests/benchmarks/bench.py --seeds 100-104"
FILES = {
    "lslam/__init__.py": 'LAZY = {"run": ("lslam.pipeline.run", "run")}\n',
    "lslam/pipeline/__init__.py": "",
    "lslam/pipeline/run.py": "from lslam.methods import METHODS\nfrom lslam.reports import html\n",
    "lslam/methods/__init__.py": 'METHODS = {"icp": "lslam.methods.icp", "loam": "lslam.methods.loam:create"}\n',
    "lslam/methods/icp.py": '"""ICP."""\n\n\ndef step(a: float) -> float:\n    """Halve."""\n    return a / 2\n',
    "lslam/methods/loam.py": "STEP = 1\n",
    "lslam/reports/__init__.py": "",
    "lslam/reports/html.py": "WIDTH = 1\n",
    "lslam/studies/__init__.py": "SIZE = 1\n",
    "lslam/scenes/town.toml": "lanes = 2\n",
    "lslam/scenes/town-hard.toml": 'base = "town"\n',
    "lslam/scenes/room.toml": "walls = 4\n",
    "tests/benchmarks/bench.py": "from helper import half\nimport lslam\n\nlslam.run('town-hard')\n",
    "tests/helper.py": "half = 0.5\n",
    "docs/results.md": f"<!-- table a -->\n```bash\n{COMMAND}\n```\n\n"
    "Of seeds 100 to 104,\nm.\n\n| x |\n|---|\n| 1 |\n<!-- end -->\n",
}


@pytest.fixture
def house(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A package, a benchmark and its table, written now; the run had loaded one of two methods."""
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    loaded = {"lslam", "lslam.pipeline", "lslam.pipeline.run", "lslam.methods", "lslam.methods.icp"}
    monkeypatch.setattr(sys, "modules", dict(sys.modules) | dict.fromkeys(loaded))
    monkeypatch.setattr(ages, "STARTED_S", time.time() + 60)
    Ages(tmp_path).stamp("a", COMMAND, tmp_path / "docs" / "results.md")
    assert not Ages(tmp_path).stale()
    return tmp_path


def becomes_stale(house: Path, name: str, old: str, new: str) -> bool:
    text = (house / name).read_text()
    assert old in text
    (house / name).write_text(text.replace(old, new))
    return bool(Ages(house).stale())


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("lslam/methods/icp.py", "a / 2", "a / 3"),
        ("lslam/pipeline/run.py", "METHODS\n", "METHODS as KNOWN\n"),
        ("lslam/scenes/town.toml", "2", "3"),
        ("tests/helper.py", "0.5", "0.4"),
        ("tests/benchmarks/bench.py", "'town-hard'", "'town-hard', 2"),
        ("docs/results.md", "100-104", "100-105"),
    ],
)
def test_what_a_benchmark_depends_on_makes_its_table_old(house: Path, name: str, old: str, new: str) -> None:
    assert becomes_stale(house, name, old, new)


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("lslam/methods/icp.py", "return a / 2", "# A comment.\n    return (\n        a / 2\n    )"),
        ("lslam/methods/icp.py", "Halve.", "Take half."),
        ("lslam/methods/icp.py", '"""ICP."""', '"""Points."""'),
        ("lslam/methods/loam.py", "1", "2"),
        ("lslam/studies/__init__.py", "1", "2"),
        ("lslam/reports/html.py", "1", "2"),
        ("lslam/scenes/town.toml", "lanes = 2", "lanes = 2  # Each way."),
        ("lslam/scenes/room.toml", "4", "5"),
        ("docs/results.md", "| 1 |", "|  1  |"),
    ],
)
def test_comments_and_what_it_does_not_use_leave_a_table_as_it_is(house: Path, name: str, old: str, new: str) -> None:
    assert not becomes_stale(house, name, old, new)


def test_what_runs_in_processes_of_its_own_may_have_used_all_methods(house: Path) -> None:
    (house / "tests" / "helper.py").write_text("import subprocess\n\nhalf = 0.5\n")
    Ages(house).stamp("a", COMMAND, house / "docs" / "results.md")
    assert becomes_stale(house, "lslam/methods/loam.py", "1", "2")


def test_a_campaign_depends_on_the_whole_package(house: Path) -> None:
    (house / "tests" / "kills").mkdir()
    (house / "tests" / "kills" / "__main__.py").write_text("")
    reach = Code(house).reach("python -m tests.kills --count 3  # in CI fewer")
    assert "lslam.studies" in reach
    assert "lslam.reports.html" not in reach


def test_code_that_changes_while_it_is_measured_was_not_measured(house: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ages, "STARTED_S", time.time() - 60)
    Ages(house).stamp("a", COMMAND, house / "docs" / "results.md")
    assert "a" in Ages(house).stale()


def test_a_mark_comes_and_goes_with_the_age_and_names_the_commit_and_the_modules(house: Path) -> None:
    def git(*words: str) -> str:
        who = ("-c", "user.name=A", "-c", "user.email=a@b")
        return subprocess.run(["git", *who, *words], cwd=house, check=True, capture_output=True, text=True).stdout

    git("init", "-q")
    git("add", ".")
    git("commit", "-q", "-m", "Measure")
    page = house / "docs" / "results.md"
    assert Ages(house).mark() == []
    assert becomes_stale(house, "lslam/methods/icp.py", "a / 2", "a / 3")
    assert Ages(house).wrongly_marked() == ["a"]
    git("commit", "-q", "-a", "-m", "Change")
    first = git("log", "--format=%h", "--abbrev=8").split()[-1]
    assert Ages(house).mark() == ["a"]
    assert f"\nOf seeds 100 to 104,\nm.\nMeasured before the changes since {first}.\n\n| x |" in page.read_text()
    assert Ages(house).wrongly_marked() == Ages(house).mark() == []
    table, entry = Ages(house).tables()["a"], Ages(house).entries()["a"]
    assert Ages(house).changes(table, entry) == ["lslam.methods.icp"]
    becomes_stale(house, "lslam/methods/icp.py", "a / 3", "a / 2")
    assert Ages(house).wrongly_marked() == ["a"]
    assert Ages(house).mark() == ["a"]
    assert page.read_text() == FILES["docs/results.md"]


def test_a_table_of_which_nothing_is_kept_is_marked_and_one_made_by_hand_is_kept(house: Path) -> None:
    page, kept = house / "docs" / "results.md", Ages(house)
    kept.keep({})
    subprocess.run(["git", "init", "-q"], cwd=house, check=True)
    who = ("-c", "user.name=A", "-c", "user.email=a@b")
    subprocess.run(["git", *who, "commit", "-q", "--allow-empty", "-m", "Begin"], cwd=house, check=True)
    assert kept.mark() == ["a"]
    ages.main(["--made", "a"], root=house)
    assert Ages(house).mark() == ["a"]
    assert page.read_text() == FILES["docs/results.md"]
    assert Ages(house).entries()["a"].unused == []
    with pytest.raises(SystemExit, match="no document has a table b"):
        ages.main(["--made", "b"], root=house)


def test_cheap_tables_are_renewed_first_and_none_that_costs_too_much(
    house: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page, kept = house / "docs" / "results.md", Ages(house)
    bench = "import sys\nfrom pathlib import Path\n\nwith Path('order.txt').open('a') as file:\n    file.write(sys.argv[1])\n"
    entry, entries = kept.entries()["a"], {}
    for name, cost_s in (("b", 5.0), ("c", 1.0), ("d", 1e4)):
        (house / "tests" / "benchmarks" / f"{name}.py").write_text(bench)
        command = f"python tests/benchmarks/{name}.py {name}"
        page.write_text(
            page.read_text() + FILES["docs/results.md"].replace("table a", f"table {name}").replace(COMMAND, command)
        )
        entries[name] = ages.Entry("other", entry.commit, cost_s, [])
    kept.keep({"a": entry} | entries)
    ages.main(["--rerun", "--budget", "1"], root=house)
    assert (house / "order.txt").read_text() == "cb"
    assert "d: costs 10000.0 s" in capsys.readouterr().out


def test_folders_of_recordings_are_given_and_what_wants_a_hand_is_left() -> None:
    def words(command: str, recordings: Path | None = Path("data")) -> list[str] | None:
        return ages.arguments(f"python tests/benchmarks/{command}", "scratch", recordings)

    assert words("a.py FOLDER --seeds 1") == ["tests/benchmarks/a.py", "data", "--seeds", "1"]
    assert words("a.py --runs FOLDER  # note", None) == ["tests/benchmarks/a.py", "--runs", "scratch"]
    assert words("a.py FOLDER", None) is None
    assert words("a.py FOLDER FOLDER") is None
    assert ages.arguments("python -m tests.kills", "scratch", None) is None


@pytest.mark.quick
def test_every_table_is_as_old_as_it_says() -> None:
    wrong = Ages().wrongly_marked()
    assert not wrong, "code changed: `python tests/benchmarks/ages.py --mark`, or `--rerun`"
