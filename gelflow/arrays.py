"""Names of the arrays that gelflow's functions exchange: tensors whose alias states shape, dtype and unit.

B: batch, C: channels, H and W: rows and columns of the image or of the scale in question.
"""

from typing import Annotated

from torch import Tensor

Images = Annotated[Tensor, "(B, 3, H, W) float32 in [0, 1]"]
Features = Annotated[Tensor, "(B, C, H, W) float32"]
Flow = Annotated[Tensor, "(B, 2, H, W) float32, (U, V) in px of this scale; NaN in a true flow where no gel is seen"]
Mask = Annotated[Tensor, "(B, 1, H, W) float32, 1 where the pixel counts and 0 where it does not"]
Scalar = Annotated[Tensor, "() float32"]
