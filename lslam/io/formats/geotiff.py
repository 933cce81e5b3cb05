"""Grey images with a place in coordinates of GIS: GeoTIFF 1.1, deflated."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.arrays import Floats
from lslam.io.formats.atomic import atomic_write

# Tags of TIFF and keys of GeoTIFF (OGC 19-008r4), and GDAL's own tag for pixels without a value.
_TRANSFORMATION, _KEYS, _NODATA = 34264, 34735, 42113
_MODEL, _RASTER, _CRS = 1024, 1025, 3072
_SHORT, _DOUBLE = 3, 12


def write_geotiff(path: Path, image: NDArray[np.uint8], transform: Floats, epsg: int | None, nodata: int) -> None:
    """Write an image (H, W), atomically. Raises OutputError.

    transform : (2, 3) from column and row, whose whole numbers are corners of pixels, to easting and northing, m
    epsg : code of the coordinate reference system, None for local coordinates; nodata : value of pixels without one
    """
    from PIL import Image
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    (a, b, x), (c, d, y) = np.asarray(transform, np.float64).tolist()
    keys = [(_MODEL, 1 if epsg else 32767), (_RASTER, 1), *([(_CRS, epsg)] if epsg else [])]
    tags: Any = ImageFileDirectory_v2()
    tags.tagtype[_TRANSFORMATION], tags.tagtype[_KEYS] = _DOUBLE, _SHORT
    tags[_TRANSFORMATION] = (a, b, 0.0, x, c, d, 0.0, y, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    tags[_KEYS] = (1, 1, 1, len(keys), *(number for key, value in keys for number in (key, 0, 1, value)))
    tags[_NODATA] = str(nodata)
    with atomic_write(path) as stream:
        Image.fromarray(image).save(stream, format="TIFF", tiffinfo=tags, compression="tiff_adobe_deflate")
