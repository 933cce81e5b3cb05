"""How the libraries that only some people need are installed."""

from __future__ import annotations

import json
import shlex
from importlib.metadata import PackageNotFoundError, distribution
from urllib.parse import urlsplit
from urllib.request import url2pathname


def install_hint(extra: str) -> str:
    """The way out where a library of an extra is missing."""
    return f"install it with: {install_command(extra)}"


def install_command(extra: str) -> str:
    """What installs an extra of this lslam, which came from a folder or from an index.

    >>> install_command("geo").startswith("pip install ")
    True
    """
    return f"pip install {shlex.quote(f'{_source()}[{extra}]')}"


def _source() -> str:
    """What pip was told to install: a folder, or the name."""
    try:
        url = json.loads(distribution("lslam").read_text("direct_url.json") or "{}").get("url", "")
    except (PackageNotFoundError, ValueError, AttributeError):
        return "lslam"
    return url2pathname(urlsplit(url).path) if str(url).startswith("file:") else "lslam"
