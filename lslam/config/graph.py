"""Section `graph`: how the pose graph is made and optimised."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from lslam.config.section import Section


class GraphConfig(Section):
    """The optimisation of keyframe poses."""

    control: str = Field("", description="CSV of control points, surveyed positions that hold the poses; empty: none")
    optimizer: Literal["lm", "dogleg"] = Field(
        "lm", description="Levenberg-Marquardt, or Powell's dog leg (trust region)"
    )
    incremental: bool = Field(False, description="solve keyframe by keyframe with iSAM2 before the final optimisation")
    robust: Literal["gnc", "huber", "cauchy", "none"] = Field(
        "gnc", description="how wrong loops and fixes are told: graduated non-convexity, an M-estimator, not at all"
    )
    is_pairwise: bool = Field(True, description="drop loops that contradict the loops around them before optimising")
    probability: float = Field(
        0.999,
        gt=0.5,
        lt=1,
        description="a loop or fix within this quantile of its own chi-square distribution is right",
    )
    drift_percent: float = Field(
        1.0, gt=0, description="%; one sigma of what odometry may be wrong by over a distance, when loops are judged"
    )
    drift_deg_per_100m: float = Field(0.5, gt=0, description="deg/100 m; likewise of its heading, roll and pitch")
    steady_drift: bool = Field(
        True,
        description="set odometry straight where loops tell that it runs away at one rate, before they are closed, or walls of "
        "buildings that it drifts",
    )
    max_iterations: int = Field(100, ge=1, description="of the optimiser, per solution")
    gravity: bool = Field(True, description="with an IMU: hold each keyframe's up direction to what it measured")
    gravity_deg: float = Field(0.3, gt=0, description="deg; one sigma of that direction: 0.05 m/s2 of bias are 0.3 deg")
    imu_orientation: bool = Field(False, description="with an IMU: hold turns between keyframes to the gyroscope's")
    imu_orientation_deg: float = Field(0.2, gt=0, description="deg; one sigma of such a turn")
    floor: bool = Field(False, description="hold keyframes to one floor plane, for flat ground only (hdl_graph_slam)")
    floor_is_flat: bool = Field(
        True, description="only where nearly all of it is one plane; false: whatever it is, as hdl_graph_slam does"
    )
    floor_m: float = Field(0.1, gt=0, description="m; one sigma of the floor's distance")
    floor_deg: float = Field(1.0, gt=0, description="deg; one sigma of the floor's direction")
    planar: bool = Field(
        False, description="a graph of two dimensions: odometry's height, roll and pitch stay as they are"
    )
    information: Literal["registration", "fitness"] = Field(
        "registration",
        description="covariances of constraints: of the registrations, or from how far the points of one keyframe lie from the "
        "nearest ones of the other (hdl_graph_slam)",
    )
    fitness_sigma_m: tuple[float, float] = Field((0.1, 5.0), description="m; sigma of a perfect fit and of a bad one")
    fitness_sigma_rad: tuple[float, float] = Field((0.05, 0.2), description="rad; likewise of rotation")
    fitness_gain: float = Field(20.0, gt=0, description="how soon sigma grows with the fitness score")
    fitness_limit: float = Field(0.5, gt=0, description="m2; a fitness score as bad as can be")
