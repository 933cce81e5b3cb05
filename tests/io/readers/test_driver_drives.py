"""A simulated drive, written as the drivers of four LiDARs publish it, is read back and followed by a tightly coupled method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_builders import START_NS, SUFFIX, bag, raw_cloud
from numpy.typing import NDArray
from stub_sequences import Stub

import lslam
from lslam.core.config import load_config
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Sequence
from lslam.io.readers import open_sequence
from lslam.pipeline.convert.bag_writer import BagWriter
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.scenarios import simulate

COUNT = 20
CONFIG = load_config(
    None,
    ["odometry.method=fast-lio2", "map.write=false", "report.html=false", "loops.use=false", "imu.start_s=1"],
    {},
)


@cache
def drive() -> Stub:
    lidar = replace(LIDARS["vlp16"], columns=600)
    made = simulate("walk", lidar=lidar, seed=100, count=COUNT, imu="icm20948", motion_compensated=False)
    return Stub([*made], made.ground_truth, made.calibration, motion_compensated=False, imu=made.imu)


def scans_of(sequence: Sequence) -> list[Scan]:
    return [sequence.scan(k) for k in range(COUNT)]


def rows_of(scan: Scan, fields: dict[str, str], offsets: list[int] | None = None, size: int = 0) -> NDArray[Any]:
    """Points with the fields of a driver, padded as its structs are; times are left at 0."""
    names = ["x", "y", "z", "intensity", *fields]
    formats = ["<f4"] * 4 + list(fields.values())
    dtype = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size} if offsets else
                     list(zip(names, formats, strict=True)))  # fmt: skip
    rows = np.zeros(len(scan), dtype)
    for k, axis in enumerate("xyz"):
        rows[axis] = scan.points[:, k]
    rows["intensity"] = scan.intensity
    rows["line" if "line" in fields else "ring"] = scan.rings
    return rows


def begin_ns(scan: Scan) -> int:
    """When the first point was measured, by a clock of our years."""
    assert scan.times is not None
    return START_NS + scan.stamp_ns + round(1e9 * float(scan.times.min()))


def since_begin(scan: Scan) -> NDArray[np.float64]:
    assert scan.times is not None
    return scan.times.astype(np.float64) - float(scan.times.min())


def velodyne(scan: Scan) -> tuple[int, NDArray[Any]]:
    """Seconds before the last packet, whose stamp the header has."""
    rows, s = rows_of(scan, {"ring": "<u2", "time": "<f4"}), since_begin(scan)
    rows["time"] = s - s.max()
    return begin_ns(scan) + round(1e9 * s.max()), rows


def ouster(scan: Scan) -> tuple[int, NDArray[Any]]:
    """Nanoseconds since the header's stamp."""
    fields = {"t": "<u4", "reflectivity": "<u2", "ring": "<u2", "ambient": "<u2", "range": "<u4"}
    rows = rows_of(scan, fields, [0, 4, 8, 16, 20, 24, 26, 28, 32], 48)
    rows["t"] = np.round(1e9 * since_begin(scan))
    return begin_ns(scan), rows


def hesai(scan: Scan) -> tuple[int, NDArray[Any]]:
    """Seconds of the clock."""
    rows = rows_of(scan, {"timestamp": "<f8", "ring": "<u2"}, [0, 4, 8, 16, 24, 32], 48)
    rows["timestamp"] = begin_ns(scan) / 1e9 + since_begin(scan)
    return begin_ns(scan), rows


def livox(scan: Scan) -> tuple[int, NDArray[Any]]:
    """Nanoseconds of the clock, and lines in place of rings."""
    rows = rows_of(scan, {"tag": "u1", "line": "u1", "timestamp": "<f8"})
    rows["timestamp"] = begin_ns(scan) + np.round(1e9 * since_begin(scan))
    return begin_ns(scan), rows


def write(path: Path, driver: Callable[[Scan], tuple[int, NDArray[Any]]], kind: str) -> Path:
    scans, imu, T_lidar_imu = scans_of(drive()), drive().imu, drive().calibration.T_lidar_imu
    assert imu is not None
    assert T_lidar_imu is not None

    def fill(writer: BagWriter) -> None:
        tree = writer.messages.transforms(START_NS, {("lidar", "imu"): T_lidar_imu})
        writer.write("/tf_static", START_NS, tree)
        for stamp, accel, gyro in zip((START_NS + imu.stamps_ns).tolist(), imu.accel, imu.gyro, strict=True):
            writer.write("/imu", stamp, writer.messages.imu(stamp, accel, gyro, "imu"))
        for scan in scans:
            stamp, rows = driver(scan)
            writer.write("/points", stamp, raw_cloud(writer.store, stamp, rows))

    return bag(path / f"drive{SUFFIX[kind]}", fill, kind)


def ate(sequence: Sequence, epoch_ns: int = 0) -> float:
    """m, against the simulated truth; every scan is registered."""
    truth = drive().ground_truth
    assert truth is not None
    outcome = lslam.run(sequence, CONFIG, ground_truth=replace(truth, stamps_ns=truth.stamps_ns + epoch_ns))
    assert [result.status for result in outcome.record.results] == ["ok"] * COUNT
    assert outcome.evaluation is not None
    error = outcome.evaluation.scores["ate"]["se3"].translation
    assert error is not None
    return float(error.rmse)


@cache
def own_ate() -> float:
    """Of the drive as it was simulated."""
    return ate(drive())


@pytest.mark.parametrize(("driver", "kind"), [(velodyne, "bag"), (ouster, "mcap"), (hesai, "sqlite"), (livox, "mcap")])
def test_a_drive_in_a_drivers_layout_is_the_drive(
    tmp_path: Path, driver: Callable[[Scan], tuple[int, NDArray[Any]]], kind: str
) -> None:
    scans, imu = scans_of(drive()), drive().imu
    sequence = open_sequence(write(tmp_path, driver, kind))
    assert len(sequence) == COUNT
    for k in (0, COUNT - 1):
        read = sequence.scan(k)
        np.testing.assert_array_equal(read.points, scans[k].points)
        np.testing.assert_array_equal(read.rings, scans[k].rings)
        assert read.times is not None
        late_s = 1e-9 * (read.stamp_ns - begin_ns(scans[k]))
        np.testing.assert_allclose(late_s + read.times, since_begin(scans[k]), rtol=0, atol=1e-6)
    assert sequence.imu is not None
    assert imu is not None
    np.testing.assert_array_equal(sequence.imu.stamps_ns, START_NS + imu.stamps_ns)
    assert ate(sequence, START_NS) < 1.2 * own_ate() + 1e-3
