"""`compare.json`: every number of a comparison with its recipe, under a schema with a version. Strict JSON.

Version 1:

    schema, version, lslam, status (running, done), command
    methods[], sequences[], notes[], recipes[], tie_m, timing_is_comparable, configs{method: {}}
    metrics[]      {key, label, unit, group, recipe}
    runs[]         {sequence, method, seed, folder, status, reason, note, jobs, load, reused, values{key: number}, stages_s{},
                    real_time_limit_s, machine{}}
    rows[]         {sequence, method, runs, failed, note, values{key: {mean, std, n}}}
    paired[]       {method, reference, n, ratio, wins, ties, losses, p, note}
    differences[]  {sequence, method, reference, seed, origin, se3}
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from lslam.formats.atomic import write_text
from lslam.reports.compare_table import recipes
from lslam.reports.evaluation_json import strict
from lslam.types.comparison import Comparison, RunScore
from lslam.version import __version__

SCHEMA, VERSION = "lslam-compare", 1


def to_document(comparison: Comparison) -> dict[str, Any]:
    """The comparison as plain values, ready for `json.dumps`; what is not finite becomes None."""
    c = comparison
    document = _head(c.command, "done") | {
        "methods": list(c.methods),
        "sequences": list(c.sequences),
        "notes": list(c.notes),
        "recipes": recipes(c),
        "tie_m": c.tie,
        "timing_is_comparable": c.is_timing_comparable,
        "configs": c.configs,
        "metrics": [asdict(metric) for metric in c.metrics],
        "runs": [_run(run) for run in c.runs],
        "rows": [asdict(row) for row in c.rows],
        "paired": [asdict(pair) for pair in c.paired],
        "differences": [asdict(difference) for difference in c.differences],
    }
    plain = strict(document)
    assert isinstance(plain, dict)
    return plain


def write_running(path: Path, command: str) -> None:
    """Mark the folder of a comparison before its first run; raises OutputError."""
    _write(path, _head(command, "running"))


def write_result(path: Path, comparison: Comparison) -> None:
    """Write compare.json atomically; raises OutputError."""
    _write(path, to_document(comparison))


def _head(command: str, status: str) -> dict[str, Any]:
    return {"schema": SCHEMA, "version": VERSION, "lslam": __version__, "status": status, "command": command}


def _run(run: RunScore) -> dict[str, Any]:
    values = asdict(run)
    values["folder"] = str(values["folder"])
    values["stages_s"] = values.pop("stages")
    values["real_time_limit_s"] = values.pop("limit")
    values["reused"] = values.pop("is_reused")
    return values


def _write(path: Path, document: dict[str, Any]) -> None:
    text = json.dumps(document, indent=1, allow_nan=False, ensure_ascii=False)
    write_text(path, text + "\n")
