"""Loop candidates of a run for the page's script: where each was, what was decided and why, and what both scans look like."""

from __future__ import annotations

from typing import Any

import numpy as np

from lslam.core.types.constraint import LoopCandidate, LoopStage
from lslam.core.types.run_record import PairView, RunRecord
from lslam.reports.page_data import pack_points

MOST_CANDIDATES = 1000


def candidate_data(record: RunRecord) -> dict[str, Any] | None:
    """The candidates that were registered, the most doubtful first; None for a run that has no pose graph.

    poses : of both keyframes, positions in the trajectory; views : some of the candidates' clouds, by the candidate's position
    """
    if not len(record.trajectory) or record.map_fixes:
        return None
    tried = [c for c in record.loops if c.stage != LoopStage.THINNED]
    tried = sorted(tried, key=lambda c: (-c.doubt, c.a, c.b))[:MOST_CANDIDATES]
    views = {id(view.candidate): pair_data(view) for view in record.pair_views}
    epsg = None if record.georeference is None else record.georeference.epsg
    return {
        "candidates": [
            {"poses": record.keyframe_scans[[c.a, c.b]].tolist(), "doubt": round(c.doubt, 3), **judgement(c)}
            for c in tried
        ],
        "views": {str(k): views[id(c)] for k, c in enumerate(tried) if id(c) in views},
        "crs": "" if epsg is None else f"EPSG:{epsg}",
    }


def judgement(candidate: LoopCandidate) -> dict[str, Any]:
    """What was decided; numbers that are not known are None."""
    known = {"rmse": candidate.rmse, "overlap": candidate.overlap, "away": candidate.distance}
    return {
        "verdict": str(candidate.verdict),
        "stage": str(candidate.stage),
        "reason": candidate.reason,
        **{name: round(value, 4) if np.isfinite(value) else None for name, value in known.items()},
    }


def pair_data(view: PairView) -> dict[str, Any]:
    """Both clouds as `pack_points` has them, and the rows (3, 4) of `before` and `after`."""
    return {
        "a": pack_points(view.a),
        "b": pack_points(view.b),
        "before": view.before[:3].round(5).tolist(),
        "after": None if view.after is None else view.after[:3].round(5).tolist(),
    }
