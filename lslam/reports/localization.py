"""What a map that exists had to do with a drive, for the summary."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from lslam.printable import counted, metres
from lslam.reports.back_end import before_and_after
from lslam.types.run_record import RunRecord

if TYPE_CHECKING:
    from lslam.evaluation.results import Evaluation


def localization_rows(record: RunRecord, evaluation: Evaluation | None) -> list[tuple[str, str]]:
    """Names and values for the summary; nothing of a run without a map."""
    fixes = record.map_fixes
    if not fixes:
        return []
    held = [fix for fix in fixes if fix.is_held]
    about = record.manifest.get("localization", {})
    start = about.get("start", {})
    shares = float(np.median([fix.inlier_share for fix in held]))
    moves = float(np.median([fix.innovation[0] for fix in held]))
    rows = [
        ("in the map", f"{about.get('map', '')}: it holds {len(held)} of {counted(len(fixes), 'scan')}"),
        ("", f"{shares:.0%} of the points agree, odometry is corrected by {metres(moves)} m a scan (medians)"),
        ("start", f"found by {start.get('votes')} of {counted(start.get('tried', 0), 'keyframe')} tried"),
    ]  # fmt: skip
    if evaluation is not None and evaluation.odometry is not None:
        rows.append(("", before_and_after(evaluation, evaluation.odometry, "localisation")))
    return rows
