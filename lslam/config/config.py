"""The whole configuration."""

from __future__ import annotations

from typing import Any

from pydantic import model_validator

from lslam.config.debug import DebugConfig
from lslam.config.eval import EvalConfig
from lslam.config.gnss import GnssConfig
from lslam.config.graph import GraphConfig
from lslam.config.imu import ImuConfig
from lslam.config.input import InputConfig
from lslam.config.keyframes import KeyframesConfig
from lslam.config.lio_mapping import LioMappingConfig
from lslam.config.lio_sam import LioSamConfig
from lslam.config.loam import LoamConfig
from lslam.config.localize import LocalizeConfig
from lslam.config.loops import LoopsConfig
from lslam.config.map import MapConfig
from lslam.config.odometry import TIGHTLY_COUPLED, OdometryConfig
from lslam.config.osm import OsmConfig
from lslam.config.preprocess import PreprocessConfig
from lslam.config.recovery import RecoveryConfig
from lslam.config.registration import RegistrationConfig
from lslam.config.report import ReportConfig
from lslam.config.section import Section


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
