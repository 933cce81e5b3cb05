"""Directions that a scan says nothing about: flagged where the world is a corridor, not where it is a town."""

from __future__ import annotations

import numpy as np
import pytest
from drives import drive, registered


def test_the_weak_axis_of_a_corridor_is_its_length() -> None:
    d = drive("corridor", 0, 100, speed=9.0, compensated=True)
    weak = [(r, T) for r, T in zip(registered(d.points), d.truth, strict=True) if len(r.degenerate)]
    assert len(weak) > 10, "between its piers the corridor gives no hold"
    angles = []
    for result, T in weak:
        along = T[:3, 0]
        # Rotations are scaled by the lever arm: a twist along the corridor has no other component.
        angles.append(np.degrees(np.arccos(min(float(np.linalg.norm(result.degenerate[:, :3] @ along)), 1.0))))
    assert np.mean(np.array(angles) < 10.0) >= 0.95


@pytest.mark.parametrize("scenario", ["street", "urban"])
def test_towns_hold_every_direction(scenario: str) -> None:
    d = drive(scenario, 0, 50, compensated=True)
    flagged = [len(r.degenerate) > 0 for r in registered(d.points)]
    assert np.mean(flagged) < 0.02
