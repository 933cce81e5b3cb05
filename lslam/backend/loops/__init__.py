"""Loop closure detection: candidates by gating and descriptors, verification by registration.

A new place descriptor is one file with `create` and one line here; others register an entry point `lslam.descriptors`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

from lslam.core.extras import factory, require

if TYPE_CHECKING:
    from lslam.backend.loops.descriptor import PlaceDescriptor
    from lslam.core.config.backend import LoopsConfig

GROUP = "lslam.descriptors"
# name -> (module with `create(config) -> PlaceDescriptor`, one line for people)
DESCRIPTORS = {
    "scan-context": ("lslam.backend.loops.scan_context", "a polar image of heights (Kim and Kim 2018)"),
}


def require_descriptor(name: str) -> None:
    """Raise UsageError with the nearest name when there is no such descriptor."""
    require(GROUP, DESCRIPTORS, name, "place descriptor")


def create_descriptor(config: LoopsConfig) -> PlaceDescriptor:
    """The descriptor `loops.descriptor` names. Raises UsageError with the nearest name when there is none."""
    return cast("PlaceDescriptor", factory(GROUP, DESCRIPTORS, config.descriptor, "place descriptor")(config))
