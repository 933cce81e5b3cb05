"""lslam: batch LiDAR SLAM. The Python API on arrays, which the command line itself uses.

>>> import lslam
>>> sequence = lslam.open_sequence("sample_data")
>>> outcome = lslam.run(sequence, out="runs/first")
>>> lslam.evaluate(outcome.trajectory, sequence.ground_truth).ate["se3"].translation.rmse < 0.01
True
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from lslam.core import __version__

if TYPE_CHECKING:
    from lslam.core.config.config import load_config
    from lslam.evaluation.evaluate import evaluate
    from lslam.io.readers import open_sequence
    from lslam.pipeline.run import run
    from lslam.registration.registration import Registration
    from lslam.simulation.scenarios import simulate
    from lslam.studies.compare import compare

__all__ = ["Registration", "__version__", "compare", "evaluate", "load_config", "open_sequence", "run", "simulate"]

_HOMES = {
    "Registration": ("lslam.registration.registration", "Registration"),
    "compare": ("lslam.studies.compare", "compare"),
    "evaluate": ("lslam.evaluation.evaluate", "evaluate"),
    "load_config": ("lslam.core.config.config", "load_config"),
    "open_sequence": ("lslam.io.readers", "open_sequence"),
    "run": ("lslam.pipeline.run", "run"),
    "simulate": ("lslam.simulation.scenarios", "simulate"),
}


def __getattr__(name: str) -> Any:
    """Import the API's parts when they are asked for, so that `import lslam` costs nothing."""
    if name not in _HOMES:
        raise AttributeError(f"module 'lslam' has no attribute {name!r}")
    from importlib import import_module

    module, attribute = _HOMES[name]
    return getattr(import_module(module), attribute)


def __dir__() -> list[str]:
    """What completion offers: the API, also before it is imported."""
    return sorted(__all__)
