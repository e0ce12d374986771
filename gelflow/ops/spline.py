"""Images between their pixels by cubic B-splines, for shifts of hundredths of a pixel.

The spline passes through every pixel: ``I(x) = sum_k c_k beta(x - k)``, beta the centred cubic B-spline and c what
``c_(k-1) + 4 c_k + c_(k+1) = 6 I_k`` makes of the image, mirrored about its border's pixels. Torch's bicubic kernel
(Keys 1981 with A = -0.75) has one and a half times the image's slope at its pixels: a flow that is fitted through it is
off by up to 0.04 px, and an image that is moved by it lies that far from where it should.

Unser, "Splines: a perfect fit for signal and image processing", 1999; the value as four bilinear samples: Sigg and
Hadwiger, "Fast third-order texture filtering", GPU Gems 2, 2005.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from gelflow.arrays import Features

MARGIN = 2
"""Coefficients beyond each border: a cubic B-spline reaches two px."""
POLE = math.sqrt(3) - 2
"""Of the filter from samples to coefficients, whose response to one pixel is sqrt(3) POLE^|distance|."""


class SplineImage:
    """An image that can be sampled anywhere.

    Args:
        image: (B, C, H, W), sides of at least 3 px.
    """

    def __init__(self, image: Features) -> None:
        height, width = image.shape[-2:]
        with torch.autocast(image.device.type, enabled=False):  # bfloat16 keeps three digits
            coefficients = _prefilter(height, image) @ image @ _prefilter(width, image).T
        self._coefficients = F.pad(coefficients, (MARGIN,) * 4, mode="reflect")
        self._size = (height, width)

    def at(self, x: Tensor, y: Tensor) -> Features:
        """The image at places in it; outside, the nearest value of its border.

        Args:
            x: (B, H', W'), finite, px from the centre of the first pixel.
            y: The same shape.

        Returns:
            (B, C, H', W').
        """
        height, width = self._size
        across, down = _linear_taps(x.clamp(0, width - 1)), _linear_taps(y.clamp(0, height - 1))
        samples = [((u * v).unsqueeze(1), self._bilinear(left, top)) for u, left in across for v, top in down]
        return torch.stack([share * value for share, value in samples]).sum(dim=0)

    def _bilinear(self, x: Tensor, y: Tensor) -> Features:
        height, width = self._coefficients.shape[-2:]
        grid = torch.stack([(2 * (x + MARGIN) + 1) / width - 1, (2 * (y + MARGIN) + 1) / height - 1], dim=-1)
        return F.grid_sample(self._coefficients, grid, mode="bilinear", align_corners=False)


def _prefilter(pixels: int, like: Tensor) -> Tensor:
    """Matrix (n, n) from samples to the coefficients of the spline through them.

    Beyond the border lies the image mirrored, and so on with a period of P = 2 n - 2: a pixel counts at all distances
    ``d - m P``, together ``(z^d + z^(P - d)) / (1 - z^P)``, and once more for its mirror image.
    """
    period = 2 * pixels - 2
    distance = torch.arange(period + 1, dtype=torch.float64, device=like.device)
    response = math.sqrt(3) * (POLE**distance + POLE ** (period - distance)) / (1 - POLE**period)
    place = torch.arange(pixels, device=like.device)
    direct = response[(place.view(-1, 1) - place).abs()]
    mirrored = response[place.view(-1, 1) + place]
    mirrored = torch.where((place == 0) | (place == pixels - 1), 0.0, mirrored)
    return (direct + mirrored).to(like)


def _linear_taps(place: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Weights and places of two linear interpolations that add up to the four weights of the B-spline."""
    first = place.floor()
    t = place - first
    before, here = (1 - t) ** 3 / 6, (4 - 6 * t**2 + 3 * t**3) / 6
    after, last = (4 - 6 * (1 - t) ** 2 + 3 * (1 - t) ** 3) / 6, t**3 / 6
    left, right = before + here, after + last
    return [(left, first - 1 + here / left), (right, first + 1 + last / right)]
