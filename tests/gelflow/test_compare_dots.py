"""Dots found in both images: where they are, how near a flow leads, and what is no pattern of dots."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from textures import REAL, grid, moved

from gelflow.arrays import ImageArray, PointArray
from gelflow.compare.dots import Dots, dot_distance, find_dots
from gelflow.compare.metrics import closure
from gelflow.files.image import read_image

PITCH = 24.0


def lattice(shift: tuple[float, float] = (0.0, 0.0)) -> PointArray:
    """8 x 6 places, slightly off a grid, that all remain in an image of 240 x 200 px when moved by some px."""
    columns, rows = np.meshgrid(30 + PITCH * np.arange(8), 35 + PITCH * np.arange(6))
    points = np.stack([columns.ravel(), rows.ravel()], axis=1)
    return points + np.random.default_rng(0).uniform(-0.5, 0.5, points.shape) + shift


def image(dots: PointArray, contrast: float) -> ImageArray:
    """Discs of 5 px with a soft edge on a slope of brightness; darker than the coating or, below 0, brighter."""
    x, y = grid(200, 240)
    value = 0.5 + 0.1 * x / 240 + np.zeros_like(y)
    for column, row in dots:
        value -= contrast / (1 + np.exp(2 * (np.hypot(x - 0.5 - column, y - 0.5 - row) - 5)))
    return np.repeat(value[..., None], 3, axis=2).astype(np.float32)


def constant(u: float, v: float) -> NDArray[np.float32]:
    return np.full((200, 240, 2), (u, v), np.float32)


@pytest.mark.parametrize("contrast", [0.4, 0.15, -0.3])
def test_centres_of_dots_are_found_and_the_true_flow_leads_to_them(contrast: float) -> None:
    true, shift = lattice(), (3.3, -2.6)
    dots1, dots2 = find_dots(image(true, contrast)), find_dots(image(lattice(shift), contrast))
    assert len(dots1.centres) == len(dots2.centres) == len(true)
    distance = np.linalg.norm(dots1.centres[:, None] - true, axis=2).min(axis=1)
    # Images of 8 bit: a centroid over 100 px of contrast 38 of 255 errs by about 0.3 * 5 / (38 * sqrt(100)) = 0.004 px.
    assert distance.max() < 0.02
    found = dot_distance(constant(*shift), dots1, dots2)
    assert (found.own, found.median_px, found.p90_px) == (1.0, pytest.approx(0, abs=0.02), pytest.approx(0, abs=0.03))
    still = dot_distance(constant(0, 0), dots1, dots2)
    assert still.median_px == pytest.approx(np.hypot(*shift), abs=0.01)


def test_share_of_dots_that_reach_one_of_their_own() -> None:
    """Of a flow of zero: two dots share one of image 2, one is too far from any, one leaves the image."""
    flow = constant(0, 0)
    dots2 = Dots(np.array([[20.0, 20.0], [44.0, 20.0], [68.0, 20.0], [92.0, 20.0]]), 10.0)
    dots1 = Dots(np.array([[21.0, 20.0], [18.0, 20.0], [44.0, 20.5], [75.0, 20.0], [220.0, 100.0]]), 10.0)
    flow[100, 220] = [11.0, 0.0]
    found = dot_distance(flow, dots1, dots2)
    assert (found.median_px, found.own) == (1.5, 2 / 5)
    assert dot_distance(constant(300, 0), dots1, dots2) is None


def test_textures_bare_gels_and_few_dots_are_no_pattern_of_dots() -> None:
    generator = np.random.default_rng(0)
    x, y = grid(200, 240)
    speckle = image(generator.uniform(5, 195, (300, 2)), 0.1)
    shade = np.repeat((0.5 + 0.3 * np.exp(-((x - 100) ** 2 + (y - 90) ** 2) / 800))[..., None], 3, axis=2)
    for other in (speckle, moved(200, 240, 0, 0), shade.astype(np.float32), image(lattice()[:11], 0.4)):
        assert find_dots(other) is None
    assert find_dots(image(lattice()[:12], 0.4)) is not None


@pytest.mark.parametrize(
    ("name", "dots"), [("tac3d", True), ("dmtac", False), ("gelsight_bare", False), ("9dtact", False), ("digit", False)]
)
def test_real_sensors_with_dots_and_without(name: str, dots: bool) -> None:
    folder = REAL.parent / "other_sensors" / name
    if not folder.is_dir():
        pytest.skip(f"photographs of {name} are not beside this repository")
    files: list[Path] = sorted(folder.glob("*.png"))
    assert [find_dots(read_image(file)) is not None for file in files] == [dots] * len(files)


def test_closure_of_a_rotation_and_its_inverse_and_of_a_jump_by_a_pitch() -> None:
    x, y = (place - 0.5 for place in grid(60, 80))
    centred = np.stack([x - 39.5, y - 29.5], axis=-1)
    turn = np.array([[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]])
    there, back = (centred @ (m - np.eye(2)).T for m in (turn, turn.T))
    gap = closure(there.astype(np.float32), back.astype(np.float32))
    # A linear field is interpolated exactly, in float32; corners leave the image.
    assert np.nanmax(gap) < 1e-5
    assert 0 < np.isnan(gap).sum() < 0.2 * gap.size
    back[..., 0] += PITCH
    gap = closure(there.astype(np.float32), back.astype(np.float32))
    np.testing.assert_allclose(np.nanmedian(gap), PITCH, rtol=1e-5)
