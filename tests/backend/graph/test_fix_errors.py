"""What fixes do not state: another clock, more noise, heights of another datum; and nothing of it where they are right."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.backend.graph.fix_errors import actual_sigmas, agreeing_heights, clock_offset, height_levels, rough_residuals

Floats = NDArray[np.float64]
UP = np.array([1.0, 1.0, 1.8])


def antenna(seconds: Floats) -> Floats:
    """A walk of 60 s that stands, hurries and turns; nowhere before and after."""
    t = np.clip(seconds, 0.0, 60.0)
    path = np.column_stack([40 * np.sin(t / 9) + 10 * np.sin(t / 3), 25 * np.sin(t / 5), 0.2 * np.sin(t)])
    return np.where(((seconds >= 0) & (seconds <= 60))[:, None], path, np.nan)


def circle(seconds: Floats) -> Floats:
    """At one speed: another time is another heading."""
    path = 30 * np.column_stack([np.cos(seconds / 5), np.sin(seconds / 5), 0 * seconds])
    return np.where(((seconds >= 0) & (seconds <= 60))[:, None], path, np.nan)


def fixes(late: float, noise: float, seed: int, hz: float = 5.0) -> tuple[Floats, Floats]:
    """Stamps and positions, turned by a heading that nobody knows, of a receiver whose stamps are late."""
    taken = np.arange(0.0, 60.0, 1 / hz)
    c, s = np.cos(2.1), np.sin(2.1)
    turned = antenna(taken) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + [500.0, -80.0, 20.0]
    return taken + late, turned + noise * UP * np.random.default_rng(seed).normal(size=turned.shape)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("late", "noise"), [(2.0, 0.5), (-1.5, 0.5), (0.4, 0.02), (0.1, 0.02), (-0.7, 0.3)])
def test_the_offset_of_a_late_clock_is_found(late: float, noise: float, seed: int) -> None:
    found = clock_offset(*fixes(late, noise, seed), antenna)
    assert found is not None
    assert found.is_clear
    assert abs(found.seconds + late) < max(4 * found.sigma, 0.01)
    assert found.sigma < 0.1


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("noise", [0.02, 0.5, 3.0])
def test_a_right_clock_is_left_alone(noise: float, seed: int) -> None:
    found = clock_offset(*fixes(0.0, noise, seed), antenna)
    assert found is None or not found.is_clear


def test_outliers_and_jumps_have_no_say_in_the_clock() -> None:
    for seed in range(5):
        seconds, places = fixes(1.0, 0.3, seed)
        places[::9] += np.random.default_rng(seed).normal(size=(len(places[::9]), 3)) * 50
        places[150:] += [30.0, 0.0, 0.0]
        found = clock_offset(seconds, places, antenna)
        assert found is not None
        assert found.seconds == pytest.approx(-1.0, abs=0.1)
        assert found.is_clear


def test_an_even_circle_tells_no_time() -> None:
    seconds = np.arange(0.0, 60.0, 0.2)
    found = clock_offset(seconds + 1.0, circle(seconds) + 0.3 * np.random.default_rng(1).normal(size=(300, 3)), circle)
    assert found is None or not found.is_clear
    assert clock_offset(seconds[:5], circle(seconds[:5]), circle) is None


@pytest.mark.parametrize("seed", range(5))
def test_fixes_that_scatter_by_more_than_they_state(seed: int) -> None:
    seconds, places = fixes(0.0, 0.5, seed)
    rough = rough_residuals(seconds, antenna(seconds), places)
    factors = actual_sigmas(seconds, rough, np.full((len(seconds), 3), 0.02), 0.999)
    assert factors is not None
    np.testing.assert_allclose(factors * 0.02, 0.5 * UP, rtol=0.35)
    # East and north are right, the heights are not.
    stated = np.tile([0.5, 0.5, 0.05], (len(seconds), 1))
    factors = actual_sigmas(seconds, rough, stated, 0.999)
    assert factors is not None
    assert factors[:2].tolist() == [1.0, 1.0]
    assert factors[2] * 0.05 == pytest.approx(0.9, rel=0.35)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_fixes_that_scatter_as_they_state(outliers: float, seed: int) -> None:
    seconds, places = fixes(0.0, 0.5, seed, hz=1.0)
    rng = np.random.default_rng(seed)
    wrong = rng.random(len(places)) < outliers
    places[wrong] += rng.normal(size=(int(wrong.sum()), 3)) * 40
    rough = rough_residuals(seconds, antenna(seconds), places)
    factors = actual_sigmas(seconds, rough, np.tile(0.5 * UP, (len(seconds), 1)), 0.999)
    assert factors is None or factors.max() < 1.6
    assert (factors is None) or outliers > 0


def test_heights_agree_where_most_of_them_lie() -> None:
    rng = np.random.default_rng(0)
    off = 0.5 * rng.normal(size=100)
    off[60:] += 48.0
    agrees = agreeing_heights(off, np.full(100, 0.5))
    assert not agrees[60:].any()
    assert agrees[:60].sum() >= 58


@pytest.mark.parametrize("memory", [0.0, 20.0, 100.0])
def test_heights_that_wander_or_climb_do_not_jump(memory: float) -> None:
    """A hundred drives with heights of 1 m, white or a Gauss-Markov process at 5 Hz, on a slope; then a step of 6.7 sigmas."""
    rng, keep = np.random.default_rng(3), np.exp(-0.2 / memory) if memory else 0.0
    off = rng.normal(size=(100, 400))
    for i in range(1, 400):
        off[:, i] = keep * off[:, i - 1] + np.sqrt(1 - keep**2) * off[:, i]
    off += np.linspace(0.0, 3.0, 400)
    assert not any(height_levels(one, np.ones(400)).any() for one in off)
    off[:, 250:] += 6.7
    levels = np.stack([height_levels(one, np.ones(400)) for one in off])
    np.testing.assert_allclose(levels[:, -1], 6.7, atol=2.5)
    assert not levels[:, :240].any()
    assert not (levels[:, 260:] != levels[:, -1:]).any()
