"""The records that a run's state may hold: nothing else is ever made of a file."""

from __future__ import annotations

from lslam.inertial.gyroscope import Gyroscope
from lslam.inertial.imu_estimate import ImuEstimate
from lslam.inertial.imu_noise import ImuNoise
from lslam.inertial.initialise import InertialStart
from lslam.inertial.navigation_state import NavigationState
from lslam.inertial.window import Moment, Past, Window
from lslam.integrity.monitor import Seen
from lslam.odometry.feature_scan import FeatureScan
from lslam.odometry.plane_factors import Sightings, WindowPrior
from lslam.odometry.plane_values import WindowValues
from lslam.odometry.plane_window import Landmarks, PlaneWindow
from lslam.preprocessing.features import FeaturePoints, Features
from lslam.preprocessing.prepare import PreparedPoints
from lslam.types.constraint import Constraint, LoopCandidate, MapFix
from lslam.types.imu import (
    GravityDirection,
    ImuDiagnostics,
    ImuState,
    ImuStream,
    InertialState,
    InertialStep,
    MotionState,
    PreintegratedStep,
)
from lslam.types.scan_result import MotionCheck, ScanEquations, ScanResult

STATE_CLASSES = (
    Constraint, FeaturePoints, Features, FeatureScan, GravityDirection, Gyroscope, ImuEstimate, ImuDiagnostics, ImuNoise,
    ImuState, ImuStream, InertialState, InertialStep, Landmarks, LoopCandidate, MapFix, Moment, MotionCheck, MotionState,
    NavigationState, Past, PlaneWindow, PreintegratedStep, PreparedPoints, ScanEquations, ScanResult, Seen, Sightings,
    InertialStart, Window, WindowPrior, WindowValues,
)  # fmt: skip
