"""Names of the arrays that gelflow's functions exchange; each alias states shape, dtype and unit.

Inside the network data are tensors with channels first: B pairs of a batch, C channels, H rows and W columns of the
image or of the scale in question. Around it they are NumPy rasters with channels last.
"""

from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

Images = Annotated[Tensor, "(B, 3, H, W) float32 in [0, 1]"]
Features = Annotated[Tensor, "(B, C, H, W) float32"]
Flow = Annotated[Tensor, "(B, 2, H, W) float32, (U, V) in px of this scale; NaN in a true flow where no gel is seen"]
Mask = Annotated[Tensor, "(B, 1, H, W) float32, 1 where the pixel counts and 0 where it does not"]
Scalar = Annotated[Tensor, "() float32"]

ImageArray = Annotated[NDArray[np.float32], "(H, W, 3) float32, RGB in [0, 1]"]
Bytes3 = Annotated[NDArray[np.uint8], "(H, W, 3) uint8, RGB"]
Frame = Annotated[NDArray[np.uint8] | NDArray[np.uint16], "(H, W, 3), RGB of 8 or 16 bits"]
Grey8 = Annotated[NDArray[np.uint8], "(H, W) uint8"]
FlowArray = Annotated[NDArray[np.float32], "(H, W, 2) float32, (U right, V down) in px; NaN where no gel is seen"]
MapArray = Annotated[NDArray[np.float32], "(H, W) float32"]
MaskArray = Annotated[NDArray[np.bool_], "(H, W) bool"]
PointArray = Annotated[NDArray[np.float64], "(N, 2) float64: column, row in px from the centre of the first pixel"]
MarkerArray = Annotated[NDArray[np.float64], "(N, 4) float64: x1, y1, x2, y2 in px"]


class Estimate(NamedTuple):
    """A flow (H, W, 2) px, and how certain it is, both (H, W) float32.

    Sigma is the radius in px within which 68 % of such flows are right, at most 10; `visible` the probability that the
    pixel's point is seen in image 2.
    """

    flow: FlowArray
    sigma: MapArray
    visible: MapArray
