"""How the kernel widens and narrows, and when agreement has collapsed."""

from __future__ import annotations

import math

import pytest

from lslam.registration.history import AdaptiveThreshold, UsualAgreement


def test_the_threshold_starts_wide_and_follows_the_errors() -> None:
    threshold = AdaptiveThreshold(0.3, 1.0)
    assert threshold.width == pytest.approx(1.0)
    for _ in range(100):
        threshold.observe(0.2)
    assert threshold.width == pytest.approx(0.6, rel=1e-6)


def test_the_threshold_stays_between_its_limits() -> None:
    threshold = AdaptiveThreshold(0.3, 1.0)
    for _ in range(100):
        threshold.observe(0.001)
    assert threshold.width == 0.3
    threshold.observe(50.0)
    assert threshold.width == 1.0


def test_three_sigma_of_recent_errors() -> None:
    threshold = AdaptiveThreshold(0.0, 10.0)
    expected = (10.0 / 3) ** 2
    for error in (0.5, 0.1, 0.8, 0.2):
        threshold.observe(error)
        expected = 0.8 * expected + 0.2 * error**2
    assert threshold.width == pytest.approx(3 * math.sqrt(expected))


def test_a_bad_scan_opens_the_kernel_again() -> None:
    threshold = AdaptiveThreshold(0.3, 1.0)
    for _ in range(50):
        threshold.observe(0.01)
    threshold.widen()
    assert threshold.width == pytest.approx(1.0)


def test_agreement_collapses_only_against_what_was_usual() -> None:
    agreement = UsualAgreement(0.5)
    assert not agreement.is_collapse(0.01)
    agreement.observe(0.8)
    assert agreement.usual == 0.8
    assert agreement.is_collapse(0.39)
    assert not agreement.is_collapse(0.41)
    for _ in range(60):
        agreement.observe(0.4)
    assert agreement.usual == pytest.approx(0.4, abs=1e-5)
    assert not agreement.is_collapse(0.21)


def test_lower_agreement_is_distinguished_from_its_variation() -> None:
    agreement = UsualAgreement(0.5)
    assert not agreement.is_less(0.01)
    for share in (0.8, 0.72, 0.8, 0.72):
        assert not agreement.is_less(share)
        agreement.observe(share)
    assert agreement.is_less(0.6)


def test_usual_agreement_follows_a_growing_map_at_once() -> None:
    agreement = UsualAgreement(0.5)
    for share in (0.18, 0.34, 0.42, 0.46, 0.52):  # the sample drive, 16 x 400 rays
        assert not agreement.is_less(share)
        agreement.observe(share)
    assert agreement.is_collapse(0.17)  # and its next scan from elsewhere


def test_a_changed_place_is_accepted_after_a_few_bad_scans() -> None:
    agreement = UsualAgreement(0.5)
    agreement.observe(0.8)
    bad = 0
    while agreement.is_collapse(0.25):
        agreement.relax()
        bad += 1
    assert 1 < bad < 6


def test_agreement_can_be_switched_off() -> None:
    agreement = UsualAgreement(0.0)
    agreement.observe(0.9)
    assert not agreement.is_collapse(0.0)
