"""What is said of a map in numbers."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Crispness:
    """How sharp a map is, without ground truth (Razlaw, Droeschel, Holz, Behnke, ECMR 2015); lower is crisper.

    entropy : mean map entropy, the mean of 1/2 ln |2 pi e C| over neighbourhoods with covariance C (m2); nats
    plane_variance : mean plane variance, the mean variance of neighbours about the plane through them, m2
    neighbourhoods : that had enough points; None values when there was none
    """

    entropy: float | None
    plane_variance: float | None
    neighbourhoods: int
    sampled: int
    points: int
    radius: float
    least: int

    @property
    def recipe(self) -> str:
        """How the numbers were made, for people."""
        return (
            f"Razlaw et al. 2015: {self.neighbourhoods} neighbourhoods of {self.radius:g} m with at least {self.least} "
            f"points, about {self.sampled} of {self.points} map points"
        )


@dataclass(frozen=True)
class MapDifference:
    """An estimated map against a reference cloud; distances are those to the nearest point of the other, m.

    precision : share of the map's points within `threshold` of the reference; recall : the other way round; f1 : their
        harmonic mean; chamfer : mean of the two mean distances, m
    """

    threshold: float
    precision: float
    recall: float
    f1: float
    chamfer: float
    mean_to_reference: float
    mean_from_reference: float
    points: int
    reference_points: int

    @property
    def recipe(self) -> str:
        """How the numbers were made, for people."""
        return (
            f"nearest points within {self.threshold:g} m, every point of both clouds ({self.points} and "
            f"{self.reference_points}), no alignment"
        )
