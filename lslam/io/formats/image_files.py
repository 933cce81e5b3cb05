"""Images as arrays: PNG, JPEG and what else Pillow decodes, encodings of ROS, and GeoTIFF. The only file that knows Pillow."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.errors import InputError, input_errors
from lslam.core.extras import importing
from lslam.core.types.camera import Image
from lslam.io.formats.atomic import atomic_write

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_WAY_OUT = "install it with: pip install pillow"
# Pixels at most: more is no camera's image, and fills the memory.
_MOST = 1 << 27
# Of uncompressed ROS images: channels, and which of them are red, green and blue.
_ENCODINGS = {"rgb8": (3, (0, 1, 2)), "bgr8": (3, (2, 1, 0)), "rgba8": (4, (0, 1, 2)), "bgra8": (4, (2, 1, 0))}
_ENCODINGS |= {"8UC3": (3, (2, 1, 0)), "8UC4": (4, (2, 1, 0)), "mono8": (1, (0, 0, 0)), "8UC1": (1, (0, 0, 0))}
# Where red is in a cell of two by two pixels; blue is across from it.
_BAYER = {"bayer_rggb8": (0, 0), "bayer_bggr8": (1, 1), "bayer_gbrg8": (1, 0), "bayer_grbg8": (0, 1)}
# Tags of TIFF and keys of GeoTIFF (OGC 19-008r4), and GDAL's own tag for pixels without a value.
_TRANSFORMATION, _KEYS, _NODATA = 34264, 34735, 42113
_MODEL, _RASTER, _CRS = 1024, 1025, 3072
_SHORT, _DOUBLE = 3, 12


def read_image(path: Path) -> Image:
    """Pixels (height, width, 3) of an image file, red, green, blue. Raises InputError naming it."""
    with input_errors(path), path.open("rb") as stream:
        return _decode(stream, str(path))


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of an image file, by its header. Raises InputError naming it."""
    with input_errors(path), path.open("rb") as stream, _open_image(stream, str(path)) as image:
        return int(image.width), int(image.height)


def decode_image(data: bytes, source: str) -> Image:
    """As `read_image`, from bytes; errors name `source`."""
    return _decode(io.BytesIO(data), source)


def write_png(path: Path, image: Image) -> None:
    """Write pixels (height, width, 3) as PNG, atomically. Raises OutputError."""
    with importing("Pillow", _WAY_OUT):
        from PIL import Image as Pillow
    with atomic_write(path) as stream:
        Pillow.fromarray(np.ascontiguousarray(image)).save(stream, format="PNG")


def from_pixels(data: NDArray[np.uint8], width: int, height: int, step: int, encoding: str, source: str) -> Image:
    """Pixels (height, width, 3), RGB, of the bytes of an uncompressed ROS image with rows of `step` bytes.

    Raises InputError naming `source` for an unsupported encoding, and for too few bytes.
    """
    kind = encoding.split(";")[0].strip()
    channels, order = (1, (0, 0, 0)) if kind in _BAYER else _ENCODINGS.get(kind, (0, (0, 0, 0)))
    if not channels:
        known = ", ".join([*_ENCODINGS, *_BAYER])
        raise InputError(f"{source}: images in {encoding} are not read, only {known}")
    if step < width * channels or len(data) < step * height or not width * height:
        raise InputError(f"{source}: {len(data)} bytes are no {width} x {height} pixels in {encoding}")
    rows = data[: step * height].reshape(height, step)[:, : width * channels]
    if kind in _BAYER:
        return _of_cells(rows, *_BAYER[kind])
    return np.ascontiguousarray(rows.reshape(height, width, channels)[:, :, list(order)])


def _of_cells(raw: NDArray[np.uint8], row: int, column: int) -> Image:
    """RGB of a Bayer mosaic, the same for the four pixels of a cell; `row`, `column`: position of red in the cell."""
    even = raw[: raw.shape[0] // 2 * 2, : raw.shape[1] // 2 * 2].astype(np.uint16)
    red, blue = even[row::2, column::2], even[1 - row :: 2, 1 - column :: 2]
    green = (even[row::2, 1 - column :: 2] + even[1 - row :: 2, column::2]) // 2
    cells = np.stack([red, green, blue], axis=-1).astype(np.uint8)
    out = np.repeat(np.repeat(cells, 2, axis=0), 2, axis=1)
    return np.pad(out, ((0, raw.shape[0] % 2), (0, raw.shape[1] % 2), (0, 0)), mode="edge")


def _decode(stream: BinaryIO, source: str) -> Image:
    """Pixels (H, W, 3), RGB uint8, of an encoded image; raises InputError naming `source` if it is damaged or too large."""
    with _open_image(stream, source) as image:
        if image.width * image.height > _MOST:
            raise InputError(f"{source}: {image.width} x {image.height} pixels are too many for an image of a camera")
        try:
            if image.mode.startswith("I;16"):
                return np.repeat((np.asarray(image, np.uint16) >> 8).astype(np.uint8)[:, :, None], 3, axis=2)
            return np.asarray(image.convert("RGB"), np.uint8)
        except (OSError, ValueError, SyntaxError, EOFError) as error:
            raise InputError(f"{source} cannot be read as an image: {error}") from None


def _open_image(stream: BinaryIO, source: str) -> Any:
    """Open an encoded image by Pillow, without decoding it. Raises InputError naming `source`."""
    with importing("Pillow", _WAY_OUT):
        import PIL
        from PIL import Image as Pillow
    try:
        return Pillow.open(stream)
    except (OSError, ValueError, SyntaxError, EOFError, Pillow.DecompressionBombError) as error:
        what = "no image" if isinstance(error, PIL.UnidentifiedImageError) else str(error)
        raise InputError(f"{source} cannot be read as an image: {what}") from None


def write_geotiff(path: Path, image: NDArray[np.uint8], transform: Floats, epsg: int | None, nodata: int) -> None:
    """Write a grey image (H, W) with its georeference as deflated GeoTIFF 1.1, atomically. Raises OutputError.

    transform : (2, 3) from column and row, whose whole numbers are corners of pixels, to easting and northing, m
    epsg : code of the coordinate reference system, None for local coordinates; nodata : value of pixels without data
    """
    with importing("Pillow", _WAY_OUT):
        from PIL import Image as Pillow
        from PIL.TiffImagePlugin import ImageFileDirectory_v2
    (a, b, x), (c, d, y) = np.asarray(transform, np.float64).tolist()
    keys = [(_MODEL, 1 if epsg else 32767), (_RASTER, 1), *([(_CRS, epsg)] if epsg else [])]
    tags: Any = ImageFileDirectory_v2()
    tags.tagtype[_TRANSFORMATION], tags.tagtype[_KEYS] = _DOUBLE, _SHORT
    tags[_TRANSFORMATION] = (a, b, 0.0, x, c, d, 0.0, y, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    tags[_KEYS] = (1, 1, 1, len(keys), *(number for key, value in keys for number in (key, 0, 1, value)))
    tags[_NODATA] = str(nodata)
    with atomic_write(path) as stream:
        Pillow.fromarray(image).save(stream, format="TIFF", tiffinfo=tags, compression="tiff_adobe_deflate")
