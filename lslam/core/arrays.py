"""Types of arrays, named once: what an element is."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Points = NDArray[np.float32]
Longs = NDArray[np.int64]
Ints = NDArray[np.int32]
Rings = NDArray[np.uint16]
Stamps = NDArray[np.int64]  # ns
Bools = NDArray[np.bool_]
