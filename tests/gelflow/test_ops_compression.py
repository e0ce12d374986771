"""What compression leaves of an image."""

import numpy as np
import torch
from scipy.fft import dctn

from gelflow.ops.compression import BLOCK_PX, compressed


def test_blocks_of_brightness_are_multiples_of_the_step_and_a_step_of_zero_changes_nothing() -> None:
    grey = 0.25 + 0.5 * torch.rand(2, 1, 24, 40, generator=torch.Generator().manual_seed(1)).expand(-1, 3, -1, -1)
    step = 0.05
    untouched, found = compressed(grey, torch.tensor([0.0, step]))
    assert torch.equal(untouched, grey[0])
    for block in np.split(found[0].double().numpy()[:BLOCK_PX], 5, axis=1):
        waves = dctn(block, norm="ortho") / step
        np.testing.assert_allclose(waves, waves.round(), atol=1e-3)  # of up to 120, in float32
    # Each coefficient errs by half a step at most, and the magnitudes of the 64 cosines at a pixel add up to 8 at most.
    assert 0 < (found - grey[1]).abs().max() < step * BLOCK_PX / 2


def test_chroma_has_half_the_resolution_and_sides_need_not_be_multiples_of_a_block() -> None:
    x = torch.arange(45.0).expand(31, 45)
    stripes = torch.stack([0.5 + 0.3 * (x % 2), 0.5 - 0.1 * (x % 2), torch.full_like(x, 0.5)])[None]
    found = compressed(stripes, torch.tensor([1e-4]))
    assert found.shape == stripes.shape
    difference = (found[:, 0] - found[:, 1])[..., :44].unflatten(-1, (-1, 2))
    assert (difference[..., 0] - difference[..., 1]).abs().max() < 1e-5  # rounding
    flat = torch.tensor([0.3, 0.6, 0.4]).view(1, 3, 1, 1).expand(1, 3, 31, 45)
    # The mean of a block errs by 0.01 / 2 / 8, and a colour by at most 1 + 1.772 times as much.
    assert (compressed(flat, torch.tensor([0.01])) - flat).abs().max() < 0.0018
