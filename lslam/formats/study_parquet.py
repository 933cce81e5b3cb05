"""results.parquet: the table of results.csv with its types, for pandas, Polars, DuckDB and R."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lslam.formats.atomic import atomic_write
from lslam.formats.study_csv import study_columns
from lslam.printable import printable_tree
from lslam.types.study import StudyRow, Value


def write_study_parquet(path: Path, rows: Sequence[StudyRow]) -> None:
    """Write all rows atomically, what is not there as null; a parameter of several types becomes text. Raises OutputError."""
    import pyarrow as pa
    from pyarrow import parquet

    table = pa.table(
        {name: pa.array(printable_tree(_of_one_type(column))) for name, column in study_columns(rows).items()}
    )
    with atomic_write(path) as stream:
        parquet.write_table(table, stream)


def _of_one_type(column: list[Value | None]) -> list[Value | None]:
    kinds = {type(value) for value in column if value is not None}
    if len(kinds) < 2:
        return column
    if kinds == {int, float}:
        return [None if value is None else float(value) for value in column]
    return [None if value is None else str(value) for value in column]
