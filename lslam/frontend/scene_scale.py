"""Lengths of registration that follow the scene: a voxel is a plane only where it is small against the room."""

from __future__ import annotations

import numpy as np

from lslam.config import Config
from lslam.errors import InputError
from lslam.types.sequence import Sequence

# m; where half of the points of a scan lie farther, as in streets, the configured lengths hold. Nearer surfaces are smaller.
USUAL_RANGE_M = 8.0
# Keys, by section, that shrink with the range, unless they are set.
LENGTHS = {
    "registration": ("voxel_size",),
    "preprocess": ("range_min", "map_leaf", "source_voxel"),
    "loam": ("grid_step", "feature_map_voxel"),
}


def with_scene_scale(config: Config, sequence: Sequence) -> Config:
    """The configuration with its default lengths in proportion to the median range of the scans, where that is short.

    Lengths that were set are kept. What was decided is a note of the sequence.
    """
    free = {
        name: [key for key in keys if key not in getattr(config, name).model_fields_set]
        for name, keys in LENGTHS.items()
    }
    range_m = median_range(sequence) if any(free.values()) else np.inf
    if range_m >= USUAL_RANGE_M:
        return config
    sections = {
        name: section.model_copy(
            update={key: round(getattr(section, key) * range_m / USUAL_RANGE_M, 3) for key in free[name]}
        )
        for name in LENGTHS
        if free[name] and (section := getattr(config, name))
    }
    changed = config.model_copy(update=sections)
    voxel_m = changed.registration.voxel_size
    sequence.notes.append(
        f"half of the points lie within {range_m:.1f} m: the voxels of the local map are {voxel_m:g} m wide"
    )
    return changed


def median_range(sequence: Sequence) -> float:
    """Median range of the points, m: the largest of the first, middle and last scan, so that a covered sensor decides nothing.

    One of `USUAL_RANGE_M` or more is enough. Infinite where none of them can be read.
    """
    largest = 0.0
    for i in sorted({0, len(sequence) // 2, len(sequence) - 1}):
        try:
            points = sequence.scan(i).points[:, :3]
        except InputError:
            continue
        ranges = np.linalg.norm(points[np.isfinite(points).all(axis=1)], axis=1)
        measured = ranges[ranges > 0]
        largest = max(largest, float(np.median(measured)) if len(measured) else 0.0)
        if largest >= USUAL_RANGE_M:
            break
    return largest or np.inf
