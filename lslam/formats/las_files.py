"""LAS 1.4 and LAZ files, what every GIS reads: written block by block, read whole. The only file that knows laspy."""

from __future__ import annotations

from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError, OutputError, cause
from lslam.foreign import importing
from lslam.formats.atomic import atomic_write
from lslam.formats.las_check import check_las
from lslam.types.cloud import ArrayCloud, Cloud
from lslam.version import __version__

SCALE = 0.001  # m
_WAY_OUT = "install it with: pip install laspy lazrs"
_REACH = 2**31 - 1
_BLOCK = 1 << 26  # bytes of points decompressed at a time


def write_las(path: Path, cloud: Cloud, wkt: str = "") -> None:
    """Write a cloud, m, as LAS 1.4 (point format 6); `.laz` compresses it.

    Coordinates are millimetres about an offset, the floor of the smallest ones. Intensities are 16 bits: 0..1 and 0..255
    are spread over them, larger values are kept. The file is dated 1970, so the same cloud gives the same bytes.

    Parameters
    ----------
    wkt : coordinate reference system of the points; empty: none

    Raises
    ------
    OutputError : the file cannot be written, or the cloud is wider than the millimetres of LAS reach (2147 km)
    """
    with importing("laspy", _WAY_OUT):
        import laspy
        import lazrs  # noqa: F401
    low, high, largest = _survey(cloud)
    offset = np.floor(low)
    if np.any(high - offset > SCALE * _REACH):
        raise OutputError(f"{path}: the map is wider than LAS can hold in millimetres: crop it with --crop")
    header = _header(laspy, offset, wkt)
    factor = 65535.0 if largest <= 1.0 else 257.0 if largest <= 255.0 else 1.0
    with atomic_write(path) as stream:
        compressed = path.suffix.lower() == ".laz"
        with laspy.open(stream, mode="w", header=header, do_compress=compressed, closefd=False) as writer:
            for block in cloud.blocks():
                record = laspy.ScaleAwarePointRecord.zeros(len(block), header=header)
                steps = np.rint((block.points - offset) / SCALE)
                record["X"], record["Y"], record["Z"] = steps.astype(np.int32).T
                if block.intensity is not None:
                    record["intensity"] = np.clip(np.rint(block.intensity * factor), 0, 65535).astype(np.uint16)
                record["return_number"] = record["number_of_returns"] = np.ones(len(block), np.uint8)
                writer.write_points(record)


def read_las(path: Path) -> tuple[ArrayCloud, str]:
    """The points, m, and 16-bit intensities of a LAS or LAZ file, and its coordinate reference system as WKT or "".

    Raises InputError naming the file when it is missing or damaged.
    """
    with importing("laspy", _WAY_OUT):
        import laspy
        import lazrs  # noqa: F401
    try:
        with path.open("rb") as stream:
            sizes = check_las(stream)
            stream.seek(0)
            # On all cores whole chunks are decompressed at once, however large they are.
            is_small = sizes.chunk <= _BLOCK
            backend = laspy.LazBackend.LazrsParallel if is_small else laspy.LazBackend.Lazrs
            with laspy.open(stream, closefd=False, laz_backend=backend) as reader:
                step = max(_BLOCK // sizes.record, 1)
                blocks = [
                    (np.column_stack([block.x, block.y, block.z]), np.asarray(block.intensity, np.float32))
                    for block in reader.chunk_iterator(step)
                ]
                header = reader.header
    except OSError as error:
        raise InputError(f"{path} cannot be read: {cause(error)}") from None
    except BaseException as error:  # laspy and lazrs raise whatever a damaged byte leads to, Rust its panics
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise InputError(f"{path} cannot be read as LAS: {error}") from None
    points = np.concatenate([np.zeros((0, 3)), *(points for points, _ in blocks)])
    intensity = np.concatenate([np.zeros(0, np.float32), *(values for _, values in blocks)])
    texts = [vlr.string for vlr in header.vlrs if type(vlr).__name__ == "WktCoordinateSystemVlr"]
    return ArrayCloud(points, intensity), texts[0].rstrip("\0") if texts else ""


def _header(laspy: Any, offset: NDArray[np.float64], wkt: str) -> Any:
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales, header.offsets = np.full(3, SCALE), offset
    header.creation_date = date(1970, 1, 1)  # laspy would put today's
    header.system_identifier = "lslam"
    header.generating_software = f"lslam {__version__}"
    # Format 6 has to say WKT, also when there is none.
    header.global_encoding.wkt = True
    if wkt:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
    return header


def _survey(cloud: Cloud) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Smallest and largest coordinates (3,), m, and the largest intensity; zeros for nothing."""
    low, high, largest = np.full(3, np.inf), np.full(3, -np.inf), 0.0
    for block in cloud.blocks():
        low, high = np.minimum(low, block.points.min(0)), np.maximum(high, block.points.max(0))
        if block.intensity is not None:
            largest = max(largest, float(block.intensity.max()))
    return (low, high, largest) if np.isfinite(low).all() else (np.zeros(3), np.zeros(3), 0.0)
