"""Importing what not every machine has: one clear sentence instead of a traceback."""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Iterator

from lslam.errors import InputError
from lslam.extras import install_hint


@contextlib.contextmanager
def importing(library: str, way_out: str) -> Iterator[None]:
    """Turn a failing import inside the block into an InputError that names the library and the way out.

    >>> with importing("kiss-icp", "install it with: pip install kiss-icp"):
    ...     import kiss_icp
    """
    try:
        yield
    except (ImportError, OSError) as error:
        # A compiled module whose shared library is missing raises OSError, or ImportError with the loader's words.
        raise InputError(f"{library} cannot be imported: {error}; {way_out}") from None


@contextlib.contextmanager
def importing_open3d() -> Iterator[None]:
    """As `importing`, for Open3D: it needs libusb, libGL and libX11, which a bare machine lacks.

    The libusb of the wheel `libusb-package` is loaded first: Open3D then finds it.
    """
    with contextlib.suppress(ImportError, OSError):
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    way_out = f"{install_hint('open3d')}; on a bare Linux also: apt install libgl1 libegl1 libx11-6 libgomp1"
    with importing("Open3D", way_out):
        yield
