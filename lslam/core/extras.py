"""How the libraries that only some people need are installed and imported: one clear sentence instead of a traceback."""

from __future__ import annotations

import contextlib
import ctypes
import shlex
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from urllib.parse import urlsplit

from lslam.core.errors import InputError
from lslam.core.untrusted import parse_json

# Of a checkout; where lslam is installed, the folder of packages.
_SOURCES = Path(__file__).resolve().parents[2]


def install_hint(extra: str) -> str:
    """The way out where a library of an extra is missing."""
    return f"install it with: {install_command(extra)}"


def install_command(extra: str) -> str:
    """What installs an extra of this lslam, which came from a folder, a file, a repository or an index.

    >>> install_command("geo").startswith("pip install ")
    True
    """
    return f"pip install {shlex.quote(_requirement(extra))}"


def _requirement(extra: str) -> str:
    """By what pip was told (PEP 610): a path that is there, an address; else the folder of sources, or the name."""
    named = f"lslam[{extra}]"
    try:
        source = parse_json(distribution("lslam").read_text("direct_url.json") or "{}")
        url, repository = str(source.get("url", "")), source.get("vcs_info", {})
        if repository:
            return f"{named} @ {repository['vcs']}+{url}@{repository['commit_id']}"
    except (PackageNotFoundError, ValueError, AttributeError, KeyError):
        url = ""
    if url and not url.startswith("file:"):
        return f"{named} @ {url}"
    from urllib.request import url2pathname  # with what speaks to servers

    path = Path(url2pathname(urlsplit(url).path)) if url else _SOURCES
    is_there = path.exists() if url else (path / "pyproject.toml").is_file()
    return f"{path}[{extra}]" if is_there else named


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
