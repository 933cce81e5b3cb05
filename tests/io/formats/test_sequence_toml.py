"""sequence.toml: it reads back as written, and a slip of the pen is answered with the key that was meant."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from lslam.core.errors import InputError
from lslam.core.geometry import se3
from lslam.io.formats.sequence_toml import EXTRINSICS, SequenceInfo, read_sequence_toml, write_sequence_toml

FULL = SequenceInfo(
    name="block", sensor="OS1-32", rings=32, rows=32, cols=1024, rate_hz=10.0, motion_compensated=False,
    compensated_to="scan_start", vertical_correction_deg=0.0, per_point="per_point", stamps="times.txt", imu="imu.csv",
    gnss="gnss.csv", ground_truth="gt.tum", ground_truth_frame="lidar", point_time_unit="us", point_time_reference="end",
    lidar_topic="/points", lidar_frame="all", imu_topic="/imu", gnss_topic="/fix",
    T_cam0_lidar=se3.exp(np.array([1, 2, 3, 0.1, 0.2, 0.3])), T_lidar_imu=se3.exp(np.array([0, 0, 0.1, 0, 0, 3.0])),
    T_lidar_gnss=np.eye(4), lidars={"../rear": se3.exp(np.array([1, 2, 3, 0.1, 0.2, 0.3])), "top": np.eye(4)},
    frames={"base_link": se3.exp(np.array([-1, 0, -2, 0, 0, 0.3]))},
)  # fmt: skip


@pytest.mark.parametrize("info", [FULL, SequenceInfo(), SequenceInfo(sensor="VLP-16", motion_compensated=True)])
def test_round_trip(info: SequenceInfo, tmp_path: Path) -> None:
    path = tmp_path / "sequence.toml"
    write_sequence_toml(path, info)
    back = read_sequence_toml(path)
    for field in fields(SequenceInfo):
        mine, theirs = getattr(info, field.name), getattr(back, field.name)
        if field.name in EXTRINSICS and mine is not None:
            np.testing.assert_array_equal(mine, theirs)
        elif field.name in ("lidars", "frames") and mine is not None:
            assert list(mine) == list(theirs)
            for name, T in mine.items():
                np.testing.assert_array_equal(T, theirs[name])
        else:
            assert mine == theirs, field.name


BAD = {
    "lidars = 'rear'": "lidars is a table",
    "[lidars]\n'../rear' = [1, 2, 3]": "lidars.../rear needs 3x4 or 4x4 numbers",
    "frames = 'base_link'": "frames is a table",
    "[frames]\nbase_link = [1]": "frames.base_link needs 3x4 or 4x4 numbers",
    "sensr = 'VLP-16'": "did you mean 'sensor'?",
    "rate_hz = 0": "rate_hz = 0, expected a number above 0",
    "rate_hz = nan": "rate_hz",
    "rings = 16.5": "rings = 16.5, expected a whole number",
    "motion_compensated = 'yes'": "expected true or false",
    "compensated_to = 'noon'": "one of scan_start, scan_middle, scan_end",
    "ground_truth_frame = 'frame'": "one of lidar, cam0, imu",
    "point_time_unit = 'min'": "one of s, ms, us, ns",
    "point_time_reference = 1": "one of start, end, absolute",
    "rows = 64": "go together",
    "extrinsics = 3": "extrinsics is a table",
    "[extrinsics]\nT_lidar_imuu = [1]": "did you mean 'T_lidar_imu'?",
    "[extrinsics]\nT_lidar_imu = [1, 2, 3]": "3x4 or 4x4",
    "[extrinsics]\nT_lidar_imu = ['a']": "3x4 or 4x4",
    "[extrinsics]\nT_lidar_imu = [2,0,0,0, 0,1,0,0, 0,0,1,0]": "no rigid transform",
    "[extrinsics]\nT_lidar_imu = [-1,0,0,0, 0,1,0,0, 0,0,1,0]": "no rigid transform",
    "sensor = ": "cannot be read as TOML",
}


@pytest.mark.parametrize("text", BAD)
def test_bad_files_name_the_key_and_the_way_out(text: str, tmp_path: Path) -> None:
    path = tmp_path / "sequence.toml"
    path.write_text(text)
    with pytest.raises(InputError) as error:
        read_sequence_toml(path)
    assert str(path) in str(error.value)
    assert BAD[text] in str(error.value)


def test_set_values_override_unset_ones() -> None:
    merged = SequenceInfo(rate_hz=5.0, motion_compensated=False).over(FULL)
    assert (merged.rate_hz, merged.motion_compensated, merged.sensor) == (5.0, False, "OS1-32")
