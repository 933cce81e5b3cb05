"""results.csv, one row per run of a study; and the state file of each job, beside its run folder.

The first column is the version of the file. Studied parameters are columns named by their configuration key, `input.skip_frames`;
stages are columns `stage_ms.NAME`. An empty cell is a number that is not there, or a parameter that the run was not given.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, get_args

from lslam.core.config.study import StudyMetric
from lslam.core.errors import InputError, input_errors
from lslam.core.printable import printable_tree
from lslam.core.types.study import StudyRow, Value
from lslam.core.untrusted import MISFIT, parse_json
from lslam.io.formats.atomic import atomic_write, write_text

# What a repetition would end with again; everything else is tried anew.
FINAL = ("done", "degraded", "diverged")


@dataclass(frozen=True)
class State:
    """status : `done`, `degraded`, `diverged`, `interrupted`, `failed` or `crashed`; reason : one sentence, empty when done.

    digest : of the job; jobs : runs that shared the machine; load : of the machine before the first run of the study
    seconds : of the whole run; is_alone : whether it had a core to itself, as far as the study knows; waited : share of the
        seconds in which it had none; machine : name of the host
    """

    digest: str
    status: str
    reason: str = ""
    jobs: int = 1
    load: float = 0.0
    seconds: float = 0.0
    is_alone: bool = True
    waited: float = 0.0
    machine: str = ""


_KINDS: dict[str, Callable[[Any], Any]] = {"str": str, "int": int, "float": float, "bool": bool}


def write_state(path: Path, state: State) -> None:
    """Write the state of a job to its file, atomically; raises OutputError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, json.dumps(asdict(state), indent=1) + "\n")


def read_state(path: Path) -> State | None:
    """The state of a job from its file; None when there is no readable file."""
    try:
        tree = parse_json(path.read_text(encoding="utf-8"))
        return State(**{f.name: _KINDS[str(f.type)](tree[f.name]) for f in fields(State)})
    except (OSError, *MISFIT):
        return None


def is_reusable(path: Path, folder: Path, digest: str) -> bool:
    """Whether the job has finished with the same configuration, input and version, and its folder exists."""
    state = read_state(path)
    return (
        state is not None and state.digest == digest and state.status in FINAL and (folder / "manifest.json").is_file()
    )


VERSION = 3
SCHEMA = "study_version"
STAGE = "stage_ms."
# Columns worked out from the others, for those who read the table elsewhere, and the property of a row that says each.
FROM_OTHERS = {"is_diverged": "diverges", "time_per_scan_ms": "time_per_scan_ms"}
# Python takes `1_000`, `nan` and `inf` for numbers too, and no parameter has such a value: they are words.
_NUMBER = re.compile(r"-?(0|[1-9][0-9]*)(?P<rest>(\.[0-9]+)?([eE][+-]?[0-9]+)?)")
_PLAIN = {f.name: str(f.type) for f in fields(StudyRow) if f.name not in ("parameters", "stages_ms")}


def study_columns(rows: Sequence[StudyRow]) -> dict[str, list[Value | None]]:
    """Columns of the table by name, parameters after `method` and stages last; None where a cell is empty."""
    parameters = list(dict.fromkeys(key for row in rows for key in row.parameters))
    stages = list(dict.fromkeys(key for row in rows for key in row.stages_ms))
    names = list(_PLAIN)
    place = names.index("method") + 1
    table: dict[str, list[Value | None]] = {SCHEMA: [VERSION] * len(rows)}
    for name in names[:place]:
        table[name] = [getattr(row, name) for row in rows]
    for name in parameters:
        table[name] = [row.parameters.get(name) for row in rows]
    for name, attribute in ({name: name for name in names[place:]} | FROM_OTHERS).items():
        table[name] = [_none_if_nan(getattr(row, attribute)) for row in rows]
    for name in stages:
        table[STAGE + name] = [row.stages_ms.get(name) for row in rows]
    return table


