"""Common parts of all pages: templates, the page's script, and a content security policy that allows no other script."""

from __future__ import annotations

import base64
import hashlib
import re
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from lslam.core import __version__

if TYPE_CHECKING:
    from jinja2 import Environment, Template

# Modules of `scripts` that a page starts with.
CHARTS, MAP, RUN = "chart_page.mjs", "map_page.mjs", "run_page.mjs"
_IMPORT = re.compile(r'^import (?:[^"]* from )?"\./([^"]+)";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async function|class|const|function|let)\b)", re.MULTILINE)


@dataclass(frozen=True)
class Script:
    """Text of an inline script, and its digest for the content security policy."""

    text: str
    digest: str


def render(name: str, script: str = CHARTS, **shown: Any) -> str:
    """Page of this package: the template `name`, which extends the shell, with the module `script` inserted."""
    return template(name).render(
        version=__version__, script=script_of(script), policy=policy(script_of(script)), **shown
    )


def template(name: str) -> Template:
    """Template of this package; values are escaped, and an unknown name is an error."""
    return _environment().get_template(name)


@cache
def script_of(entry: str) -> Script:
    """The script of a page that starts with the module `entry`."""
    text = '\n"use strict";\n' + "\n".join(bundle(entry).values())
    digest = base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii")
    return Script(text, f"sha256-{digest}")


def policy(script: Script) -> str:
    """Content security policy of a page: nothing is loaded, and no other script runs."""
    return f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src '{script.digest}'"


def bundle(entry: str) -> dict[str, str]:
    """Text of each module that `entry` imports, by name, each after those it imports, without `import` and `export`.

    A page is one file, so its modules become one script and share their names.
    """
    found: dict[str, str] = {}

    def add(name: str) -> None:
        if name in found:
            return
        text = (files("lslam.reports") / "scripts" / name).read_text(encoding="utf-8")
        for imported in _IMPORT.findall(text):
            add(imported)
        found[name] = _EXPORT.sub("", _IMPORT.sub("", text))

    add(entry)
    return found


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
