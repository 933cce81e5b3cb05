"""Small bags for tests to read and to break."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.scan import Scan
from lslam.pipeline.convert.bag_writer import BagMessages, BagWriter

START_NS = 1_700_000_000_123_456_789
STEP_NS = 100_000_000
SUFFIX = {"bag": ".bag", "mcap": ".mcap", "sqlite": ".db3"}
KINDS = tuple(SUFFIX)
GRAVITY = np.array([0, 0, 9.81])

Fill = Callable[[BagWriter], None]


def scan(index: int, n: int = 400, stamp_ns: int | None = None, rings: int = 4) -> Scan:
    """A sweep of 0.1 s with every field, its points in the order they were measured."""
    rng = np.random.default_rng(index)
    points = rng.uniform(-40, 40, (n, 3)).astype(np.float32)
    times = np.linspace(0, 0.0999, n, dtype=np.float32)
    stamp = START_NS + index * STEP_NS if stamp_ns is None else stamp_ns
    return Scan(points, stamp, index, rng.random(n, dtype=np.float32), times, (np.arange(n) % rings).astype(np.uint16))


def bag(path: Path, fill: Fill, kind: str = "bag", is_zstd: bool = False) -> Path:
    """A bag at `path` with what `fill` writes."""
    with BagWriter(path, kind, is_zstd) as writer:
        fill(writer)
    return path


def clouds(count: int, topic: str = "/points", frame: str = "lidar", n: int = 400) -> Fill:
    """`count` scans with times and rings."""

    def fill(writer: BagWriter) -> None:
        for k in range(count):
            one = scan(k, n)
            writer.write(topic, one.stamp_ns, writer.messages.cloud(one, frame))

    return fill


def imu(count: int, start_ns: int = START_NS, topic: str = "/imu", frame: str = "imu") -> Fill:
    """`count` samples at 100 Hz."""

    def fill(writer: BagWriter) -> None:
        rng = np.random.default_rng(1)
        for k in range(count):
            accel, gyro = rng.normal(0, 1, 3) + GRAVITY, rng.normal(0, 0.1, 3)
            stamp = start_ns + k * 10_000_000
            writer.write(topic, stamp, writer.messages.imu(stamp, accel, gyro, frame))

    return fill


def transforms(pairs: dict[tuple[str, str], NDArray[np.float64]]) -> Fill:
    """/tf_static."""

    def fill(writer: BagWriter) -> None:
        writer.write("/tf_static", START_NS, writer.messages.transforms(START_NS, pairs))

    return fill


def together(*fills: Fill) -> Fill:
    """One after the other."""

    def fill(writer: BagWriter) -> None:
        for part in fills:
            part(writer)

    return fill


def raw_cloud(
    store: Any, stamp_ns: int, table: NDArray[Any], *, height: int = 1, padding: int = 0, frame: str = "lidar"
) -> Any:
    """PointCloud2 of a structured array as it lies in memory, big-endian too; rows are followed by `padding` bytes."""
    dtype = table.dtype
    assert dtype.names is not None
    assert dtype.fields is not None
    codes = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
    is_big = any(dtype[name].str.startswith(">") for name in dtype.names)
    field = store.types["sensor_msgs/msg/PointField"]
    width = len(table) // height
    rows = table.view(np.uint8).reshape(height, width * dtype.itemsize)
    data = np.hstack([rows, np.full((height, padding), 0xAB, np.uint8)])
    return store.types["sensor_msgs/msg/PointCloud2"](
        header=BagMessages(store).header(stamp_ns, frame),
        height=height,
        width=width,
        fields=[
            field(name=n, offset=int(dtype.fields[n][1]), datatype=codes[dtype[n].str[1:]], count=1)
            for n in dtype.names
        ],
        is_bigendian=is_big,
        point_step=dtype.itemsize,
        row_step=width * dtype.itemsize + padding,
        data=data.reshape(-1),
        is_dense=True,
    )
