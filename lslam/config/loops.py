"""Section `loops`: when a place counts as seen before."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from lslam.config.section import Section


class LoopsConfig(Section):
    """Candidates by a place descriptor and odometry, verified by registration of submap to submap."""

    use: bool = Field(True, description="look for places seen before and close loops there")
    file: str = Field(
        "", description="CSV of pairs that are known to be loop closures, or forbidden to be any; empty: none"
    )
    known_within: float = Field(10.0, gt=0, description="m; so far apart the scans of a known pair may have been taken")
    radius: float | None = Field(
        None,
        gt=0,
        description="m; keyframes within this distance by odometry are candidates; absent: within 8 m and what odometry "
        "may be wrong by",
    )
    sigmas: float = Field(
        3.0, gt=0, description="odometry is trusted to be wrong by at most so many standard deviations"
    )
    drift_percent: float = Field(
        0.5,
        ge=0,
        description="%; of the distance travelled, that odometry may be wrong by, one standard deviation, beside its own "
        "covariance, which knows of no systematic errors",
    )
    drift_deg: float = Field(0.25, ge=0, description="deg/100 m; likewise for rotation")
    min_travel: float = Field(30.0, gt=0, description="m; way before a keyframe can be seen again")
    spacing: float = Field(
        4.0,
        ge=0,
        description="m; way between one candidate that is registered and the next; up to three times as far after "
        "several that came out alike",
    )
    descriptor: str = Field(
        "scan-context", description="by which places are told alike: scan-context, or a plug-in's name"
    )
    memory: Literal["all", "bounded"] = Field(
        "all",
        description="which older places are compared: all, or a working memory of bounded size (Labbé and Michaud 2013), so "
        "that the time per keyframe does not grow with the run",
    )
    memory_places: int = Field(
        500, ge=20, description="places, 4 m of way each, in the working memory of `loops.memory = bounded`"
    )
    rings: int = Field(20, ge=4, le=400, description="Scan Context: rings of the polar image (Kim and Kim 2018)")
    sectors: int = Field(60, ge=8, le=360, description="Scan Context: sectors of the polar image")
    reach: float = Field(80.0, gt=0, description="m; Scan Context: radius of the polar image")
    max_descriptor_distance: float = Field(
        0.4, gt=0, le=1, description="distance of the descriptors, 0 alike to 1, above which two places are different"
    )
    max_iterations: int = Field(30, ge=1, description="Gauss-Newton steps of a verification")
    max_rmse: float = Field(0.3, gt=0, description="m; distance of the points to the other submap's surfaces, at most")
    min_overlap: float = Field(
        0.3, ge=0, le=1, description="share of each submap's points that must lie on surfaces of the other"
    )
    max_ambiguity: float = Field(
        0.75,
        gt=0,
        le=1,
        description="a place elsewhere that odometry allows and that fits this much as well makes a closure ambiguous",
    )
    max_disagreement_m: float = Field(
        0.2, gt=0, description="m; registration of old to new may differ from that of new to old by so much"
    )
    max_disagreement_deg: float = Field(0.5, gt=0, description="deg; likewise for rotation")
    sigma_m: float = Field(0.01, gt=0, description="m; a loop closure is never more certain than this")
    sigma_deg: float = Field(0.02, gt=0, description="deg; likewise for rotation")
