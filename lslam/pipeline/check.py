"""What a configuration can get wrong that its sections cannot see by themselves."""

from __future__ import annotations

from lslam.config import Config
from lslam.errors import UsageError, nearest
from lslam.evaluation.relative import parse_delta
from lslam.odometry import known_methods


def check_config(config: Config) -> None:
    """Raise UsageError for a method or an RPE distance that does not exist: before hours of work, not after."""
    method = config.odometry.method
    if method not in (known := known_methods()):
        raise UsageError(f"no method {method!r}; {nearest(method, known)}")
    for delta in config.eval.delta:
        parse_delta(delta)
