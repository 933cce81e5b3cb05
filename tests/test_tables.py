"""The documents' tables: each made by a benchmark that is there, on seeds that nothing was designed on, and by its command."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
BENCHMARKS = ROOT / "tests" / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import tables  # noqa: E402

PAGES = ("README.md", "docs/results.md", "docs/theses.md", "docs/notes.md")
DOCUMENTS = {name: (ROOT / name).read_text(encoding="utf-8") for name in PAGES}
BLOCK = re.compile(r"<!-- table (.+?) -->\n(.*?)<!-- end -->", re.DOTALL)
BLOCKS = [(name, *match) for name, text in DOCUMENTS.items() for match in BLOCK.findall(text)]


def bare(text: str) -> str:
    """Without blocks of tables and of code."""
    return re.sub(r"^```.*?^```$", "", BLOCK.sub("", text), flags=re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("name", DOCUMENTS)
def test_every_table_of_measured_numbers_is_made_by_a_benchmark(name: str) -> None:
    # A cell that is a number, or begins with one, outside of all blocks.
    cells = [
        cell.strip() for line in bare(DOCUMENTS[name]).splitlines() if line.startswith("|") for cell in line.split("|")
    ]
    assert [cell for cell in cells if re.match(r"[*-]*\d+\.\d", cell)] == []


@pytest.mark.parametrize(("document", "name", "text"), BLOCKS, ids=[f"{d} {n}" for d, n, _ in BLOCKS])
def test_a_table_names_the_command_that_makes_it(document: str, name: str, text: str) -> None:
    command = re.search(r"```bash\npython (-m )?(\S+)", text)
    assert command is not None
    if command[1]:
        # A campaign, which prints its table itself.
        assert (ROOT / command[2].replace(".", "/") / "__main__.py").is_file()
        return
    source = (ROOT / command[2]).read_text(encoding="utf-8")
    made = re.findall(r"tables\.table\(\s*f?\"([^\"]+)\"", source)
    assert any(re.fullmatch(re.sub(r"\\\{.*?\\\}", ".+", re.escape(one)), name) for one in made)


@pytest.mark.parametrize(("document", "name", "text"), BLOCKS, ids=[f"{d} {n}" for d, n, _ in BLOCKS])
def test_a_table_of_simulations_has_five_fresh_seeds(document: str, name: str, text: str) -> None:
    caption = text.split("```")[2].split("\n|")[0]
    seeds = [(int(a), int(b)) for a, b in re.findall(r"seeds (\d+) to (\d+)", " ".join(caption.split()))]
    is_recorded = re.search(r"KITTI raw 0005, 154|same runs|\d+ (runs|mutants|kills)", caption)
    assert is_recorded or seeds
    assert all(first >= 100 and last - first >= 4 for first, last in seeds)


def test_writing_replaces_one_table_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- table a -->\nold\n<!-- end -->\nbetween\n<!-- table ab -->\nkept\n<!-- end -->\n")
    typed = [str(BENCHMARKS / "gnss.py"), str(tmp_path), "--kinds", "a b", "--write", str(page), "--seeds=1"]
    monkeypatch.setattr(sys, "argv", typed)
    tables.table("a", "Of seeds 1 to 5.", ["x", "y"], [["1", "2"]], page)
    assert page.read_text() == (
        "before\n<!-- table a -->\n```bash\npython tests/benchmarks/gnss.py FOLDER --kinds 'a b' --seeds=1\n```\n\n"
        "Of seeds 1 to 5.\n\n| x | y |\n|---|---|\n| 1 | 2 |\n<!-- end -->\nbetween\n<!-- table ab -->\nkept\n<!-- end -->\n"
    )
    tables.table("a", "Of seeds 1 to 5.", ["x", "y"], [["1", "2"]], page)
    assert page.read_text().count("| 1 | 2 |") == 1
    with pytest.raises(SystemExit, match="no table b"):
        tables.table("b", "", ["x"], [], page)


def test_what_stands_in_a_cell() -> None:
    assert tables.spread([3.0, 1.0, 2.0]) == "2.00 / 3.00"
    assert tables.spread([0.00123, 0.00456, 0.002]) == "0.0020 / 0.0046"
    assert tables.spread([12.345, 250.0, 3.0], 3) == "12.35 / 250.00"
    assert tables.spread([]) == "-"
    assert tables.spread([1.0, float("inf"), 1.0]) == "1.00 / failed"
    assert tables.numbers("100-102,7") == [100, 101, 102, 7]
    assert tables.seeds_named([100, 101, 102]) == "seeds 100 to 102"
    assert tables.seeds_named([3, 5]) == "seeds 3, 5"
