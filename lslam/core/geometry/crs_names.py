"""Names of coordinate reference systems: EPSG codes of a plane, and of heights."""

from __future__ import annotations

from lslam.core.errors import UsageError
from lslam.core.untrusted import whole_number


def parse_crs(text: str) -> tuple[int, int | None]:
    """The horizontal and vertical (or None) code of `EPSG:25832` or `EPSG:25832+7837`; raises UsageError for other text."""
    name, _, digits = text.strip().partition(":")
    plane, plus, height = digits.partition("+")
    codes = whole_number(plane), whole_number(height.strip().upper().removeprefix("EPSG:"))
    if name.upper() != "EPSG" or codes[0] is None or (plus and codes[1] is None):
        raise UsageError(
            f"--crs {text} is no EPSG code: expected EPSG and a number, for example EPSG:25832, or EPSG:25832+7837 with heights"
        )
    return codes[0], codes[1]


def crs_name(epsg: int, height_epsg: int | None = None) -> str:
    """`EPSG:25832`, or `EPSG:25832+7837` with a vertical one."""
    return f"EPSG:{epsg}" if height_epsg is None else f"EPSG:{epsg}+{height_epsg}"
