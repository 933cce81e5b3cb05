"""Small JSON documents of a run folder, which may be edited, damaged or of somebody else."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from lslam.formats.atomic import write_text
from lslam.reports.evaluation_json import strict
from lslam.untrusted import MISFIT, parse_json


def read_json(path: Path) -> dict[str, Any]:
    """The document; empty when there is none that can be read."""
    try:
        tree = parse_json(path.read_text(encoding="utf-8"))
    except (OSError, *MISFIT):
        return {}
    return tree if isinstance(tree, dict) else {}


def write_json(path: Path, document: dict[str, Any]) -> None:
    """Strict JSON, indented, atomically; numbers that JSON has not become null. Raises OutputError."""
    write_text(path, json.dumps(strict(document), indent=2, allow_nan=False, ensure_ascii=False) + "\n")
