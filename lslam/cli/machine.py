"""`lslam info --machine`: what this machine has for lslam, part by part; a part that is broken says so and breaks no other."""

from __future__ import annotations

import os
import platform
import shutil
import sys
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from lslam.core import __version__
from lslam.core.extras import install_command

# Of Linux: the control group of this process, and the limits of all.
CGROUP, CGROUPS = Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")
# What each extra is for, and the modules that show it is installed.
EXTRAS = {
    "open3d": ("map.denoise, map.mesh, method open3d-gicp", ("open3d",)),
    "parquet": ("results.parquet of studies", ("pyarrow",)),
    "view": ("lslam view RUN --rerun FILE, for the rerun viewer", ("rerun",)),
    "small-gicp": ("method small-gicp", ("small_gicp",)),
    "geo": ("lslam deliver; lslam convert to KML, GPX and GeoPackage", ("fastkml", "fudgeo", "gpxpy", "pygeoif")),
    "cluster": ("--cluster and --scheduler", ("dask", "distributed")),
    "cloud": ("s3:// and gs://", ("fsspec", "s3fs", "gcsfs")),
}

LIBRARIES = (
    *("numpy", "numba", "scipy", "kiss-icp", "gtsam", "open3d-cpu", "open3d"),
    *("pyproj", "shapely", "embreex"),
)


def machine_document() -> dict[str, Any]:
    """All parts by name, for --json; one that cannot be examined is an object with `problem`."""
    parts: dict[str, Callable[[], Any]] = {
        "lslam": lambda: __version__,
        "python": lambda: sys.version.split()[0],
        "platform": platform.platform,
        "cores": _cores,
        "memory": _memory,
        "disk": lambda: {"folder": str(Path.cwd()), "free_bytes": shutil.disk_usage(".").free},
        "kernels": _kernels,
        "browser": _browser,
        "proj": _proj,
        "libraries": library_versions,
        "extras": _extras,
    }
    document = {}
    for name, part in parts.items():
        try:
            document[name] = part()
        except Exception as error:  # whatever is broken on this machine is what the command is asked about
            document[name] = {"problem": f"cannot be told ({type(error).__name__}: {error})"}
    return document


def _cores() -> dict[str, Any]:
    """Number of cores: of the machine, usable, and the container's limit."""
    from lslam.core.machine import available_cores

    return {"machine": os.cpu_count(), "usable": available_cores(), "container": _container("cpu.max")}


def _memory() -> dict[str, Any]:
    """Memory in bytes: of the machine, free, and the container's limit, None without one."""
    page = os.sysconf("SC_PAGE_SIZE")
    free = os.sysconf("SC_AVPHYS_PAGES") * page
    for line in Path("/proc/meminfo").read_text().splitlines() if Path("/proc/meminfo").exists() else ():
        if line.startswith("MemAvailable:"):
            free = int(line.split()[1]) * 1024
    total = os.sysconf("SC_PHYS_PAGES") * page
    return {"total_bytes": total, "free_bytes": free, "container_bytes": _container("memory.max")}


def _container(limit: str) -> float | None:
    """Least limit that the control groups of this process set, in cores or bytes; None without any (version 2, Linux)."""
    limits = []
    line = CGROUP.read_text().splitlines()[-1] if CGROUP.exists() else ""
    inner = CGROUPS / line.rpartition(":")[2].lstrip("/")
    for folder in (inner, *inner.parents):
        words = (folder / limit).read_text().split() if (folder / limit).is_file() else ["max"]
        if words[0] != "max":
            limits.append(float(words[0]) / float(words[1] if len(words) > 1 else 1))
    return min(limits, default=None)


def _kernels() -> dict[str, Any]:
    """Folder of compiled kernels, its size in bytes, number of kernels, and `is_warm`: whether there are any."""
    from lslam.core.kernels.cache import kernel_folder

    folder = kernel_folder()
    files = [] if folder is None else [file for file in folder.rglob("*") if file.is_file()]
    size = sum(file.stat().st_size for file in files)
    many = sum(file.suffix == ".nbi" for file in files)
    return {"folder": None if folder is None else str(folder), "bytes": size, "kernels": many, "is_warm": many > 0}


