"""Sections of odometry: the method, registration and its recovery, features, the IMU and wheels."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from lslam.core.config.input import InputConfig, PreprocessConfig, Section

# Methods whose estimate is of points and IMU together.
TIGHTLY_COUPLED = ("fast-lio", "fast-lio2", "lio-sam", "lio-mapping", "lips")
# Of these, the ones that have no states for the device, the rotation of its extrinsics and its clock.
FIXED_DEVICE = ("lio-sam", "lio-mapping", "lips")


class OdometryConfig(Section):
    """Which method estimates the trajectory."""

    method: str = Field("icp", description="a name of `lslam methods`")
    poses: str = Field("", description="trajectory file whose poses method `poses` takes")
    preset: str = Field("", description="a name of `lslam config presets` or a TOML file: what the other keys stand on")
    checkpoint_s: float = Field(
        30.0, ge=0, description="s; a run that is killed goes on (--resume) from a checkpoint at most so old; 0: none"
    )
    integrity: bool = Field(
        True,
        description="compare pairs of scans beside the method, whatever it is, and say where they contradict its poses",
    )


# A name of the table `registration.residuals.RESIDUALS`, which this layer does not know: `check_config` looks there.
Residual = str


class RegistrationConfig(Section):
    """The local map of Gaussian voxels and the robust Gauss-Newton solver."""

    residual: Residual | None = Field(
        None,
        description="how a point is measured against the map: point to point, point to plane, plane to plane, "
        "distribution to distribution, NDT score; absent: what the method is named after, of icp the plane",
    )
    neighbourhood: Literal["voxel", "knn"] = Field(
        "voxel",
        description="`gicp` and `vgicp`: a point's surface is that of its scan in the voxel around, where several rings make "
        "one, or of its twenty nearest neighbours, as in the paper",
    )
    target: Literal["map", "submap", "keyframe", "scan", "sample"] = Field(
        "map",
        description="registered against a map of all scans near by, of the keyframes around, of the last keyframes, of the "
        "last scan alone, or of that scan's source points alone",
    )
    keyframes: int = Field(10, ge=1, description="`target = keyframe`: how many")
    keyframe_m: float = Field(2.0, gt=0, description="m; so far from the newest of them a new one is made")
    keyframe_deg: float = Field(15.0, gt=0, description="deg; or turned by so much")
    inlier_distance: float | None = Field(
        None,
        gt=0,
        description="m; correspondences beyond are rejected and the kernel stays this wide; absent: it opens as wide as "
        "the motion prior was lately wrong and narrows from step to step",
    )
    inlier_ratio: float = Field(
        1.0, gt=0, le=1, description="share of the correspondences kept, nearest first (trimmed ICP); 1 keeps all"
    )
    voxel_size: float = Field(
        0.8,
        gt=0,
        description="m; voxels of the local map, eight are searched per point; for `point`, which is matched to "
        "their means, 5/8 of it",
    )
    sigma: float = Field(0.03, gt=0, description="m; noise of a point, ranging and calibration together")
    kernel_max: float = Field(
        1.0, gt=0.15, description="m; widest Geman-McClure kernel, where annealing starts; it ends at 0.15 m"
    )
    max_iterations: int = Field(
        10,
        ge=1,
        description="Gauss-Newton steps per scan; three times as many for `point` and `ndt`, which converge slowly",
    )
    start_scans: int = Field(
        5,
        ge=1,
        description="first scans, registered coarse to fine because the speed is unknown; above 1 the first is registered again "
        "on the map of those that follow",
    )
    start_reach: float = Field(
        12.0,
        ge=0,
        description="m; how far the sensor may have moved between the first two scans, 40 m/s at every third scan of "
        "10 Hz; 0: not searched for",
    )
    min_overlap: float = Field(
        0.05, ge=0, le=1, description="share of points that found a voxel below which a scan fails"
    )
    min_agreement: float = Field(
        0.5,
        ge=0,
        lt=1,
        description="a scan fails when the share of its points on the map's surfaces drops below this part of what it "
        "was lately, at the start of what the first scan has on its own surfaces, as when the sensor was carried elsewhere; "
        "0 switches it off",
    )
    max_jump_m: float = Field(6.0, gt=0, description="m; a correction of the motion prior beyond this fails")
    max_jump_deg: float = Field(45.0, gt=0, description="deg; likewise for rotation")
    weak_share: float = Field(
        1e-3,
        ge=0,
        lt=1,
        description="share of the information below which a direction counts as unobserved; below a third of it (in LOAM "
        "methods: at once) it keeps the motion prior",
    )


class RecoveryConfig(Section):
    """One switch per policy; `posed_by` in scans.csv names the one that acted."""

    coarse_to_fine: bool = Field(
        True,
        description="align with coarse planes from metres off where a scan fails, corrects its prior by much or is new",
    )
    start_search: bool = Field(
        True, description="seek the first steps within `registration.start_reach`, told by the points above the ground"
    )
    at_rest: bool = Field(
        True,
        description="hold a sensor that stood, where fewer things must have moved for that than for its own motion",
    )
    less_planar: bool = Field(
        True, description="LOAM methods: less planar points in place of features that are few or leave a direction open"
    )
    fallback: Literal["none", "all-points"] = Field(
        "none", description="who poses a scan that LOAM's features hold badly: nobody, or `icp` on all its points"
    )


# Of methods whose filter, smoother or window bridges a scan.
NO_RECOVERY = RecoveryConfig(
    coarse_to_fine=False, start_search=False, at_rest=False, less_planar=False, fallback="none"
)


def rest_alone(recovery: RecoveryConfig) -> RecoveryConfig:
    """The section with all recovery policies off but `at_rest`, as configured.

    A filter needs that one: its IMU measures the same at rest and in steady motion.
    """
    return NO_RECOVERY.model_copy(update={"at_rest": recovery.at_rest})


class LoamConfig(Section):
    """Features of LOAM and LeGO-LOAM. Numbers are the papers' own unless the description says more."""

    regions: int = Field(6, ge=1, description="parts of a ring with equally many points, each with its own features")
    max_edge_points: int = Field(2, ge=1, description="sharp edges per region")
    max_less_edge_points: int = Field(20, ge=1, description="edges per region, the sharp ones included")
    max_planar_points: int = Field(4, ge=1, description="planar points per region")
    grid_step: float = Field(0.2, ge=0, description="m; grid of the less planar points, 0 keeps all")
    feature_map_voxel: float = Field(
        1.0, gt=0, description="m; voxels of the feature map; those of planes are 1.5 times `grid_step` at least"
    )
    pieces: int = Field(
        3,
        ge=1,
        description="loam-livox: parts of a sweep, each registered by itself; 1: the motion prior deskews it whole",
    )
    matching: Literal["one-to-many", "one-to-one"] = Field(
        "one-to-many",
        description="scan to scan: a feature matches the line or plane through several of the other scan's, or the nearest alone",
    )

    @model_validator(mode="after")
    def _check(self) -> LoamConfig:
        """Raise ValueError if there are fewer less sharp edges than sharp ones."""
        if self.max_less_edge_points < self.max_edge_points:
            raise ValueError(
                f"max_less_edge_points = {self.max_less_edge_points} must be at least max_edge_points = "
                f"{self.max_edge_points}"
            )
        return self


