"""Section `gnss`: what satellite fixes are used for."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from lslam.config.section import Section


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
    min_sigma: float = Field(0.02, gt=0, description="m; least sigma of a fix")
    vertical: float = Field(1.8, ge=1, description="heights are worse than positions by this factor")
    max_sigma: float = Field(20.0, gt=0, description="m; fixes that state more are left out")
    min_fixes: int = Field(5, ge=3, description="with fewer fixes that agree there is no georeference")