def _browser() -> dict[str, Any]:
    """Name of the browser, and whether it can open pages here."""
    import webbrowser

    from lslam.cli.console import has_window

    try:
        name = getattr(webbrowser.get(), "name", "") or type(webbrowser.get()).__name__
    except webbrowser.Error:
        name = None
    return {"name": name, "opens_pages": name is not None and has_window()}


def _proj() -> dict[str, Any]:
    """PROJ and its installed grids."""
    from lslam.core.geometry.geodesy import installed_grids

    return installed_grids()


def library_versions() -> dict[str, str | None]:
    """Versions of libraries; None for one that is not installed."""
    from importlib.metadata import PackageNotFoundError, version

    versions: dict[str, str | None] = {}
    for name in LIBRARIES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            versions[name] = None
    return versions


def _extras() -> dict[str, Any]:
    """Optional packages by extra: whether installed, their use, and the command to install them."""
    return {
        name: {
            "installed": all(find_spec(module) is not None for module in modules),
            "for": text,
            "install": install_command(name),
        }
        for name, (text, modules) in EXTRAS.items()
    }


def machine_rows(document: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """The document for people: names and lines."""
    for name, say in _LINES.items():
        part = document[name]
        has_problem = isinstance(part, dict) and "problem" in part
        for k, text in enumerate([part["problem"]] if has_problem else say(part)):
            yield "" if k else name, text


def _gb(size: float | None) -> str:
    """Size in GB as text."""
    return "unknown" if size is None else f"{size / 1e9:.1f} GB"


def _limit(value: float | None, text: Callable[[float], str]) -> str:
    """Text about the container's limit; empty without one."""
    return "" if value is None else f", {text(value)} in this container"


def _of_proj(part: dict[str, Any]) -> list[str]:
    """Texts on PROJ: version and folders, grids of heights, other grids."""
    vertical, others = part["vertical"], part["others"]
    return [
        f"{part['version']}, network {'on' if part['network'] else 'off'}, grids in {', '.join(part['folders'])}",
        f"{len(vertical)} of heights: {', '.join(vertical) or '`pyproj sync --file NAME` fetches one'}",
        f"{len(others)} others" + (f": {', '.join(others)}" if others else ""),
    ]


def _of_kernels(part: dict[str, Any]) -> list[str]:
    """Text on the folder of compiled kernels."""
    if part["folder"] is None:
        return ["no folder for them: each run compiles anew"]
    state = f"{part['kernels']} kernels" if part["is_warm"] else "none yet: the first run compiles them, once"
    return [f"{part['folder']}, {part['bytes'] / 1e6:.1f} MB, {state}"]


_LINES: dict[str, Callable[[Any], list[str]]] = {
    "lslam": lambda part: [part],
    "python": lambda part: [f"{part}, {sys.executable}"],
    "platform": lambda part: [part],
    "cores": lambda part: [f"{part['usable']} of {part['machine']}{_limit(part['container'], '{:g}'.format)}"],
    "memory": lambda part: [
        f"{_gb(part['free_bytes'])} free of {_gb(part['total_bytes'])}{_limit(part['container_bytes'], _gb)}"
    ],
    "disk": lambda part: [f"{_gb(part['free_bytes'])} free in {part['folder']}"],
    "kernels": _of_kernels,
    "browser": lambda part: [
        f"{part['name'] or 'none'}{'' if part['opens_pages'] else ', no window here: pages are named, not opened'}"
    ],
    "proj": _of_proj,
    "libraries": lambda part: [", ".join(f"{name} {version}" for name, version in part.items() if version is not None)],
    "extras": lambda part: [
        f"{name:<11}{'installed' if one['installed'] else 'missing':<10} {one['for']}"
        + ("" if one["installed"] else f": {one['install']}")
        for name, one in part.items()
    ],
}