class LioSamConfig(Section):
    """What `lio-sam` registers, and its smoother. Numbers are the paper's (Shan et al. 2020) or its implementation's."""

    features: Literal["loam", "points"] = Field(
        "loam",
        description="what is registered: edges and planar points along the rings, as in the paper, or all points",
    )
    graph_imu: bool = Field(
        True,
        description="preintegrated IMU factors between the keyframes of the pose graph, with velocities and biases",
    )


Three = Annotated[tuple[float, ...], Field(min_length=3, max_length=3)]


class ImuConfig(Section):
    """Whether and how the IMU predicts the motion between scans and within them."""

    use: bool = Field(False, description="predict and deskew with the IMU; `--imu`")
    velocity: Literal["registration", "along-x", "integrated"] = Field(
        "registration",
        description="where a prediction's velocity comes from: a filter that registration corrects; the way that registration "
        "found, taken to lead along the x axis of a LiDAR that is level (Girolimetto, method 2); integration alone since the "
        "start (method 1)",
    )
    weigh: bool = Field(
        True,
        description="weigh each registered motion against what the IMU felt by their covariances, and bridge a scan whose "
        "registration the IMU and constant velocity deny; false: it predicts only",
    )
    gyro_bias: Three | None = Field(None, description="rad/s; IMU axes; absent: estimated")
    accel_bias: Three | None = Field(None, description="m/s2; IMU axes; absent: estimated")
    initial_velocity: Three | None = Field(
        None, description="m/s; LiDAR axes at the first scan; absent: estimated from the first scans"
    )
    time_offset_s: float | None = Field(
        None, ge=-10, le=10, description="s; to add to the IMU's stamps; absent: estimated from the rotation rates"
    )
    accel_noise: float | None = Field(
        None,
        gt=0,
        description="m/s2 per sqrt(Hz); of forces, shaking included; absent: 0.05; see `lslam info SEQUENCE --imu-toml FILE`",
    )
    gyro_noise: float | None = Field(
        None, gt=0, description="rad/s per sqrt(Hz); of rates, the least: more is learnt; absent: 0.000175"
    )
    accel_walk: float | None = Field(
        None, gt=0, description="m/s2 per sqrt(s); random walk of the accelerometer's bias; absent: 0.002"
    )
    gyro_walk: float | None = Field(
        None, gt=0, description="rad/s per sqrt(s); random walk of the gyroscope's bias; absent: 0.0000175"
    )
    estimate_offset: bool = Field(
        False,
        description="refine the offset of the clocks at every scan, from what the start found or time_offset_s says",
    )
    estimate_extrinsics: bool = Field(
        False,
        description="estimate the rotation of T_lidar_imu, from the given one: by turns as they come, about what was turned",
    )
    inlier_distance: float | None = Field(
        None,
        gt=0,
        description="m; takes the place of registration.inlier_distance and inlier_ratio when the IMU is used",
    )
    start_s: float = Field(
        5.0, ge=0.5, le=60, description="s; the start, which is registered once without the IMU, to check and align it"
    )


