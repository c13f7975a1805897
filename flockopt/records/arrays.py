"""What arrays are called in signatures."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["FloatArray", "IntArray"]

#: Float64 in SI units; the shape is said where one is named.
FloatArray = NDArray[np.float64]

#: Int64: indices and counts.
IntArray = NDArray[np.int64]
