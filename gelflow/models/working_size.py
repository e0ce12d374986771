"""The size at which a network works on large images: one at which their pattern is as fine as in its training.

At 320 x 240 px, dots of real gels lie 15 to 35 px apart. In an image of twice that size a network takes dots for their
neighbours, and what is between them is beyond the windows of registration and uncertainty, which are in px. Reducing
such images costs a fine pattern its detail, so that the pattern decides, by its mean wavelength at that size,

    2 pi (sum t^2 / sum |grad t|^2)^(1/2),

t the grey image less its background, over its local contrast.
"""

import math

import torch

from gelflow.arrays import Images
from gelflow.config import MINIMUM_SIDE
from gelflow.ops.gaussian import smoother
from gelflow.ops.pyramid import resize_images

LARGE = 400 * 300
"""Images of no more pixels are used as they are."""
LEAST, MOST = 320 * 240, 640 * 480
"""Limits to the pixels of a reduced image."""
WAVELENGTH_PX, STEEPNESS = 12.5, 2
"""An image of LEAST pixels whose pattern is finer is enlarged by that power of the ratio: speckle to almost twice its
size, dots a quarter of the width apart not at all."""
ALMOST = 0.9
"""A reduction to more than this share of the sides would only blur the image, and is left out."""
BACKGROUND_PX = 8.0
"""Standard deviation of the Gaussian under which the background is found; twice that for the contrast."""
MIN_CONTRAST = 1e-3


def working_size(images: Images) -> tuple[int, int]:
    """Rows and columns for images (B, 3, H, W) in [0, 1], at most their own."""
    height, width = images.shape[-2:]
    pixels = height * width
    if pixels <= LARGE:
        return height, width
    least = max(math.sqrt(LEAST / pixels), MINIMUM_SIDE / min(height, width))
    wavelength = _wavelength(resize_images(images, _scaled(images, least)))
    most = min(1.0, math.sqrt(MOST / pixels))
    scale = max(least, min(most, least * (WAVELENGTH_PX / wavelength) ** STEEPNESS))
    return _scaled(images, scale) if scale < ALMOST else (height, width)


def _scaled(images: Images, scale: float) -> tuple[int, int]:
    return round(scale * images.shape[-2]), round(scale * images.shape[-1])


def _wavelength(images: Images) -> float:
    """In px; as small as a pixel where there is no pattern."""
    grey = images.mean(dim=1, keepdim=True)
    texture = grey - smoother(grey, BACKGROUND_PX)(grey)
    texture = texture / smoother(grey, 2 * BACKGROUND_PX)(texture.square()).clamp(min=MIN_CONTRAST**2).sqrt()
    slope = sum(part.square().sum() for part in torch.gradient(texture, dim=(-2, -1)))
    return max(1.0, float(2 * math.pi * (texture.square().sum() / slope).sqrt())) if slope > 0 else 1.0
