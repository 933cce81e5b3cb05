"""Grids of texts as Markdown, CSV, LaTeX and aligned lines; the first row is the header. None ends with a line break."""

from __future__ import annotations

import csv
import io

Grid = list[list[str]]


def markdown(grid: Grid, names: int = 1) -> str:
    """A Markdown table; the first `names` columns are set flush left, the others right."""
    head, *body = [[cell.strip().replace("|", "\\|") for cell in row] for row in grid]
    rule = ["---"] * names + ["---:"] * (len(head) - names)
    return "\n".join(f"| {' | '.join(row)} |" for row in [head, rule, *body])


def comma_separated(grid: Grid, _: int = 1) -> str:
    """CSV as spreadsheets read it."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows([[cell.strip() for cell in row] for row in grid])
    return out.getvalue().rstrip("\n")


def latex(grid: Grid, names: int = 1) -> str:
    """A LaTeX tabular that needs no package."""
    head, *body = [" & ".join(_escaped(cell) for cell in row) + r" \\" for row in grid]
    columns = "l" * names + "r" * (len(grid[0]) - names)
    return "\n".join(
        [rf"\begin{{tabular}}{{{columns}}}", r"\hline", head, r"\hline", *body, r"\hline", r"\end{tabular}"]
    )


def aligned(grid: Grid, names: int = 1) -> str:
    """Columns of equal width, two spaces between them."""
    widths = [max(len(cell) for cell in column) for column in zip(*grid, strict=True)]
    return "\n".join(
        "  ".join(f"{c:<{w}}" if k < names else f"{c:>{w}}" for k, (c, w) in enumerate(zip(row, widths, strict=True)))
        .rstrip()
        for row in grid
    )  # fmt: skip


def _escaped(cell: str) -> str:
    signs = {sign: f"\\{sign}" for sign in "&%$#_{}"} | {"\\": "\\textbackslash{}"}
    cell = cell.translate({ord(sign): word for sign, word in signs.items()})
    return cell.strip().replace("±", "$\\pm$")
