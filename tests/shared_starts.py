"""The first seconds of a drive, which runs with an IMU register without it, once for all tests of a module."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from stub_sequences import Stub

from lslam.core.config import Config
from lslam.core.types.sequence import Selection, Sequence
from lslam.odometry.frontend import inertial_start
from lslam.odometry.frontend.inertial_start import first_imu_ns, first_poses
from lslam.odometry.inertial.fusion import InertialMotion
from lslam.odometry.inertial.initialise import FirstPoses


@pytest.fixture(scope="module")
def shared_first_poses() -> Iterator[None]:
    """Of the same scans, whatever the IMU says and the method is: the IMU's part in them is when it begins."""
    held: dict[tuple[object, ...], tuple[list[object], FirstPoses]] = {}

    def once(sequence: Sequence, config: Config, motion: InertialMotion | None) -> FirstPoses:
        whole, indices = (
            (sequence.whole, sequence.indices.tobytes()) if isinstance(sequence, Selection) else (sequence, b"")
        )
        if motion is not None or not isinstance(whole, Stub):
            return first_poses(sequence, config, motion)
        since = first_imu_ns(whole.imu, whole.stamps_ns, config)
        key = (
            tuple(map(id, whole.scans)), whole.stamps_ns.tobytes(), whole.motion_compensated, indices, since,
            config.imu.model_dump_json(), config.preprocess.model_dump_json(), config.input.workers,
        )  # fmt: skip
        if key not in held:
            # Scans that are kept keep their identities.
            held[key] = [*whole.scans], first_poses(sequence, config, None)
        return held[key][1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inertial_start, "first_poses", once)
        yield
