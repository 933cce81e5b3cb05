"""What a drawn point says: the value with half its interval, words of an axis, and nothing of what is not there."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from lslam.reports.study_figures import picture_points


def test_points_say_their_value_with_half_the_interval() -> None:
    figure = Figure(figsize=(4, 3))
    left, right = figure.subplots(1, 2, sharey=True)
    # Below zero there is nothing to draw: the lower half is shorter, and is not the one that is said.
    left.errorbar([1, 2, 3], [0.5, np.nan, 2.0], [[0.1, 0.1, 0.4], [0.3, 0.3, 0.7]], label="icp", marker="o")
    left.plot([2.0], [1.0], "x", label="_icp")
    left.plot([1, 3], [1, 1], "-", label="beside")
    left.set(xlabel="map.voxel, m", ylabel="rmse, m", title="drive: a law")
    right.plot([0, 1], [0.5, 1.5], "o", label="loam")
    right.set_xticks([0, 1], ["off", "on"])
    right.set_xlabel("loops.use")
    assert [point.text for point in picture_points(figure, "lost")] == [
        "drive, icp, map.voxel 1 m, rmse 0.5 ± 0.3 m",
        "drive, icp, map.voxel 3 m, rmse 2 ± 0.7 m",
        "drive, icp, map.voxel 2 m, lost",
        "loam, loops.use off, rmse 0.5 m",
        "loam, loops.use on, rmse 1.5 m",
    ]
