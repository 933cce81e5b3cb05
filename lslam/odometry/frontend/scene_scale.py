"""Lengths of registration that follow the scene: a voxel is a plane only where it is small against the room."""

from __future__ import annotations

import numpy as np

from lslam.core.config import Config
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.errors import InputError
from lslam.core.types.sequence import Sequence
from lslam.registration.preprocessing.beams import ring_gap

# rad that a voxel spans at the median range: small against the scene, and as wide as several rings are apart, since a plane
# needs a few of them.
VOXEL_RAD, RINGS = 0.1, 5
USUAL_RANGE_M = RegistrationConfig().voxel_size / VOXEL_RAD
# Keys, by section, that shrink with the range, unless they are set.
LENGTHS = {
    "registration": ("voxel_size",),
    "preprocess": ("range_min", "map_leaf", "source_voxel"),
    "loam": ("grid_step", "feature_map_voxel"),
}


def with_scene_scale(config: Config, sequence: Sequence) -> Config:
    """The configuration with its default lengths in proportion to the scene, where that is small; a note of it."""
    scaled = in_scale(config, sequence)
    if scaled != config:
        voxel_m = scaled.registration.voxel_size
        sequence.notes.append(f"a small scene: the voxels of the local map are {voxel_m:g} m wide")
    return scaled


def in_scale(config: Config, sequence: Sequence) -> Config:
    """The configuration with the lengths that nobody has set times the scale of the scene."""
    free = {
        name: [key for key in keys if key not in getattr(config, name).model_fields_set]
        for name, keys in LENGTHS.items()
    }
    scale = scene_scale(sequence) if any(free.values()) else 1.0
    if scale >= 1.0:
        return config
    sections = {
        name: section.model_copy(update={key: round(getattr(section, key) * scale, 3) for key in free[name]})
        for name in LENGTHS
        if free[name] and (section := getattr(config, name))
    }
    return config.model_copy(update=sections)


def scene_scale(sequence: Sequence) -> float:
    """The configured lengths in the scene, as a part of those in streets, at most 1.

    The largest of the first, middle and last scan, so that a covered sensor decides nothing; 1 where none can be read.
    """
    largest = 0.0
    for i in sorted({0, len(sequence) // 2, len(sequence) - 1}):
        try:
            points = sequence.scan(i).points[:, :3]
        except InputError:
            continue
        ranges = np.linalg.norm(points, axis=1)
        is_measured = np.isfinite(ranges) & (ranges > 0)
        if not is_measured.any():
            continue
        range_m = float(np.median(ranges[is_measured]))
        span = VOXEL_RAD if range_m >= USUAL_RANGE_M else max(VOXEL_RAD, RINGS * ring_gap(points[is_measured]))
        largest = max(largest, span * range_m / RegistrationConfig().voxel_size)
        if largest >= 1.0:
            break
    return min(largest, 1.0) or 1.0
