"""Sections of the back end: keyframes, loops, the pose graph, satellite fixes, buildings, existing maps, drift for tests."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from lslam.core.config.input import Section
from lslam.core.labels import parse_classes


class KeyframesConfig(Section):
    """When a scan becomes a keyframe, and what is kept of it."""

    distance: float = Field(2.0, gt=0, description="m; way since the last keyframe")
    angle_deg: float = Field(15.0, gt=0, description="deg; turn since the last keyframe")
    submap_size: int = Field(5, ge=1, description="keyframes whose clouds make one submap, about the one in the middle")


class LoopsConfig(Section):
    """Candidates by a place descriptor and odometry, verified by registration of submap to submap."""

    use: bool = Field(True, description="look for places seen before and close loops there")
    file: str = Field(
        "", description="CSV of pairs that are known to be loop closures, or forbidden to be any; empty: none"
    )
    radius: float | None = Field(
        None,
        gt=0,
        description="m; keyframes within this distance by odometry are candidates; absent: within 8 m and what odometry "
        "may be wrong by",
    )
    drift_percent: float = Field(
        0.5,
        ge=0,
        description="%; of the distance travelled, that odometry may be wrong by, one standard deviation, beside its own "
        "covariance, which knows of no systematic errors",
    )
    drift_deg: float = Field(0.25, ge=0, description="deg/100 m; likewise for rotation")
    min_travel: float = Field(30.0, gt=0, description="m; way before a keyframe can be seen again")
    spacing: float = Field(
        4.0,
        ge=0,
        description="m; way between one candidate that is registered and the next; up to three times as far after "
        "several that came out alike",
    )
    descriptor: str = Field(
        "scan-context", description="by which places are told alike: scan-context, or a plug-in's name"
    )
    memory_places: int | None = Field(
        None,
        ge=20,
        description="older places, 4 m of way each, in a working memory of bounded size (Labbé and Michaud 2013), so that the "
        "time per keyframe does not grow with the run: 500 are 2 km; absent: all are compared",
    )
    rehearsal: float | None = Field(
        None,
        gt=0,
        lt=1,
        description="there, keyframes in a row within 8 m are one place where 1 minus the distance of their descriptors is so "
        "much; absent: 4 m of way are one",
    )
    max_descriptor_distance: float = Field(
        0.4, gt=0, le=1, description="distance of the descriptors, 0 alike to 1, above which two places are different"
    )
    max_iterations: int = Field(30, ge=1, description="Gauss-Newton steps of a verification")
    max_rmse: float = Field(0.3, gt=0, description="m; distance of the points to the other submap's surfaces, at most")
    min_overlap: float = Field(
        0.3, ge=0, le=1, description="share of each submap's points that must lie on surfaces of the other"
    )
    max_ambiguity: float = Field(
        0.75,
        gt=0,
        le=1,
        description="a place elsewhere that odometry allows and that fits this much as well makes a closure ambiguous",
    )
    max_disagreement_m: float = Field(
        0.2, gt=0, description="m; registration of old to new may differ from that of new to old by so much"
    )
    max_disagreement_deg: float = Field(0.5, gt=0, description="deg; likewise for rotation")


class GraphConfig(Section):
    """The optimisation of keyframe poses."""

    control: str = Field("", description="CSV of control points, surveyed positions that hold the poses; empty: none")
    optimizer: Literal["lm", "dogleg", "isam2"] = Field(
        "lm",
        description="Levenberg-Marquardt, Powell's dog leg (trust region), or iSAM2, keyframe by keyframe, before the former",
    )
    robust: Literal["gnc", "huber", "cauchy", "none"] = Field(
        "gnc", description="how wrong loops and fixes are told: graduated non-convexity, an M-estimator, not at all"
    )
    is_pairwise: bool = Field(True, description="drop loops that contradict the loops around them before optimising")
    drift_percent: float = Field(
        1.0, gt=0, description="%; one sigma of what odometry may be wrong by over a distance, when loops are judged"
    )
    drift_deg_per_100m: float = Field(0.5, gt=0, description="deg/100 m; likewise of its heading, roll and pitch")
    steady_drift: bool = Field(
        True,
        description="set odometry straight where loops tell that it runs away at one rate, before they are closed, or walls of "
        "buildings that it drifts",
    )
    refine: bool = Field(
        False, description="then correct all scans at once, so that what they saw of a plane lies on one (--refine)"
    )
    gravity_deg: float = Field(
        0.3,
        ge=0,
        description="deg; with an IMU: hold each keyframe's up direction to what it measured, with this sigma: 0.05 m/s2 of bias "
        "are 0.3 deg; 0: do not",
    )
    imu_orientation_deg: float = Field(
        0.0,
        ge=0,
        description="deg; with an IMU: hold turns between keyframes to the gyroscope's, with this sigma, as 0.2; 0: do not",
    )
    floor: bool = Field(False, description="hold keyframes to one floor plane, for flat ground only (hdl_graph_slam)")
    floor_is_flat: bool = Field(
        True, description="only where nearly all of it is one plane; false: whatever it is, as hdl_graph_slam does"
    )
    floor_m: float = Field(0.1, gt=0, description="m; one sigma of the floor's distance")
    floor_deg: float = Field(1.0, gt=0, description="deg; one sigma of the floor's direction")
    planar: bool = Field(
        False, description="a graph of two dimensions: odometry's height, roll and pitch stay as they are"
    )
    information: Literal["registration", "fitness", "identity"] = Field(
        "registration",
        description="covariances of constraints: of the registrations, from how far the points of one keyframe lie from the "
        "nearest ones of the other (hdl_graph_slam), or 1 m2 and 1 rad2 whatever was found (Girolimetto)",
    )
    fitness_limit: float = Field(0.5, gt=0, description="m2; a fitness score as bad as can be")


class GnssConfig(Section):
    """Satellite fixes: as factors of the pose graph, or for one rigid transform at the end."""

    mode: Literal["off", "fit", "graph"] = Field(
        "off", description="off; fit: georeference the finished trajectory (--georeference); graph: factors (--gnss)"
    )
    crs: int | None = Field(
        None, ge=1024, le=32767, description="EPSG code of georeferenced outputs; default: UTM zone"
    )
    height_crs: int | None = Field(
        None,
        ge=1024,
        le=32767,
        description="EPSG code of a vertical coordinate reference system: --crs EPSG:25832+7837",
    )
    geoid: str = Field(
        "", description="grid (GTX, GeoTIFF) of the geoid that heights of outputs and control points count from"
    )
    sigma: float | None = Field(None, gt=0, description="m; one sigma of a fix; default: what the recording states")


Weight = Annotated[float, Field(ge=0)]
Weights = tuple[Weight, Weight, Weight]


class OsmConfig(Section):
    """Fetching buildings from an Overpass server, the circles of the buffer, and walls (Del Tufo, 3.1 and 3.2)."""

    extract: str = Field(
        "",
        description="buildings that hold the trajectory: a file (.osm, .json, .geojson), auto to fetch them, empty: none",
    )
    origin: tuple[float, float, float] | None = Field(
        None, description="lat, lon (deg), height (m) of the first pose, where no satellite fix says it"
    )
    heading_deg: float | None = Field(
        None,
        ge=-360,
        le=360,
        description="deg; clockwise from north, of the LiDAR's x axis at the first pose; none: sought",
    )
    start_radius: float = Field(10.0, gt=0, le=100, description="m; so far off the origin may be")
    start_heading_deg: float = Field(20.0, gt=0, le=180, description="deg; so far off the heading may be")
    hold_start: bool = Field(
        False,
        description="hold the first pose where the origin has it, as well as start_radius says, against a map that is off as a "
        "whole; else it only says where to look. rigid always does",
    )
    labels: Annotated[tuple[str, ...], BeforeValidator(parse_classes)] = Field(
        (),
        description="classes of points of which walls are made, by name or number as preprocess.drop_labels; needs labels of "
        "points; empty: all that lies on vertical planes",
    )
    label_source: Literal["recording", "geometry"] = Field(
        "recording",
        description="what tells the classes of `labels`: labels of the recording, or the geometry of submaps alone, which knows "
        "other-ground, building, pole, vegetation and car",
    )
    mode: Literal["prior", "rigid", "non-rigid", "two-level"] = Field(
        "two-level",
        description="prior: the map is true; rigid: it is off as a whole, as far as the start tells; non-rigid: each building is "
        "off by itself, in one graph with the trajectory; two-level: first the trajectory, then each building",
    )
    matcher: str = Field(
        "walls",
        description="walls: walls laid on walls; baseline: NDT and VGICP of flattened scans, buildings and trajectory in one "
        "graph, as in Del Tufo, section 2.5 (the mode is not asked)",
    )
    trust_poses: bool = Field(
        True, description="with --poses: they are laid on the map as a whole and not bent; false: held like odometry"
    )
    shift_sigma: float = Field(2.0, ge=0, description="m; one sigma by which a map may be off as a whole; 0 holds it")
    map_sigma: float = Field(
        0.5,
        gt=0,
        description="m; one sigma by which a neighbourhood of the map is off by itself, and a building by twice as much, and "
        "turned: by 2 deg per m",
    )
    server: str = Field(
        "https://overpass-api.de/api/interpreter",
        pattern=r"^https?://\S+$",
        description="address of an Overpass server",
    )
    timeout: float = Field(180.0, gt=0, le=900, description="s; longest wait for one reply")
    attempts: int = Field(4, ge=1, le=10, description="how often one request is tried while the server is busy")
    cache: Literal["use", "refresh", "only"] = Field(
        "use", description="use: what was fetched before is not asked for again; refresh: ask again; only: no network"
    )
    fetch_radius: float = Field(120.0, gt=0, description="m; buildings so far round a place are fetched")
    renew_radius: float = Field(60.0, gt=0, description="m; so far from the last request's place a new one is made")
    use_radius: float = Field(35.0, gt=0, description="m; buildings so far from the estimate are matched")
    wall_height: float = Field(
        1.6, ge=0, description="m; above the ground: what is lower is clutter: cars, fences, hedges, people"
    )
    wall_tolerance: float = Field(0.15, gt=0, description="m; points so far from a line are of its wall")
    min_length: float = Field(2.0, gt=0, description="m; shorter walls are left out")
    wall_sigma: float = Field(0.3, gt=0, description="m; one sigma of a wall of the map, drawn by hand from the air")
    max_distance: float = Field(2.0, gt=0, description="m; mean distance of walls that counts as no match (eq. 3.1)")
    weights: Weights = Field(
        (1.0, 1.0, 0.1),
        description="A, B and C of equations 3.1 to 3.3: of distance, of coverage, and of the way to the edge of the window",
    )
    building_weights: Weights | None = Field(
        None, description="A, B and C where one building is matched; absent: as where all are"
    )
    building_max_distance: float | None = Field(
        None, gt=0, description="m; likewise in place of max_distance; absent: the same"
    )
    min_coverage: float = Field(0.4, ge=0, le=1, description="share of the walls seen that must lie on the map")
    rival_margin: float = Field(
        15.0, ge=0, description="another pose with so little less fitness makes a match a guess"
    )

    @property
    def of_one_building(self) -> OsmConfig:
        """The section with `building_weights` and `building_max_distance` in place of those for all buildings.

        The match of a single building (Del Tufo's local match) takes these.
        """
        farthest = self.max_distance if self.building_max_distance is None else self.building_max_distance
        return self.model_copy(update={"weights": self.building_weights or self.weights, "max_distance": farthest})

    @property
    def needs_labels(self) -> bool:
        """Whether the recording has to have labels."""
        return bool(self.labels) and self.label_source == "recording"

    @model_validator(mode="after")
    def _check(self) -> OsmConfig:
        """Raise ValueError for radii in the wrong order."""
        self.require_order("renew_radius", "fetch_radius")
        if not self.use_radius < self.fetch_radius:
            raise ValueError(f"use_radius = {self.use_radius} must be less than fetch_radius = {self.fetch_radius}")
        return self


class LocalizeConfig(Section):
    """A map takes the place of loops and of the pose graph: the drive gets its poses in the map's frame."""

    map: str = Field("", description="run folder, cloud (PLY, PCD, LAS, LAZ) or folder of tiles; empty: none")
    start: tuple[float, float, float] | None = Field(
        None,
        description="x and y of the first scan in the map, m, and its heading, deg counter-clockwise from the map's x axis; "
        "absent: searched in the whole map, or about the satellite fixes",
    )
    start_radius: float = Field(10.0, gt=0, description="m; `start` may be wrong by so much")
    start_turn_deg: float = Field(30.0, gt=0, le=180, description="deg; likewise its heading")


class DebugConfig(Section):
    """Drift that is added to odometry before loops are looked for; the manifest says so loudly."""

    drift: bool = Field(False, description="let odometry run away as the next keys say: for experiments only")
    drift_kind: Literal["rate", "random-walk", "recorded"] = Field(
        "rate",
        description="at rates that last, or for `drift_memory` only; at rates drawn anew at every step, of the same size after "
        "100 m; or as the odometry of a real run did",
    )
    drift_percent: float = Field(1.0, ge=0, description="%; of the way travelled, in one direction of the world")
    drift_deg_per_100m: float = Field(0.5, ge=0, description="deg/100 m; of heading, over the way travelled")
    drift_seed: int = Field(0, ge=0, description="draws that direction and the side the heading turns to")
    drift_memory: float | None = Field(
        None, gt=0, description="m; way over which both are forgotten and drawn anew; absent: they never change"
    )
    drift_recording: tuple[str, str] | None = Field(
        None,
        description="`recorded`: trajectory of that run and its ground truth, in any format that `eval` reads; where they end "
        "its errors begin anew",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        """Raise ValueError for keys that do not belong to the kind of drift."""
        if self.drift_kind == "recorded" and not self.drift_recording:
            raise ValueError("drift_kind = recorded takes drift_recording, the estimate and the truth of a real run")
        if self.drift_kind != "recorded" and self.drift_recording:
            raise ValueError(f"drift_recording is of drift_kind = recorded, not of {self.drift_kind}")
        if self.drift_kind != "rate" and self.drift_memory is not None:
            raise ValueError(f"drift_memory is of drift_kind = rate, not of {self.drift_kind}")
        return self
