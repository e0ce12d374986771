"""Images between their pixels by cubic B-splines, for shifts of hundredths of a pixel.

The spline passes through every pixel: ``I(x) = sum_k c_k beta(x - k)``, beta the centred cubic B-spline and c what
``c_(k-1) + 4 c_k + c_(k+1) = 6 I_k`` makes of the image, mirrored about its border's pixels. Torch's bicubic kernel
(Keys 1981 with A = -0.75) has one and a half times the image's slope at its pixels: a flow that is fitted through it is
off by up to 0.04 px, and an image that is moved by it lies that far from where it should.

Unser, "Splines: a perfect fit for signal and image processing", 1999; the value as four bilinear samples: Sigg and
Hadwiger, "Fast third-order texture filtering", GPU Gems 2, 2005.
"""

import functools
import itertools
import math
from collections.abc import Callable

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from gelflow.arrays import Features
from gelflow.ops.cached import cached
from gelflow.ops.gaussian import is_array

MARGIN = 2
"""Coefficients beyond each border: a cubic B-spline reaches two px."""
POLE = math.sqrt(3) - 2
"""Pole of the filter from samples to coefficients, whose response to one pixel is sqrt(3) POLE^|distance|."""
RESPONSE = (math.sqrt(3) * POLE ** np.abs(np.arange(-14, 15))).astype(np.float32)
"""That response, as far as it is more than 1e-8."""
QUARTER = np.array([1, 121, 235, 27]) / 384
"""The B-spline at 7, 3, 1 and 5 quarters: weights of the coefficients a quarter of a pixel before the third."""
NOTHING = 1e-20
"""Responses of the filter that count as zero."""


class SplineImage:
    """An image that can be sampled anywhere.

    Its sides are at least 3 px long. `at` is exact. `near` takes a tenth of the time: it reads bilinearly between the
    spline's values at the centres of the four quarters of each pixel, which dampens a pattern without moving it.
    """

    def __init__(self, image: Features) -> None:
        self.image, self._size = image, (image.shape[-2], image.shape[-1])

    @functools.cached_property
    def _coefficients(self) -> Features:
        return F.pad(self._along_axes(_prefilter), (MARGIN,) * 4, mode="reflect")

    @functools.cached_property
    def _quarters(self) -> Features:
        if not is_array(self.image):
            return self._along_axes(_to_quarters)
        kernels = [np.pad(QUARTER, (0, 1)).astype(np.float32), np.pad(QUARTER[::-1], (1, 0)).astype(np.float32)]
        quarters = self.image.new_empty(*self.image.shape[:2], *(2 * side for side in self._size))
        planes = self.image.contiguous().flatten(0, 1).numpy()
        for plane, out in zip(planes, quarters.flatten(0, 1).numpy(), strict=True):
            coefficients = cv2.sepFilter2D(plane, -1, RESPONSE, RESPONSE, borderType=cv2.BORDER_REFLECT_101)
            for i, j in itertools.product((0, 1), repeat=2):
                quarter = cv2.sepFilter2D(coefficients, -1, kernels[j], kernels[i], borderType=cv2.BORDER_REFLECT_101)
                out[i::2, j::2] = quarter
        return quarters

    def _along_axes(self, matrix: Callable[[int, torch.dtype, torch.device], Tensor]) -> Features:
        down, across = (matrix(pixels, self.image.dtype, self.image.device) for pixels in self._size)
        with torch.autocast(self.image.device.type, enabled=False):  # bfloat16 keeps three digits
            return down @ self.image @ across.T

    def at(self, places: Tensor) -> Features:
        """The image (B, C, H', W') at places in it; outside, the nearest value of its border.

        Places (B, 2, H', W') are x and y, finite, in px from the centre of the first pixel.
        """
        height, width = self._size
        x, y = places[:, 0].clamp(0, width - 1), places[:, 1].clamp(0, height - 1)
        weights, taps = _linear_taps(torch.stack([x, y], dim=1))
        shares = weights[:, :, 1].unsqueeze(2) * weights[:, :, 0].unsqueeze(1)
        sampled = self._bilinear(taps[:, :, 0], taps[:, :, 1])
        return (sampled * shares.flatten(1, 2).unsqueeze(1)).sum(dim=2)

    def near(self, places: Tensor) -> Features:
        """Nearly the same."""
        if places.is_cuda:
            from gelflow.ops import kernels

            return kernels.sampled(self._quarters, places, 2.0)
        height, width = self._size
        sides = places.new_tensor([width, height]).view(2, 1, 1)
        grid = torch.addcmul(1 / sides - 1, places, 2 / sides).movedim(1, -1)
        sampled: Tensor = F.grid_sample(self._quarters, grid, padding_mode="border", align_corners=False)
        return sampled

    def _bilinear(self, x: Tensor, y: Tensor) -> Features:
        """At all pairs of two x and two y of each place, both (B, 2, H', W'): (B, C, 4, H', W'), y by y."""
        height, width = self._coefficients.shape[-2:]
        batch, _, rows, columns = x.shape
        across = (2 / width) * x + ((2 * MARGIN + 1) / width - 1)
        down = (2 / height) * y + ((2 * MARGIN + 1) / height - 1)
        all_pairs = (batch, 2, 2, rows, columns)
        grid = torch.stack([across.unsqueeze(1).expand(all_pairs), down.unsqueeze(2).expand(all_pairs)], dim=-1)
        sampled: Tensor = F.grid_sample(
            self._coefficients, grid.view(batch, 4 * rows, columns, 2), mode="bilinear", align_corners=False
        )
        return sampled.unflatten(2, (4, rows))


