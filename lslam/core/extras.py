"""What only some people install: libraries, which are missing with one clear sentence, and other packages' plug-ins.

Tables of names are extended by entry points of other packages; nothing is looked up before a name of ours fails.
"""

from __future__ import annotations

import contextlib
import ctypes
import shlex
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from lslam.core.errors import InputError, UsageError, nearest
from lslam.core.untrusted import parse_json

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

# Of a checkout; where lslam is installed, the folder of packages.
_SOURCES = Path(__file__).resolve().parents[2]


def install_hint(extra: str) -> str:
    """Sentence that says how to install the extra of a missing library."""
    return f"install it with: {install_command(extra)}"


def install_command(extra: str) -> str:
    """The pip command that installs an extra of this lslam, from the folder, file, repository or index that it came from.

    >>> install_command("geo").startswith("pip install ")
    True
    """
    return f"pip install {shlex.quote(_requirement(extra))}"


def _requirement(extra: str) -> str:
    """pip's requirement for this installation with `extra`: by its direct URL (PEP 610), its folder of sources, or its name."""
    from importlib.metadata import PackageNotFoundError, distribution  # late, as for plug-ins

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
    """Context like `importing` for Open3D, which needs libusb, libGL and libX11, missing on a bare machine.

    The libusb of the wheel `libusb-package` is loaded first: Open3D then finds it.
    """
    with contextlib.suppress(ImportError, OSError):
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    way_out = f"{install_hint('open3d')}; on a bare Linux also: apt install libgl1 libegl1 libx11-6 libgomp1"
    with importing("Open3D", way_out):
        yield


PLUGIN_GROUPS = ("lslam.methods", "lslam.readers", "lslam.descriptors")
# name -> (module with `create`, one line for people)
Table = Mapping[str, tuple[str, str]]


def find_plugins(group: str, own: Mapping[str, object]) -> dict[str, EntryPoint]:
    """Entry points of other packages in `group`, by name; names of our `own` objects are reserved.

    If two packages have the same name, the alphabetically first package wins.
    """
    from importlib.metadata import entry_points  # imported late: as much work as the whole command line

    entries = sorted(
        entry_points(group=group), key=lambda entry: "" if entry.dist is None else entry.dist.name, reverse=True
    )
    return {entry.name: entry for entry in entries if entry.name not in own}


def plugin_versions() -> dict[str, str]:
    """Versions of the packages that register anything for lslam, by their names."""
    from importlib.metadata import entry_points

    known = entry_points()
    entries = [entry for group in PLUGIN_GROUPS for entry in known.select(group=group)]
    return {entry.dist.name: entry.dist.version for entry in entries if entry.dist is not None}


def summarise(group: str, own: Table) -> dict[str, str]:
    """Names and one-line summaries, those of other packages included; nothing is imported."""
    foreign = {name: f"from {entry.value}" for name, entry in find_plugins(group, own).items()}
    return {name: summary for name, (_, summary) in own.items()} | foreign


def require(group: str, own: Table, name: str, what: str) -> None:
    """Raise UsageError with the nearest name when there is no object of this name, of our `own` or an entry point of `group`.

    what : kind of object, for the message. Nothing is imported.
    """
    if name not in own and name not in (names := summarise(group, own)):
        raise UsageError(f"no {what} {name!r}; {nearest(name, names)}")


def factory(group: str, own: Table, name: str, what: str) -> Callable[..., Any]:
    """The function that creates the object of this name, of our `own` or an entry point of `group`.

    what : kind of object, for messages. Raises UsageError as `require` and InputError as `load`.
    """
    if name in own:
        made: Callable[..., Any] = import_module(own[name][0]).create
        return made
    require(group, own, name, what)
    return load(find_plugins(group, own)[name], what)  # type: ignore[no-any-return]


def load(entry: EntryPoint, what: str) -> Any:
    """The object of an entry point. Raises InputError naming the package when it cannot be imported.

    what : kind of object, for messages
    """
    try:
        return entry.load()
    except Exception as error:
        package = "another package" if entry.dist is None else f"the package {entry.dist.name}"
        raise InputError(
            f"{what} {entry.name!r} of {package} cannot be loaded from {entry.value}: {type(error).__name__}: {error}; "
            "mend or uninstall it"
        ) from None
