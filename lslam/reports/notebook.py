"""A result as a notebook shows it: a few lines of text beside a picture."""

from __future__ import annotations

import base64
import html
from typing import Any

from lslam.reports.picture import house_style, picture

# mm
WIDTH = 150.0


def as_html(text: str, picture_svg: bytes | None = None) -> str:
    """Text as it stands, and under it a picture."""
    shown = f"<pre>{html.escape(text)}</pre>"
    if picture_svg is None:
        return shown
    return f'{shown}<img alt="" src="data:image/svg+xml;base64,{base64.b64encode(picture_svg).decode()}">'


def drawn(make: Any) -> bytes:
    """SVG of the matplotlib figure that `make` gives, in the house's style."""
    with house_style():
        return picture(make(), "svg")
