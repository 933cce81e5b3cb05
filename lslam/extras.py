"""How the libraries that only some people need are installed."""

from __future__ import annotations

import shlex
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

from lslam.untrusted import parse_json

# Of a checkout; where lslam is installed, the folder of packages.
_SOURCES = Path(__file__).resolve().parents[1]


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
    path = Path(url2pathname(urlsplit(url).path)) if url else _SOURCES
    is_there = path.exists() if url else (path / "pyproject.toml").is_file()
    return f"{path}[{extra}]" if is_there else named