@cached
def _prefilter(pixels: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Matrix (n, n) from samples to the coefficients of the spline through them.

    Beyond the border lies the image mirrored, and so on with a period of P = 2 n - 2: a pixel counts at all distances
    ``d - m P``, together ``(z^d + z^(P - d)) / (1 - z^P)``, and once more for its mirror image.
    """
    period = 2 * pixels - 2
    distance = torch.arange(period + 1, dtype=torch.float64, device=device)
    response = math.sqrt(3) * (POLE**distance + POLE ** (period - distance)) / (1 - POLE**period)
    # In float32 they would become denormal numbers, with which a processor takes twenty times as long.
    response[response.abs() < NOTHING] = 0.0
    place = torch.arange(pixels, device=device)
    direct = response[(place.view(-1, 1) - place).abs()]
    mirrored = response[place.view(-1, 1) + place]
    mirrored = torch.where((place == 0) | (place == pixels - 1), 0.0, mirrored)
    return (direct + mirrored).to(dtype)


@cached
def _to_quarters(pixels: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Matrix (2 n, n) from samples to the values of the spline a quarter of a pixel before and after each."""
    coefficients = _prefilter(pixels, torch.float64, device)
    coefficients = F.pad(coefficients.T[None], (MARGIN, MARGIN), mode="reflect")[0].T
    near = coefficients.unfold(0, 4, 1)  # (n + 1, n, 4), the first of them before the first pixel
    weights = torch.from_numpy(QUARTER).to(device)
    return torch.stack([near[:-1] @ weights, near[1:] @ weights.flip(0)], dim=1).flatten(0, 1).to(dtype)


def _linear_taps(places: Tensor) -> tuple[Tensor, Tensor]:
    """Weights and places, each (B, 2, ...), of two linear interpolations that make the four weights of the B-spline."""
    first = places.floor()
    t = places - first
    square = t * t
    # Six times the weights at first - 1 and first together, of `first` alone, and at first + 2.
    left, here, last = ((2 * t - 3) * t - 3) * t + 5, (3 * t - 6) * square + 4, square * t
    right = 6 - left
    taps = torch.stack([first - 1 + here / left, first + 1 + last / right], dim=1)
    return torch.stack([left, right], dim=1) / 6, taps
