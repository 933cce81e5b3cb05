"""docs/first_steps.ipynb runs from its first cell to its last, and shows what it speaks of."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).resolve().parents[1] / "docs" / "first_steps.ipynb"


@pytest.fixture(scope="module")
def cells() -> list[Any]:
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells), "it is kept without results"
    # One cell that fails raises, with its traceback.
    NotebookClient(
        notebook, timeout=120, kernel_name="python3", resources={"metadata": {"path": NOTEBOOK.parent}}
    ).execute()
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def shown(cell: Any, kind: str) -> str:
    return "".join(str(out["data"][kind]) for out in cell.outputs if kind in out.get("data", {}))


def test_the_run_shows_its_summary_and_its_trajectory(cells: list[Any]) -> None:
    page = shown(cells[2], "text/html")
    assert "95 of 95 registered" in page
    assert "data:image/svg+xml;base64," in page


def test_figures_are_pictures_and_numbers_are_numbers(cells: list[Any]) -> None:
    assert shown(cells[3], "image/png")
    assert "95 poses" in "".join(out.get("text", "") for out in cells[3].outputs)
    scores = eval(shown(cells[4], "text/plain"))
    assert 0.1 < scores["se3"] < scores["origin"]
    assert float(shown(cells[5], "text/plain").split("(")[-1].rstrip(")")) < 0.05


def test_a_comparison_shows_its_table(cells: list[Any]) -> None:
    page = shown(cells[6], "text/html")
    assert "gicp" in page
    assert "se3" in page
