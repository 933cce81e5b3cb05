"""Everything a run knows about itself when it ends: what the report is written from."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs, Points
from lslam.core.types.building import CorrectedMap, OsmMatches
from lslam.core.types.cloud import ArrayCloud
from lslam.core.types.constraint import LoopCandidate, MapFix, Turn
from lslam.core.types.gnss import Georeference
from lslam.core.types.imu import ImuStream, InertialChain
from lslam.core.types.scan_result import MotionCheck, ScanResult
from lslam.core.types.trajectory import Trajectory


@dataclass(frozen=True)
class Crispness:
    """How sharp a map is, without ground truth (Razlaw, Droeschel, Holz, Behnke, ECMR 2015); lower is crisper.

    entropy : mean map entropy, the mean of 1/2 ln |2 pi e C| over neighbourhoods with covariance C (m2); nats
    plane_variance : mean plane variance, the mean variance of neighbours about the plane through them, m2
    neighbourhoods : that had enough points; None values when there was none
    """

    entropy: float | None
    plane_variance: float | None
    neighbourhoods: int
    sampled: int
    points: int
    radius: float
    least: int

    @property
    def recipe(self) -> str:
        """How the numbers were made, for people."""
        return (
            f"Razlaw et al. 2015: {self.neighbourhoods} neighbourhoods of {self.radius:g} m with at least {self.least} "
            f"points, about {self.sampled} of {self.points} map points"
        )


@dataclass(frozen=True)
class MapDifference:
    """An estimated map against a reference cloud; distances are those to the nearest point of the other, m.

    precision : share of the map's points within `threshold` of the reference; recall : the other way round; f1 : their
        harmonic mean; chamfer : mean of the two mean distances, m
    """

    threshold: float
    precision: float
    recall: float
    f1: float
    chamfer: float
    mean_to_reference: float
    mean_from_reference: float
    points: int
    reference_points: int

    @property
    def recipe(self) -> str:
        """How the numbers were made, for people."""
        return (
            f"nearest points within {self.threshold:g} m, every point of both clouds ({self.points} and "
            f"{self.reference_points}), no alignment"
        )


@dataclass(frozen=True)
class LoopSurroundings:
    """The surroundings of a loop as one trajectory has them.

    points : (N, 3) of the keyframes on both ways past it, m; older, newer : (A, 2), (B, 2) those ways; centre : (2,) of the
        older end
    """

    points: Floats
    older: Floats
    newer: Floats
    centre: Floats


@dataclass(frozen=True)
class LoopView:
    """The loop that the pose graph corrected most: between which scans, how far it moved one end against the other, m."""

    older_scan: int
    newer_scan: int
    correction: float
    before: LoopSurroundings
    after: LoopSurroundings


@dataclass(frozen=True)
class PairView:
    """The surroundings of the two keyframes of a loop candidate, for people to lay on each other.

    a : (N, 3) m, of the older one, from its place in level axes; b : (M, 3) m, of the newer one in its LiDAR frame
    before, after : (4, 4) that take b to a, by odometry and by the registration of both; `after` is None where that failed
    """

    candidate: LoopCandidate
    a: Points
    b: Points
    before: Floats
    after: Floats | None


@dataclass(frozen=True)
class FeatureView:
    """What a feature method works on.

    scan : the one that is shown; edges (E, 2), planes (P, 2) : its sharp and flat features, m, LiDAR frame; around (K, 3) :
        all its other features there
    map_edges (M, 3), map_planes (N, 3) : less sharp edges and less planar points of the scans looked at, m, world frame
    scans : (S,) those; edge_counts, plane_counts : (S,) features of each
    """

    scan: int
    edges: Floats
    planes: Floats
    around: Floats
    map_edges: Floats
    map_planes: Floats
    scans: Longs
    edge_counts: Longs
    plane_counts: Longs


@dataclass
class RunRecord:
    """One run, for reports. `manifest` is the dictionary written as manifest.json.

    folder : where its results are, None when nothing is written
    map_file : name of the merged map in that folder, empty without one
    map_image : (H, W) float32 density of the merged map seen from above, row 0 at the largest y, or None
    map_heights : (H, W) mean z of what lies in each pixel, m, NaN where nothing does; map_sample : some of its points
    map_extent : (x_min, x_max, y_min, y_max), m; crispness : of the merged map, None without one
    checks : of the integrity monitor, between scans of `results`
    real_time_limit : seconds one scan may take: skip_frames / rate
    pose_time : where in a sweep the stamps of scans lie, to which poses belong: scan_start, scan_middle or scan_end
    world : where the coordinates of trajectory and map begin and whether z is up, in words
    no_score_reason : why a known ground truth gave no score, empty where it did
    odometry : the trajectory before the pose graph, in its own world, None when there was no back end
    T_final_odometry : (4, 4) from that world into the trajectory's
    inertial : the IMU between keyframes, when a tightly coupled method has it in the graph
    turns : of the IMU between keyframes, when the graph is to have them
    osm : what walls seen and buildings of a map had to do with each other, None without a map that could be used; buildings :
        of that map, where they really stand
    loops : candidates with verdicts, between keyframes; keyframe_scans : (K,) position of each one's scan in `results`
    back_end_seconds : by the number of its scan, what each stage after odometry took a keyframe, s; the whole graph with the last
    loop_view : the map at the loop that was corrected most, None without one; pair_views : the most doubtful loop candidates
    features : what a feature method saw, None of another
    map_fixes : each scan against the map that the run was located in, empty without one; map_origin : (3,) m, what the
        coordinates of that map are less in this world
    imu : the recording's, None of a run that uses none
    """

    name: str
    method: str
    folder: Path | None
    results: list[ScanResult]
    trajectory: Trajectory
    ground_truth: Trajectory | None
    real_time_limit: float
    checks: list[MotionCheck] = field(default_factory=list)
    manifest: dict[str, Any] = field(default_factory=dict)
    map_file: str = ""
    map_image: NDArray[np.float32] | None = None
    map_heights: NDArray[np.float32] | None = None
    map_sample: ArrayCloud | None = None
    map_extent: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    crispness: Crispness | None = None
    world: str = "LiDAR at the first scan, not levelled"
    pose_time: str = "scan_start"
    problems: list[str] = field(default_factory=list)
    no_score_reason: str = ""
    odometry: Trajectory | None = None
    T_final_odometry: Floats = field(default_factory=lambda: np.eye(4))
    turns: list[Turn] = field(default_factory=list)
    inertial: InertialChain | None = None
    loops: list[LoopCandidate] = field(default_factory=list)
    keyframe_scans: Longs = field(default_factory=lambda: np.zeros(0, np.int64))
    back_end_seconds: dict[int, dict[str, float]] = field(default_factory=dict)
    georeference: Georeference | None = None
    loop_view: LoopView | None = None
    pair_views: list[PairView] = field(default_factory=list)
    features: FeatureView | None = None
    imu: ImuStream | None = None
    osm: OsmMatches | None = None
    buildings: CorrectedMap | None = None
    map_fixes: list[MapFix] = field(default_factory=list)
    map_origin: Floats = field(default_factory=lambda: np.zeros(3))
