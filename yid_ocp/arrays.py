"""Types of NumPy arrays of floats, integers and booleans, and of three numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
Vector3 = tuple[float, float, float]
