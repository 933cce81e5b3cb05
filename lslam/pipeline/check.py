"""What a configuration can get wrong that its sections cannot see by themselves."""

from __future__ import annotations

from lslam.config import Config
from lslam.errors import UsageError, nearest
from lslam.evaluation.relative import parse_delta
from lslam.odometry import FEATURE_METHODS, METHODS, known_methods


def check_config(config: Config) -> None:
    """Raise UsageError for a method or an RPE distance that does not exist: before hours of work, not after."""
    method = config.odometry.method
    if method not in (known := known_methods()):
        raise UsageError(f"no method {method!r}; {nearest(method, known)}")
    if config.map.write_features and method not in FEATURE_METHODS:
        raise UsageError(f"method {method} has no feature map to save; these have: {', '.join(FEATURE_METHODS)}")
    for delta in config.eval.delta:
        parse_delta(delta)


def check_residual(config: Config) -> None:
    """Raise UsageError when --residual is given with a method that measures in its own way."""
    method = config.odometry.method
    if METHODS.get(method, ("",))[0] != METHODS["icp"][0]:
        raise UsageError(
            f"--residual is for --method icp, not {method!r}, which measures in its own way: drop one of them"
        )