def write_study_csv(path: Path, rows: Sequence[StudyRow]) -> None:
    """Write all rows atomically; numbers read back exactly. Raises OutputError."""
    table = study_columns(rows)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(table)
    writer.writerows(zip(*([_text(value) for value in column] for column in table.values()), strict=True))
    write_text(path, text.getvalue())


def read_study_csv(path: Path) -> list[StudyRow]:
    """All rows. Raises InputError naming file and line for what is missing, of another version or not what it should be."""
    with (
        input_errors(f"study {path}", UnicodeDecodeError, csv.Error),
        path.open(newline="", encoding="utf-8-sig") as stream,
    ):
        lines = [line for line in csv.reader(stream) if line]
    header = lines[0] if lines else []
    if SCHEMA not in header:
        raise InputError(f"{path} is no results.csv of a study: it has no column {SCHEMA}")
    if other := next((cells[0] for cells in lines[1:] if cells[0] != str(VERSION)), None):
        raise InputError(
            f"{path} was written by another version of lslam (study version {other}, this one reads {VERSION}): "
            "--overwrite makes its runs anew, --out names another folder"
        )
    if missing := [name for name in _PLAIN if name not in header and name != "path"]:
        raise InputError(f"{path} is not complete: column {', '.join(missing)} is missing")
    rows = []
    for number, cells in enumerate(lines[1:], 2):
        if len(cells) != len(header):
            raise InputError(f"{path}, line {number}: {len(cells)} columns where the header has {len(header)}")
        try:
            rows.append(_row(dict(zip(header, cells, strict=True))))
        except ValueError as error:
            raise InputError(f"{path}, line {number}: {error}") from None
    return rows


def _row(cells: dict[str, str]) -> StudyRow:
    """Row from the cells of a line; raises ValueError for a cell of the wrong type."""
    # Earlier tables have no column `path`.
    values: dict[str, Any] = {name: _READ[kind](cells.get(name, "")) for name, kind in _PLAIN.items()}
    if values["metric"] not in get_args(StudyMetric):
        raise ValueError(f"metric {values['metric']!r} is none of {', '.join(get_args(StudyMetric))}")
    stages = {name.removeprefix(STAGE): float(text) for name, text in cells.items() if name.startswith(STAGE) and text}
    parameters = {
        name: _value(text) for name, text in cells.items() if "." in name and not name.startswith(STAGE) and text
    }
    return StudyRow(**values, parameters=parameters, stages_ms=stages)


def _none_if_nan(value: Value) -> Value | None:
    """The value, None for NaN."""
    return None if isinstance(value, float) and math.isnan(value) else value


def _text(value: Value | None) -> str:
    """Value as a cell; empty for None."""
    if isinstance(value, bool):
        return str(value).lower()
    return "" if value is None else str(value)


def _truth(text: str) -> bool:
    """Boolean in a cell, `true` or `false`. Raises ValueError for another text."""
    if text not in ("true", "false"):
        raise ValueError(f"{text!r} is neither true nor false")
    return text == "true"


def _number(text: str) -> float:
    """Number in a cell; NaN for an empty one."""
    return float(text) if text else math.nan


def _value(text: str) -> Value:
    """Parameter parsed from a cell: whole numbers stay int."""
    if text in ("true", "false"):
        return text == "true"
    number = _NUMBER.fullmatch(text)
    if number is None:
        return text
    return float(text) if number["rest"] else int(text)


_READ: dict[str, Callable[[str], Value]] = {"str": str, "int": int, "float": _number, "bool": _truth}


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
    """Values as floats where some are integers and some floats, as texts for any other mixture; None stays None."""
    kinds = {type(value) for value in column if value is not None}
    if len(kinds) < 2:
        return column
    if kinds == {int, float}:
        return [None if value is None else float(value) for value in column]
    return [None if value is None else str(value) for value in column]
