"""Common parts of all pages: templates, the page's script, and a content security policy that allows no other script."""

from __future__ import annotations

import base64
import hashlib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from lslam.core.version import __version__

if TYPE_CHECKING:
    from jinja2 import Environment, Template

# In the order in which they run; the map's are of a run's page only.
CHARTS = ("page.js", "charts.js")
RUN = ("page.js", "map.js", "overlay.js", "charts.js")


@dataclass(frozen=True)
class Script:
    """Text of an inline script, and its digest for the content security policy."""

    text: str
    digest: str


def render(name: str, script: tuple[str, ...] = CHARTS, **shown: Any) -> str:
    """Page of this package: the template `name`, which extends the shell, with the files of `script` inserted."""
    return template(name).render(version=__version__, script=_script(script), **shown)


def template(name: str) -> Template:
    """Template of this package; values are escaped, and an unknown name is an error."""
    return _environment().get_template(name)


@cache
def _script(names: tuple[str, ...]) -> Script:
    text = "\n" + "".join((files("lslam.reports") / name).read_text(encoding="utf-8") for name in names)
    digest = base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")
    return Script(text, f"sha256-{digest}")


@cache
def _environment() -> Environment:
    """Template environment, shared by all pages of a process, since compiling a template takes longer than filling it."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("lslam", "reports"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=StrictUndefined,
    )
