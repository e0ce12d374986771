"""Gaussian windows as matrices, against convolutions and closed forms."""

import math

import torch
from scipy.ndimage import gaussian_filter1d

from gelflow.ops.gaussian import smoother, window_sums

LIKE = torch.zeros((), dtype=torch.float64)


def test_sums_are_those_of_a_convolution_with_zeros_beyond_the_border() -> None:
    """Fails with the two axes exchanged, and with sums divided by the window's."""
    field = torch.rand(2, 3, 21, 34, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = window_sums(21, 34, 2.5, LIKE)(field).numpy()
    expected = field.numpy()
    for axis in (-1, -2):
        # scipy's window ends at int(truncate * s + 0.5) px, ours at ceil(3 s) = 8, and has the sum one.
        height = sum(math.exp(-(k**2) / (2 * 2.5**2)) for k in range(-8, 9))
        expected = height * gaussian_filter1d(expected, 2.5, axis=axis, mode="constant", truncate=8 / 2.5)
    torch.testing.assert_close(torch.from_numpy(expected), torch.from_numpy(found), rtol=1e-12, atol=1e-12)


def test_smoothing_keeps_affine_fields_up_to_the_border() -> None:
    """Fails with the border repeated, and with it mirrored, beyond the image."""
    y, x = torch.meshgrid(torch.arange(20.0).double(), torch.arange(30.0).double(), indexing="ij")
    field = torch.stack([3 + 0.2 * x - 0.1 * y, x * y])[None]
    # Both are affine along each axis. That of 8 px would reach beyond the other border.
    for deviation in (3.0, 8.0):
        torch.testing.assert_close(smoother(20, 30, deviation, LIKE)(field), field, rtol=1e-12, atol=1e-11)


def test_smoothing_weakens_waves_as_a_gaussian_does() -> None:
    wave = torch.cos(0.4 * torch.arange(121.0, dtype=torch.float64)).view(1, 1, 1, -1).expand(1, 1, 4, -1)
    found = smoother(4, 121, 2.0, LIKE)(wave)
    # exp(-s² k² / 2) = 0.726; the window's end at 3 s leaves out 0.3 % of the Gaussian, as does the sum over pixels.
    torch.testing.assert_close(found[..., 20:-20], math.exp(-0.32) * wave[..., 20:-20], rtol=0, atol=5e-3)


def test_no_smoothing_is_the_identity() -> None:
    field = torch.rand(1, 2, 5, 7, dtype=torch.float64)
    torch.testing.assert_close(smoother(5, 7, 0.0, LIKE)(field), field, rtol=0, atol=0)
