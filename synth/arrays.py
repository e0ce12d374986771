"""Named array types. Every array of lengths is in mm and float64 unless its docstring says otherwise."""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
"""float64."""
Points: TypeAlias = NDArray[np.float64]
"""(n, 3) float64, mm."""
Projection: TypeAlias = Callable[[Points], Points]
"""Moves points (n, 3) onto a surface."""
Pixels: TypeAlias = NDArray[np.float64]
"""(n, 2) float64, px; the centre of pixel (row r, column c) is (c + 0.5, r + 0.5)."""
Triangles: TypeAlias = NDArray[np.int32]
"""(f, 3) int32, indices of vertices."""
Tets: TypeAlias = NDArray[np.int32]
"""(m, 4) int32, indices of vertices, positively oriented."""
BoolArray: TypeAlias = NDArray[np.bool_]
Image: TypeAlias = NDArray[np.float32]
"""(H, W, C) float32, linear radiance or reflectance."""
