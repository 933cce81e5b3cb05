"""OpenStreetMap as a prior: buildings are fetched, walls are extracted from clouds, and both are matched.

A new matcher is one file with `fit_buildings` and one line here.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, cast

from lslam.core.errors import UsageError, nearest

if TYPE_CHECKING:
    from lslam.osm.corrections import BuildingFitter


@dataclass(frozen=True)
class Matcher:
    """A matcher: its module with `fit_buildings`, and whether a drift of odometry is estimated from walls before it."""

    module: str
    reveals_drift: bool = True

    @property
    def fit_buildings(self) -> BuildingFitter:
        """The function `fit_buildings` of the module, which is imported on first use."""
        return cast("BuildingFitter", import_module(self.module).fit_buildings)


MATCHERS = {
    "walls": Matcher("lslam.osm.corrections"),
    "baseline": Matcher("lslam.osm.baseline_matcher", reveals_drift=False),
}


def find_matcher(name: str) -> Matcher:
    """The matcher `osm.matcher` names. Raises UsageError with the nearest name when there is none."""
    if name not in MATCHERS:
        raise UsageError(f"no matcher {name!r} (osm.matcher); {nearest(name, MATCHERS)}")
    return MATCHERS[name]
