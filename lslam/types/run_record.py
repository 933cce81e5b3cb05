"""Everything a run knows about itself when it ends: what the report is written from."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.types.building_correction import CorrectedMap
from lslam.types.building_match import OsmMatches
from lslam.types.constraint import LoopCandidate, Turn
from lslam.types.feature_view import FeatureView
from lslam.types.georeference import Georeference
from lslam.types.loop_view import LoopView
from lslam.types.map_score import Crispness
from lslam.types.scan_result import ScanResult
from lslam.types.trajectory import Trajectory


@dataclass
class RunRecord:
    """One run, for reports. `manifest` is the dictionary written as manifest.json.

    folder : where its results are, None when nothing is written
    map_file : name of the merged map in that folder, empty without one
    map_image : (H, W) float32 density of the merged map seen from above, row 0 at the largest y, or None
    map_extent : (x_min, x_max, y_min, y_max), m; crispness : of the merged map, None without one
    real_time_limit : seconds one scan may take: skip_frames / rate
    pose_time : where in a sweep the stamps of scans lie, to which poses belong: scan_start, scan_middle or scan_end
    world : where the coordinates of trajectory and map begin and whether z is up, in words
    unscored : why a known ground truth gave no score, empty where it did
    odometry : the trajectory before the pose graph, in its own world, None when there was no back end
    T_final_odometry : (4, 4) from that world into the trajectory's
    turns : of the IMU between keyframes, when the graph is to have them
    osm : what walls seen and buildings of a map had to do with each other, None without a map that could be used; buildings :
        of that map, where they really stand
    loops : candidates with verdicts, between keyframes; keyframe_scans : (K,) position of each one's scan in `results`
    back_end_seconds : by the number of its scan, what each stage after odometry took a keyframe, s; the whole graph with the last
    loop_view : the map at the loop that was corrected most, None without one
    features : what a feature method saw, None of another
    """

    name: str
    method: str
    folder: Path | None
    results: list[ScanResult]
    trajectory: Trajectory
    ground_truth: Trajectory | None
    real_time_limit: float
    manifest: dict[str, Any] = field(default_factory=dict)
    map_file: str = ""
    map_image: NDArray[np.float32] | None = None
    map_extent: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    crispness: Crispness | None = None
    world: str = "LiDAR at the first scan, not levelled"
    pose_time: str = "scan_start"
    problems: list[str] = field(default_factory=list)
    unscored: str = ""
    odometry: Trajectory | None = None
    T_final_odometry: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))
    turns: list[Turn] = field(default_factory=list)
    loops: list[LoopCandidate] = field(default_factory=list)
    keyframe_scans: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    back_end_seconds: dict[int, dict[str, float]] = field(default_factory=dict)
    georeference: Georeference | None = None
    loop_view: LoopView | None = None
    features: FeatureView | None = None
    osm: OsmMatches | None = None
    buildings: CorrectedMap | None = None
