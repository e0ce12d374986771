"""Names of the NumPy arrays that the code around the network exchanges: rasters of rows and columns, channels last.

H and W are rows and columns. Inside the network the same data are tensors with channels first (`gelflow.arrays`).
"""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

ImageArray = Annotated[NDArray[np.float32], "(H, W, 3) float32, RGB in [0, 1]"]
Bytes3 = Annotated[NDArray[np.uint8], "(H, W, 3) uint8, RGB"]
Grey8 = Annotated[NDArray[np.uint8], "(H, W) uint8"]
FlowArray = Annotated[NDArray[np.float32], "(H, W, 2) float32, (U right, V down) in px; NaN where no gel is seen"]
MaskArray = Annotated[NDArray[np.bool_], "(H, W) bool"]
MarkerArray = Annotated[NDArray[np.float64], "(N, 4) float64: x1, y1, x2, y2 in px"]
