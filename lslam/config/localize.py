"""Section `localize`: the map that a drive is located in."""

from __future__ import annotations

from pydantic import Field

from lslam.config.section import Section


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