class WheelsConfig(Section):
    """Whether and how wheels predict the motion between scans and within them."""

    source: str = Field(
        "",
        description="topic of a bag (Odometry or TwistStamped), or a CSV file, in the folder of the sequence or by its path; "
        "empty: none; `--wheels`",
    )
    frame: str = Field(
        "", description="of which they are the speeds, x forward; absent: the messages' own, base_link of a file"
    )
    wheelbase_m: float | None = Field(
        None, gt=0, description="m; between the axles, where the file has a steering angle"
    )


class FrontEndConfig(Section):
    """The sections of what registers scans."""

    input: InputConfig = InputConfig()
    preprocess: PreprocessConfig = PreprocessConfig()
    odometry: OdometryConfig = OdometryConfig()
    registration: RegistrationConfig = RegistrationConfig()
    recovery: RecoveryConfig = RecoveryConfig()
    loam: LoamConfig = LoamConfig()
    lio_sam: LioSamConfig = LioSamConfig()
    imu: ImuConfig = ImuConfig()
    wheels: WheelsConfig = WheelsConfig()

    @model_validator(mode="before")
    @classmethod
    def _with_needed_imu(cls, tree: Any) -> Any:
        """Set `imu.use` for a tightly coupled method.

        >>> FrontEndConfig.model_validate({"odometry": {"method": "fast-lio2"}}).imu.use
        True
        """
        odometry = tree.get("odometry") if isinstance(tree, dict) else None
        method = odometry.get("method") if isinstance(odometry, dict) else getattr(odometry, "method", None)
        if method not in TIGHTLY_COUPLED:
            return tree
        imu = tree.get("imu", {})
        return {**tree, "imu": {**(imu if isinstance(imu, dict) else imu.model_dump()), "use": True}}
