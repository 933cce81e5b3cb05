"""On the drive of `test_back_end`: fixes that err together, and loops that an earlier run found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from stub_sequences import Stub
from test_back_end import CITY, COUNT, EVERY, LOOPS, ORIGIN, candidate, config, drifted, on_earth, recording, store_of

from lslam.backend.keyframes.store import KeyframeStore
from lslam.backend.manual import KeyframePairs
from lslam.backend.optimise import run_back_end
from lslam.core.geometry import geodesy, se3
from lslam.core.geometry.se3 import umeyama
from lslam.core.types.constraint import LoopCandidate
from lslam.core.types.scan_result import KeyframeClocks
from lslam.odometry.frontend.checkpoints import Checkpoints
from lslam.pipeline import back_end_pass
from lslam.simulation.sensors import GnssModel
from lslam.simulation.sensors import _errors as gnss_errors


def wandering(seed: int) -> Stub:
    """Fixes that err by 0.85 m as they state, the most of it for two minutes: longer than the drive takes."""
    sequence = recording(noise=0.0, seed=seed)
    model = GnssModel(rate_hz=2.0)
    error = gnss_errors(model, COUNT, np.random.default_rng(seed))[sequence.gnss.stamps_ns // 500_000_000]
    places = geodesy.to_local(sequence.gnss.lat_lon_alt, ORIGIN) + error
    sigma = np.full(len(places), model.sigma)
    return replace(sequence, gnss=replace(sequence.gnss, lat_lon_alt=geodesy.from_local(places, ORIGIN), sigma=sigma))


def test_covariances_include_the_common_error_of_fixes() -> None:
    """As if each erred alone, covariances would be four hundred times too small (NEES per degree of freedom 70)."""
    results = drifted("debug.drift_percent=0", "debug.drift_deg_per_100m=0")
    store, nees = store_of(results), []
    for seed in range(3):
        done = run_back_end(wandering(seed), results, store, config("gnss.mode=graph"), LOOPS)
        told = done.facts["wandering_fixes"]
        assert told["horizontal_m"] == pytest.approx(0.8, abs=0.1)
        assert told["vertical_m"] == pytest.approx(1.8 * told["horizontal_m"], abs=2e-3)
        off = (on_earth(done) - CITY[:, :3, 3])[:, :2]
        spread = np.stack([r.covariance[:2, :2] for r in done.results])
        nees.append(float(np.einsum("ni,nij,nj->n", off, np.linalg.inv(spread), off).mean() / 2))
        p = np.stack([r.T_world_lidar[:3, 3] for r in done.results])
        shape = se3.apply(umeyama(p, CITY[:, :3, 3])[0], p) - CITY[:, :3, 3]
        assert np.sqrt((shape**2).sum(1).mean()) < 0.05
    assert 0.3 < np.mean(nees) < 3


@pytest.mark.parametrize(("sequence", "words"), [(recording(), ()), (wandering(0), ("gnss.sigma=1",))])
def test_fixes_err_together_only_where_they_state_more_than_they_scatter(
    sequence: Stub, words: tuple[str, ...]
) -> None:
    results = drifted("debug.drift_percent=0", "debug.drift_deg_per_100m=0")[:150]
    done = run_back_end(sequence, results, store_of(results), config("gnss.mode=graph", *words), [])
    assert done.facts["fixes"] == 30
    assert "wandering_fixes" not in done.facts


def test_fixes_that_err_together_enter_keyframe_by_keyframe_too() -> None:
    results = drifted("debug.drift_percent=0", "debug.drift_deg_per_100m=0")[:150]
    found = []
    for way in ("isam2", "lm"):
        given = config("gnss.mode=graph", f"graph.optimizer={way}")
        done = run_back_end(wandering(0), results, store_of(results), given, [])
        assert "wandering_fixes" in done.facts
        found.append(np.stack([r.T_world_lidar for r in done.results]))
    np.testing.assert_allclose(*found, atol=1e-3)


def test_loops_that_an_earlier_run_found_are_not_sought_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    results = drifted()
    store, kept = store_of(results), Checkpoints(tmp_path / "checkpoint", "loops", 30.0)
    refused = replace(candidate(3, 190), verdict="rejected", constraint=None)
    monkeypatch.setattr(back_end_pass, "find_loops", lambda *_: [*LOOPS, refused])

    def loops(store: KeyframeStore, kept: Checkpoints | None) -> list[LoopCandidate]:
        watch = SimpleNamespace(should_stop=lambda: False)
        manual = SimpleNamespace(points=())
        job: Any = SimpleNamespace(
            store=store, config=config(), checkpoints_of=lambda _: kept, watch=watch, manual=manual
        )
        return back_end_pass._loops(job, results, KeyframePairs([], []), KeyframeClocks())[0]

    first = loops(store, kept)
    monkeypatch.setattr(back_end_pass, "find_loops", lambda *_: [])
    again = loops(store, Checkpoints(tmp_path / "checkpoint", "loops", 30.0))
    assert [repr(c) for c in again] == [repr(c) for c in first]
    np.testing.assert_array_equal(
        [c.constraint.covariance for c in again[:-1]], [c.constraint.covariance for c in LOOPS]
    )
    assert loops(store_of(results[:-EVERY]), kept) == [], "the keyframes are others"
    assert loops(store, None) == []
