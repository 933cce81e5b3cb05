"""Lines of text to numbers, stamps and poses, and back: what all trajectory formats share."""

from __future__ import annotations

import re
from decimal import ROUND_HALF_EVEN, Decimal
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError, cause
from lslam.formats.atomic import atomic_write
from lslam.geometry import se3, so3

Floats = NDArray[np.float64]
LARGEST_NS = 2**62


class Row(NamedTuple):
    """One line that carries data: its number in the file, from 1, and its text."""

    number: int
    text: str


def read_rows(path: Path) -> tuple[list[Row], list[str]]:
    """Data lines and comment lines (with `#`) of a text file; InputError when it cannot be read as text."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path} does not exist") from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is not a text file: a trajectory or a table of times is expected") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {cause(error)}") from None
    rows, comments = [], []
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        if stripped.startswith("#"):
            comments.append(stripped)
        elif stripped:
            rows.append(Row(number, stripped))
    return rows, comments


def numbers(rows: list[Row], columns: int, path: Path, what: str, separator: str | None = None) -> Floats:
    """(N, columns) float64 of the first `columns` fields; InputError with the line that is short, no number or not finite.

    `separator` None means white space, and then lines that are too long are wrong too.
    """
    table = []
    for row in rows:
        fields = row.text.split(separator)
        if len(fields) < columns or (separator is None and len(fields) > columns):
            raise InputError(f"{path}, line {row.number}: {len(fields)} columns where {what} has {columns}")
        try:
            table.append([float(field) for field in fields[:columns]])
        except ValueError:
            raise InputError(f"{path}, line {row.number}: not a number in {row.text[:60]!r}") from None
    values = np.array(table, np.float64).reshape(len(rows), columns)
    check_finite(values, rows, path)
    return values


def check_finite(values: Floats, rows: list[Row], path: Path) -> None:
    """InputError with the first line that holds NaN or infinity."""
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise InputError(f"{path}, line {rows[bad[0]].number}: NaN or infinity; remove that pose")


def check_increasing(stamps_ns: NDArray[np.int64], rows: list[Row], path: Path) -> None:
    """InputError with the first line whose stamp is not after the one before."""
    wrong = np.flatnonzero(np.diff(stamps_ns) <= 0)
    if len(wrong):
        i = int(wrong[0]) + 1
        now, before = seconds_text(int(stamps_ns[i])), seconds_text(int(stamps_ns[i - 1]))
        how = "repeats the stamp of the line before" if now == before else f"goes back in time from {before} s"
        raise InputError(f"{path}, line {rows[i].number}: {now} s {how}; sort the poses and keep one per stamp")


def seconds_to_ns(text: str, path: Path, line: int, scale: int = 1_000_000_000) -> int:
    """Exact integer ns of a decimal number in a unit of `scale` ns (seconds by default)."""
    try:
        value = Decimal(text) * scale
        is_finite = value.is_finite()
        # Compared before it becomes an integer: 1e999999 would have a million digits.
        if is_finite and abs(value) <= LARGEST_NS:
            return int(value.to_integral_value(ROUND_HALF_EVEN))
    except (ArithmeticError, ValueError):
        is_finite = False
    if not is_finite:
        raise InputError(f"{path}, line {line}: {text!r} is no time")
    raise InputError(f"{path}, line {line}: time {text} is out of range (seconds expected)")


def seconds_text(stamp_ns: int) -> str:
    """Seconds with 9 decimals, by integers only.

    >>> seconds_text(1317042272349659964)
    '1317042272.349659964'
    """
    whole, rest = divmod(abs(stamp_ns), 1_000_000_000)
    return f"{'-' if stamp_ns < 0 else ''}{whole}.{rest:09d}"


def poses_from_quaternions(t: Floats, q: Floats, rows: list[Row], path: Path) -> Floats:
    """(N, 4, 4) from positions and quaternions xyzw; InputError with the line of a quaternion far from unit length."""
    length = np.linalg.norm(q, axis=1)
    wrong = np.flatnonzero(np.abs(length - 1) > 0.05)
    if len(wrong):
        i = int(wrong[0])
        raise InputError(
            f"{path}, line {rows[i].number}: quaternion of length {length[i]:.3g}, a rotation has length 1"
        )
    return se3.make(so3.from_quaternion(q), t)


def frame_in(comments: list[str]) -> str | None:
    """The frame that a comment states as `frame: NAME`, or None."""
    for comment in comments:
        found = re.search(r"(?<![A-Za-z_])frame\s*[:=]\s*([A-Za-z_]\w*)", comment)
        if found:
            return found.group(1)
    return None


def write_lines(path: str | Path, lines: list[str]) -> None:
    """Write a text file, atomically; names that are no text are escaped."""
    with atomic_write(Path(path)) as stream:
        stream.writelines(f"{line}\n".encode("utf-8", "backslashreplace") for line in lines)
