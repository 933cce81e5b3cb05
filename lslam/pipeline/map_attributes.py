"""Attributes of a map's points: what the recording must have for them, and what they mean."""

from __future__ import annotations

import logging
from itertools import islice

from lslam.core.config import Config
from lslam.core.config.outputs import MapConfig
from lslam.core.errors import InputError
from lslam.core.types.scan import NO_RING
from lslam.core.types.sequence import Sequence, readable
from lslam.io.formats.text_tables import is_unix_time
from lslam.registration.preprocessing.views import with_rings

log = logging.getLogger("lslam")
KEY = "map.attributes"
_LOOKED_AT = 5  # scans, the first that can be read


def needs_labels(section: MapConfig) -> bool:
    """Whether points need labels for the attributes of the map."""
    return "class" in section.attributes


def with_attributes(sequence: Sequence, config: Config) -> Sequence:
    """Sequence with rings, where the map wants them and the points have none; points without a ring stay.

    Raises InputError where no rings can be found.
    """
    if "ring" not in config.map.attributes:
        return sequence
    scans = [scan for _, scan in islice(readable(range(len(sequence)), sequence.scan), _LOOKED_AT)]
    if not scans or any(scan.rings is not None for scan in scans):
        return sequence
    try:
        return with_rings(sequence, config.input.rings, is_strict=False)
    except InputError as error:
        raise InputError(f"{error}; or leave ring out of {KEY}") from None


def attribute_notes(section: MapConfig, first_ns: int) -> dict[str, str]:
    """Meaning of each attribute, for people, by its name; first_ns : earliest stamp of the recording."""
    clock = "Unix time in PLY and PCD, adjusted standard GPS time (less 1e9 s) in LAS and LAZ"
    if "time" in section.attributes and not is_unix_time(first_ns):
        clock = "the recording's own seconds, which are no Unix time; LAS and LAZ mark them as GPS week time"
        log.warning("map: stamps of the recording are no Unix time: points keep its own seconds")
    own = {
        "time": f"s; {clock}",
        "scan": "number in the recording, from 0",
        "ring": f"number of the beam; {NO_RING} where it has none",
        "range": "m, from the sensor, as measured",
        "observations": "number of points averaged",
        "class": "label in the recording; in LAS and LAZ also classification, of SemanticKITTI's numbers",
    }
    nearest = "" if section.voxel == 0 else "; of the observation nearest to the sensor"
    return {name: own[name] + (nearest if name != "observations" else "") for name in section.attributes}
