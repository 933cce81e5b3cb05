"""A third of a real run's loops wrong: whole runs over the sample, with odometry that was made to drift."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from false_loops import with_false_loops

from lslam.core.config import load_config
from lslam.pipeline import back_end_pass
from lslam.pipeline.run import run
from lslam.pipeline.watch import RunOutcome

SAMPLE = Path(__file__).resolve().parents[3] / "sample_data"


def closed(drift_seed: int) -> RunOutcome:
    """Drift of 1 % and 0.5 deg/100 m; a candidate wherever there may be one, so that a third are some."""
    settings = [
        "debug.drift=true", f"debug.drift_seed={drift_seed}", "loops.spacing=0.2", "keyframes.distance=1.0"
    ]  # fmt: skip
    return run(SAMPLE, load_config(settings=settings, environ={}))


def errors(outcome: RunOutcome) -> tuple[float, float]:
    """m, ATE of odometry and of the result, aligned."""
    score = outcome.evaluation
    assert score is not None
    assert score.odometry is not None
    return score.odometry.ate["se3"].translation.rmse, score.ate["se3"].translation.rmse


@pytest.mark.parametrize("seed", [0, 1])
def test_a_third_of_wrong_loops_is_thrown_out(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    drifted, right = errors(closed(seed))
    assert right < 0.1 * drifted
    found = back_end_pass.find_loops
    wrong: set[tuple[int, int]] = set()

    def some_false(*given, **named):  # type: ignore[no-untyped-def]
        mixed, chosen = with_false_loops(found(*given, **named), 0.3, np.random.default_rng(seed))
        wrong.update(chosen)
        return mixed

    monkeypatch.setattr(back_end_pass, "find_loops", some_false)
    outcome = closed(seed)
    assert len(wrong) >= 3
    assert errors(outcome)[1] < 1.2 * right
    verdicts = {(c.a, c.b): c for c in outcome.record.loops}
    for pair in wrong:
        assert verdicts[pair].verdict == "rejected"
        assert verdicts[pair].stage in ("consistency", "graph")
        assert verdicts[pair].reason
