"""Loop candidates of a run for the page's script: where each was, what was decided and why, and what both scans look like."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.arrays import Points
from lslam.core.types.constraint import LoopCandidate, LoopStage
from lslam.core.types.run_record import PairView, RunRecord
from lslam.reports.page_data import QUANTA, packed

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
    """Both clouds as `_cloud` has them, and the rows (3, 4) of `before` and `after`."""
    return {
        "a": _cloud(view.a),
        "b": _cloud(view.b),
        "before": view.before[:3].round(5).tolist(),
        "after": None if view.after is None else view.after[:3].round(5).tolist(),
    }


def _cloud(points: Points) -> dict[str, Any]:
    """Points (N, 3) as int16 q, where a coordinate is `low` + `step` (q + 32768), m."""
    points = points[np.isfinite(points).all(1)].astype(np.float64)
    low, high = (points.min(0), points.max(0)) if len(points) else (np.zeros(3), np.zeros(3))
    step = np.maximum((high - low) / QUANTA, 1e-6)
    quanta: NDArray[Any] = np.rint((points - low) / step) - (QUANTA + 1) // 2
    return {"points": packed(quanta, "<i2"), "low": low.tolist(), "step": step.tolist(), "count": len(points)}
