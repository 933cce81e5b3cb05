"""The whole configuration, and the units of its keys."""

from __future__ import annotations

import re
from typing import Any

from pydantic import model_validator

from lslam.core.config.backend import (
    DebugConfig,
    GnssConfig,
    GraphConfig,
    KeyframesConfig,
    LocalizeConfig,
    LoopsConfig,
    OsmConfig,
)
from lslam.core.config.input import InputConfig, PreprocessConfig
from lslam.core.config.odometry import (
    TIGHTLY_COUPLED,
    ImuConfig,
    LioMappingConfig,
    LioSamConfig,
    LoamConfig,
    OdometryConfig,
    RecoveryConfig,
    RegistrationConfig,
)
from lslam.core.config.outputs import EvalConfig, MapConfig, ReportConfig
from lslam.core.config.section import Section


class Config(Section):
    """All sections; the defaults are one configuration for every sensor."""

    input: InputConfig = InputConfig()
    preprocess: PreprocessConfig = PreprocessConfig()
    odometry: OdometryConfig = OdometryConfig()
    registration: RegistrationConfig = RegistrationConfig()
    recovery: RecoveryConfig = RecoveryConfig()
    loam: LoamConfig = LoamConfig()
    lio_sam: LioSamConfig = LioSamConfig()
    lio_mapping: LioMappingConfig = LioMappingConfig()
    imu: ImuConfig = ImuConfig()
    keyframes: KeyframesConfig = KeyframesConfig()
    loops: LoopsConfig = LoopsConfig()
    graph: GraphConfig = GraphConfig()
    localize: LocalizeConfig = LocalizeConfig()
    gnss: GnssConfig = GnssConfig()
    osm: OsmConfig = OsmConfig()
    map: MapConfig = MapConfig()
    eval: EvalConfig = EvalConfig()
    report: ReportConfig = ReportConfig()
    debug: DebugConfig = DebugConfig()

    @model_validator(mode="before")
    @classmethod
    def _with_needed_imu(cls, given: Any) -> Any:
        """A tightly coupled method cannot do without the IMU.

        >>> Config.model_validate({"odometry": {"method": "fast-lio2"}}).imu.use
        True
        """
        odometry = given.get("odometry") if isinstance(given, dict) else None
        method = odometry.get("method") if isinstance(odometry, dict) else getattr(odometry, "method", None)
        if method not in TIGHTLY_COUPLED:
            return given
        imu = given.get("imu", {})
        return {**given, "imu": {**(imu if isinstance(imu, dict) else imu.model_dump()), "use": True}}


_UNIT = re.compile(r"((?:%|deg|rad|m2?|s)(?:/(?:100 m|m|s2?))?(?: per sqrt\((?:s|Hz)\))?); ")


def unit_of(key: str) -> str:
    """The unit of `section.key`; empty where it has none, or is no key.

    >>> unit_of("map.voxel"), unit_of("graph.drift_deg_per_100m"), unit_of("input.skip_frames")
    ('m', 'deg/100 m', '')
    """
    section, _, name = key.partition(".")
    known = Config.model_fields.get(section)
    fields = getattr(known.annotation, "model_fields", {}) if known else {}
    found = _UNIT.match(fields[name].description or "") if name in fields else None
    return found[1] if found else ""


def with_unit(key: str, shown: str = "") -> str:
    """A key, or what is shown in its place, as axes and columns name it.

    >>> with_unit("map.voxel"), with_unit("map.voxel", "voxel"), with_unit("input.skip_frames")
    ('map.voxel, m', 'voxel, m', 'input.skip_frames')
    """
    return ", ".join(filter(None, (shown or key, unit_of(key))))
