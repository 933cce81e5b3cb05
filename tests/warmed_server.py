"""The server that forks the runs of studies: it has imported what they need, and loaded the kernels of the default method."""

from __future__ import annotations

from compiled_once import compile_once

import lslam.pipeline.run
import lslam.studies.worker  # noqa: F401
from lslam.core.config import Config
from lslam.odometry import create_odometry
from lslam.pipeline import precompile

compile_once()
create_odometry(Config()).warm_up()
precompile.compile_ahead(Config(), ["method", "loops", "map"])
