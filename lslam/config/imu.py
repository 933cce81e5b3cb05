"""Section `imu`: the inertial measurement unit."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from lslam.config.section import Section

Three = Annotated[tuple[float, ...], Field(min_length=3, max_length=3)]


class ImuConfig(Section):
    """Whether and how the IMU predicts the motion between scans and within them."""

    use: bool = Field(False, description="predict and deskew with the IMU; `--imu`")
    velocity: Literal["registration", "integrated"] = Field(
        "registration",
        description="where a prediction's velocity comes from: what registration found, or integration alone since the "
        "start (Girolimetto, methods 2 and 1)",
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
        None, gt=0, description="m; takes the place of registration.inlier_distance when the IMU is used"
    )
    start_s: float = Field(
        5.0, ge=0.5, le=60, description="s; the start, which is registered once without the IMU, to check and align it"
    )
    gap_s: float = Field(
        0.1, gt=0, description="s; time without samples beyond which a scan falls back to constant velocity"
    )
