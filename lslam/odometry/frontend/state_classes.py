"""The records that a run's state may hold: nothing else is ever made of a file."""

from __future__ import annotations

from lslam.core.types.constraint import Constraint, LoopCandidate, MapFix
from lslam.core.types.imu import (
    GravityDirection,
    ImuDiagnostics,
    ImuState,
    ImuStream,
    InertialState,
    InertialStep,
    MotionState,
    PreintegratedStep,
)
from lslam.core.types.scan_result import MotionCheck, ScanEquations, ScanResult
from lslam.odometry.feature_scan import FeatureScan
from lslam.odometry.inertial.gyroscope import Gyroscope
from lslam.odometry.inertial.imu_estimate import ImuEstimate
from lslam.odometry.inertial.imu_noise import ImuNoise
from lslam.odometry.inertial.initialise import InertialStart
from lslam.odometry.inertial.navigation_state import NavigationState
from lslam.odometry.inertial.window import Moment, Past, Window
from lslam.odometry.integrity.monitor import Seen
from lslam.odometry.plane_factors import Sightings, WindowPrior
from lslam.odometry.plane_values import WindowValues
from lslam.odometry.plane_window import Landmarks, PlaneWindow
from lslam.registration.preprocessing.features import FeaturePoints, Features
from lslam.registration.preprocessing.prepare import PreparedPoints

STATE_CLASSES = (
    Constraint, FeaturePoints, Features, FeatureScan, GravityDirection, Gyroscope, ImuEstimate, ImuDiagnostics, ImuNoise,
    ImuState, ImuStream, InertialState, InertialStep, Landmarks, LoopCandidate, MapFix, Moment, MotionCheck, MotionState,
    NavigationState, Past, PlaneWindow, PreintegratedStep, PreparedPoints, ScanEquations, ScanResult, Seen, Sightings,
    InertialStart, Window, WindowPrior, WindowValues,
)  # fmt: skip
