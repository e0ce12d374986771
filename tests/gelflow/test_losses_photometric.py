"""Photometric loss: zero and minimal where it should be, masked, with correct gradients."""

import pytest
import torch
from waves import moved_pair, press_flow

from gelflow.losses.photometric import C1, C2, appearance_loss, photometric_loss, structural_similarity
from gelflow.ops.pyramid import flow_pyramid, image_pyramid
from gelflow.ops.warp import warp


def test_structural_similarity_follows_its_definition() -> None:
    first, second = torch.rand(2, 1, 1, 5, 6, dtype=torch.float64)
    for row, column in ((2, 3), (0, 0)):
        rows, columns = slice(max(row - 1, 0), row + 2), slice(max(column - 1, 0), column + 2)
        a, b = first[0, 0, rows, columns].flatten(), second[0, 0, rows, columns].flatten()
        covariance = ((a - a.mean()) * (b - b.mean())).mean()
        expected = (2 * a.mean() * b.mean() + C1) * (2 * covariance + C2)
        expected = expected / (a.mean() ** 2 + b.mean() ** 2 + C1) / (a.var(correction=0) + b.var(correction=0) + C2)
        # differences of squares of size 1 over at least C2 = 9e-4, in double precision
        assert abs(structural_similarity(first, second)[0, 0, row, column] - expected) < 1e-11


def test_equal_images_and_no_flow_cost_nothing() -> None:
    image = torch.rand(1, 3, 12, 15, dtype=torch.float64)
    loss = photometric_loss(image, image, torch.zeros(1, 2, 12, 15, dtype=torch.float64))
    # warping errs by 1e-14; SSIM is 1 up to 1e-14 / C2
    assert 0 <= loss + 1e-11 < 2e-11


@pytest.mark.parametrize("largest", [2.0, 4.0])
def test_the_true_flow_scores_better_than_none_and_than_a_tenth_more_or_less_at_every_scale(largest: float) -> None:
    flow = press_flow(120, 160, largest)
    images = [image_pyramid(image[None], 3) for image in moved_pair(flow, seed=3, shortest=16, longest=48)]
    for scale, true in enumerate(flow_pyramid(flow[None], 3)):
        losses = {f: photometric_loss(images[0][scale], images[1][scale], f * true).item() for f in (0, 0.9, 1, 1.1)}
        assert losses[1] < min(losses[0.9], losses[1.1]) < losses[0]


def test_pixels_that_leave_the_image_do_not_count() -> None:
    flow = torch.zeros(2, 64, 64, dtype=torch.float64)
    flow[0] = 10
    image1, image2 = (image[None] for image in moved_pair(flow, seed=4))
    assert photometric_loss(image1, image2, flow[None]) < 1e-9  # an integer shift: exact but for rounding, as above
    assert appearance_loss(image1, warp(image2, flow[None]), torch.ones(1, 1, 64, 64), 0.85) > 0.01
    assert photometric_loss(image1, image2, flow[None] * 100) == 0  # nothing left to judge by


def test_a_pixel_is_enough() -> None:
    image1, image2 = torch.rand(2, 1, 3, 1, 1, dtype=torch.float64)
    loss = photometric_loss(image1, image2, torch.zeros(1, 2, 1, 1, dtype=torch.float64), alpha=0)
    assert abs(loss - (image1 - image2).abs().mean()) < 1e-15
