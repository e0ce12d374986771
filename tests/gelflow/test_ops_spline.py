"""Spline interpolation of images: through every pixel, exact for what a cubic spline can be, and without bias."""

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from torch.nn.functional import grid_sample

from gelflow.ops.spline import SplineImage
from gelflow.ops.warp import positions, warp

GENERATOR = torch.Generator().manual_seed(0)


def test_it_is_scipys_cubic_spline() -> None:
    """Fails with x and y exchanged in the flow, and with the coefficients' margin left out of the sampled place."""
    image = torch.rand(1, 2, 17, 23, generator=GENERATOR, dtype=torch.float64)
    flow = 6 * torch.rand(1, 2, 17, 23, generator=GENERATOR, dtype=torch.float64) - 3
    rows, columns = np.mgrid[:17, :23].astype(float)
    places = [np.clip(rows + flow[0, 1].numpy(), 0, 16), np.clip(columns + flow[0, 0].numpy(), 0, 22)]
    found = SplineImage(image).at(positions(flow))[0].numpy()
    for channel in range(2):
        expected = map_coordinates(image[0, channel].numpy(), places, order=3, mode="mirror")
        np.testing.assert_allclose(found[channel], expected, rtol=0, atol=1e-12)


def test_no_flow_gives_the_image_and_the_border_goes_on_outside() -> None:
    image = torch.rand(2, 3, 9, 8, generator=GENERATOR)
    still = torch.zeros(2, 2, 9, 8)
    # float32: a matrix of condition 3 and its inverse, and places in an image of a few px.
    torch.testing.assert_close(warp(image, still, "spline"), image, rtol=0, atol=4e-6)
    far = warp(image, still + 100, "spline")
    torch.testing.assert_close(far, image[..., -1:, -1:].expand_as(image), rtol=0, atol=2e-6)


def test_lowered_precision_does_not_reach_it() -> None:
    """Fails with the products under autocast: three digits."""
    image = torch.rand(1, 3, 12, 10, generator=GENERATOR)
    with torch.autocast("cpu", torch.bfloat16):
        found = warp(image, torch.zeros(1, 2, 12, 10), "spline")
    torch.testing.assert_close(found, image, rtol=0, atol=4e-6)


def test_small_shifts_are_seen_at_their_size() -> None:
    """What registration rests on. Torch's bicubic kernel, beside it, has 1.5 times the slope at the pixels."""
    x = torch.arange(64, dtype=torch.float64).expand(1, 1, 64, 64)
    wave = torch.sin(2 * torch.pi * x / 12)
    flow = torch.zeros(1, 2, 64, 64, dtype=torch.float64)
    flow[:, 0] = 0.05
    expected = torch.sin(2 * torch.pi * (x + 0.05) / 12) - wave
    inside = slice(12, 52)

    def slope(moved: torch.Tensor) -> float:
        change = (moved - wave)[..., inside]
        return float((change * expected[..., inside]).sum() / expected[..., inside].square().sum())

    # The spline's slope at a pixel is off by (k^4 / 180) = 0.04 % at 12 px a wave.
    assert abs(slope(warp(wave, flow, "spline")) - 1) < 1e-3
    grid = torch.stack([(2 * (x[0] + flow[:, 0]) + 1) / 64 - 1, (2 * x[0].mT + 1) / 64 - 1], dim=-1)
    assert abs(slope(grid_sample(wave, grid, mode="bicubic", align_corners=False)) - 1) > 0.2
