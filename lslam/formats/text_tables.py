"""Tables of text: rows of cells between commas, semicolons, tabs or blanks, with or without names of the columns."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.formats.pose_rows import Row, date_to_ns

_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
_DATE_AND_TIME = re.compile(r"(\d{4}-\d\d-\d\d) (\d\d:\S+)")
# What tools write where a number is missing.
_MISSING = frozenset(("", "nan", "+nan", "-nan", "null", "none", "na", "n/a", "<na>"))


@dataclass(frozen=True)
class TextTable:
    """Cells of a text file.

    names : (K,) of the columns as the file has them, empty without a header; rows : (N,) lines; cells : (N,) lists of cells
    separator : between cells, None for blanks
    """

    path: Path
    names: tuple[str, ...]
    rows: list[Row]
    cells: list[list[str]]
    separator: str | None

    def numbers(self, column: int) -> NDArray[np.float64]:
        """(N,) float64 of a column, dates in seconds, NaN for what is no number or not there."""
        return np.array([_number(cells[column]) if column < len(cells) else np.nan for cells in self.cells], np.float64)

    def values(self, columns: list[int]) -> NDArray[np.float64]:
        """(N, K) float64 of columns, NaN where a number is missing; InputError with the line of a cell that is text."""
        values = np.empty((len(self.rows), len(columns)))
        for i, (row, cells) in enumerate(zip(self.rows, self.cells, strict=True)):
            try:
                values[i] = [float("nan") if cells[c].lower() in _MISSING else float(cells[c]) for c in columns]
            except ValueError:
                raise InputError(f"{self.path}, line {row.number}: not a number in {row.text[:60]!r}") from None
        return values

    def check_widths(self, width: int, whose: str, is_least: bool = False) -> None:
        """InputError with the line that is not as wide as `whose` width; wider ones pass where it is the least."""
        for row, cells in zip(self.rows, self.cells, strict=True):
            if len(cells) < width or (len(cells) > width and not is_least):
                raise InputError(f"{self.path}, line {row.number}: {len(cells)} columns where {whose} has {width}")

    def select(self, mask: NDArray[np.bool_]) -> TextTable:
        """The rows where `mask` (N,) is true."""
        kept = np.flatnonzero(mask).tolist()
        return replace(self, rows=[self.rows[i] for i in kept], cells=[self.cells[i] for i in kept])


def looks_like_header(line: str) -> bool:
    """Whether `line` begins with a name, or is empty before one (the index of pandas), and holds no number or date."""
    cells = split_cells(line.strip(), separator_of(line.strip()))
    name = next(filter(None, cells[:2]), "")
    is_name = re.match(r"[A-Za-z_/]|\.[A-Za-z]", name) is not None and name.lower() not in ("nan", "inf", "infinity")
    return is_name and not np.isfinite([_number(cell) for cell in cells]).any()


def shortened(names: list[str]) -> str:
    """The names between commas, no more than six of them.

    >>> shortened(list("abcdefgh"))
    'a, b, c, d, e, f and 2 more'
    """
    return ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")


def separator_of(text: str) -> str | None:
    """What stands between the cells of a line: a semicolon, a tab, a comma, else blanks (None)."""
    return next((s for s in (";", "\t", ",") if s in text), None)


def split_cells(text: str, separator: str | None) -> list[str]:
    """Cells of a line, without quotes; decimal commas become points where cells stand between something else.

    >>> split_cells("1700000000,5; 2", ";"), split_cells("2011-09-26 13:04:32.5 7", None)
    (['1700000000.5', '2'], ['2011-09-26T13:04:32.5', '7'])
    """
    if separator is None:
        text = _DATE_AND_TIME.sub(r"\1T\2", text, count=1)
    cells = [cell.strip().strip("\"'") for cell in text.split(separator)]
    if separator != ",":
        cells = [cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell for cell in cells]
    return cells


def text_table(path: Path, rows: list[Row], comments: list[str]) -> TextTable:
    """The table of the data lines and comments of a file; the names are those of the first line or of a comment as wide."""
    header = ""
    if rows and looks_like_header(rows[0].text):
        header, rows = rows[0].text, rows[1:]
    if not rows:
        header = header or (comments[0].lstrip("#% ") if comments else "")
        return TextTable(path, tuple(split_cells(header, separator_of(header))) if header else (), [], [], None)
    separator = separator_of(rows[0].text)
    cells = [split_cells(row.text, separator) for row in rows]
    names = split_cells(header, separator_of(header)) if header else _names_in(comments, len(cells[0]))
    return TextTable(path, tuple(names), rows, cells, separator)


def _names_in(comments: list[str], width: int) -> list[str]:
    """Names of the columns in the first comment that lists as many as there are; empty without."""
    for comment in comments:
        text = comment.lstrip("#%/ ")
        for separator in (separator_of(text), None):
            names = split_cells(text, separator)
            if len(names) == width > 1 and looks_like_header(text):
                return names
    return []


def _number(text: str) -> float:
    """A number, or a date in seconds since 1970; NaN for anything else."""
    try:
        return float(text)
    except ValueError:
        pass
    try:
        date_ns = date_to_ns(text)
    except ValueError:
        return float("nan")
    return float("nan") if date_ns is None else date_ns * 1e-9
