"""`evaluation.json`: every value beside its recipe, under a schema with a version. Strict JSON: what is not known is null.

Version 1, one estimate:

    schema, version, lslam, estimate, ground_truth
    association   {recipe, matched, possible, time_offset_s}
    path_length_m, notes[]
    ate, rpe, kitti_drift, ..   of each metric of `evaluation.metrics`, as its `document` makes it, in m unless the key says else:
        ate.<alignment>   {recipe, available, note, rmse, mean, median, std, min, max, sse, n, rotation_deg{..}, horizontal{..},
                           vertical{..}, percent_of_length, T_gt_est, scale}
        rpe[]             {recipe, delta, unit, pairs, n_pairs, note, translation{..}, rotation_deg{..}}
        others            {recipe, ..}
    timing        {recipe, ..} or null
    odometry      {recipe, and association to the last metric as above}, of a run whose poses a pose graph moved: the poses before
    map           {file, recipe, entropy (nats), plane_variance (m2), plane_thickness_m, ..}, of runs with a map; without ground
                  truth it stands alone behind schema, version, lslam and estimate

Several estimates: {schema, version, evaluations: [the above, ...]}.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from lslam.evaluation.evaluate import METRICS
from lslam.evaluation.results import Evaluation
from lslam.evaluation.timing import Timing
from lslam.types.run_record import Crispness, RunRecord
from lslam.version import __version__

SCHEMA, VERSION = "lslam-evaluation", 1
Document = dict[str, Any]


def to_document(evaluation: Evaluation, timing: Timing | None = None) -> Document:
    """The evaluation as plain values, ready for `json.dumps`; numbers that are NaN or infinite become None."""
    e = evaluation
    document = {
        "schema": SCHEMA,
        "version": VERSION,
        "lslam": __version__,
        "estimate": e.estimate,
        "ground_truth": e.ground_truth,
        "association": {
            "recipe": e.association,
            "matched": e.matched,
            "possible": e.possible,
            "time_offset_s": e.time_offset,
        },
        "path_length_m": e.path_length,
        "notes": list(e.notes),
        **{metric.key: metric.document(e.scores[metric.key]) for metric in METRICS},
        "timing": None if timing is None else {"recipe": "s per scan, from timing.csv", **asdict(timing)},
    }
    if e.odometry is not None:
        whole = to_document(e.odometry)
        kept = ("association", "path_length_m", *(metric.key for metric in METRICS))
        document["odometry"] = {"recipe": "of the poses before the pose graph"} | {name: whole[name] for name in kept}
    plain = strict(document)
    assert isinstance(plain, dict)
    return plain


def run_document(record: RunRecord, evaluation: Evaluation | None) -> Document | None:
    """What a run says of itself: the evaluation, and how crisp its map is; None when neither is known."""
    if evaluation is None and record.crispness is None:
        return None
    document: Document = {"schema": SCHEMA, "version": VERSION, "lslam": __version__, "estimate": record.method}
    if evaluation is not None:
        document = to_document(evaluation)
    if record.crispness is not None:
        document["map"] = {"file": record.map_file, **crispness_document(record.crispness)}
    return document


def crispness_document(score: Crispness) -> Document:
    """The crispness of a map as plain values."""
    thickness = None if score.plane_variance is None else math.sqrt(score.plane_variance)
    plain = strict({"recipe": score.recipe, **asdict(score), "plane_thickness_m": thickness})
    assert isinstance(plain, dict)
    return plain


def to_json(evaluations: Sequence[Evaluation], timings: Sequence[Timing | None] = ()) -> str:
    """One JSON object: the document of one evaluation, or a list of them under `evaluations`."""
    padded = [*timings, *[None] * (len(evaluations) - len(timings))]
    documents = [to_document(e, t) for e, t in zip(evaluations, padded, strict=True)]
    whole = documents[0] if len(documents) == 1 else {"schema": SCHEMA, "version": VERSION, "evaluations": documents}
    return json.dumps(whole, indent=2, allow_nan=False)


def strict(value: Any) -> Any:
    """The value with None for every number that JSON has not: NaN and the infinities."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {key: strict(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [strict(item) for item in value]
    return value
