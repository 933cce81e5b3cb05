"""Section `osm`: OpenStreetMap buildings, where they come from, how walls are seen in clouds, and what they hold."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from lslam.config.section import Section


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
    map_sigma: float = Field(0.5, gt=0, description="m; one sigma by which a neighbourhood of the map is off by itself")
    map_sigma_deg: float = Field(1.0, gt=0, description="deg; likewise of its heading")
    building_sigma: float = Field(1.0, gt=0, description="m; one sigma by which a building of the map is off")
    building_sigma_deg: float = Field(2.0, gt=0, description="deg; likewise of its heading")
    server: str = Field(
        "https://overpass-api.de/api/interpreter",
        pattern=r"^https?://\S+$",
        description="address of an Overpass server",
    )
    timeout: float = Field(180.0, gt=0, le=900, description="s; longest wait for one reply")
    connect_timeout: float = Field(10.0, gt=0, description="s; longest wait for a connection")
    attempts: int = Field(4, ge=1, le=10, description="how often one request is tried while the server is busy")
    backoff: float = Field(5.0, gt=0, description="s; wait after the first refusal, doubled after each further one")
    cache: Literal["use", "refresh", "only"] = Field(
        "use", description="use: what was fetched before is not asked for again; refresh: ask again; only: no network"
    )
    fetch_radius: float = Field(120.0, gt=0, description="m; buildings so far round a place are fetched")
    renew_radius: float = Field(60.0, gt=0, description="m; so far from the last request's place a new one is made")
    use_radius: float = Field(35.0, gt=0, description="m; buildings so far from the estimate are matched")
    wall_height: float = Field(
        1.6, ge=0, description="m; above the ground: what is lower is clutter: cars, fences, hedges, people"
    )
    wall_range: float = Field(60.0, gt=0, le=150, description="m; walls are looked for so far from the sensor")
    wall_tilt_deg: float = Field(15.0, gt=0, lt=45, description="deg; largest tilt of a wall's surface")
    wall_tolerance: float = Field(0.15, gt=0, description="m; points so far from a line are of its wall")
    wall_gap: float = Field(1.0, gt=0, description="m; a wider gap parts two walls on one line")
    min_cluster: int = Field(20, ge=3, description="points a wall has at least")
    min_length: float = Field(2.0, gt=0, description="m; shorter walls are left out")
    wall_sigma: float = Field(0.3, gt=0, description="m; one sigma of a wall of the map, drawn by hand from the air")
    max_distance: float = Field(2.0, gt=0, description="m; mean distance of walls that counts as no match (eq. 3.1)")
    distance_weight: float = Field(1.0, ge=0, description="A of equation 3.1")
    coverage_weight: float = Field(1.0, ge=0, description="B of equation 3.2")
    translation_weight: float = Field(0.1, ge=0, description="C of equation 3.3, of the way to the edge of the window")
    line_weight: float = Field(
        0.25, gt=0, le=1, description="information of a match of parallel walls only, against one with corners"
    )
    min_coverage: float = Field(0.4, ge=0, le=1, description="share of the walls seen that must lie on the map")
    min_start_coverage: float = Field(0.6, ge=0, le=1, description="the same where any heading is possible")
    min_building_coverage: float = Field(0.1, ge=0, le=1, description="share of a building's walls that must be seen")
    rival_margin: float = Field(
        15.0, ge=0, description="another pose with so little less fitness makes a match a guess"
    )

    @model_validator(mode="after")
    def _check(self) -> OsmConfig:
        self.require_order("renew_radius", "fetch_radius")
        if not self.use_radius < self.fetch_radius:
            raise ValueError(f"use_radius = {self.use_radius} must be less than fetch_radius = {self.fetch_radius}")
        return self
