"""Errors in the picture, of fields made by hand."""

from pathlib import Path

import numpy as np
import pytest
from tiny_scene import TEXT, write_tiny

from synth.bench.budget_field import LEAST_SEEN, picture_errors, places
from synth.scene.sampling import draw
from synth.scene.template import load_scene
from synth.simulate.resolution import scale_px_per_mm


def test_errors_of_known_fields(tmp_path: Path) -> None:
    """A shift along the face is one of the picture. Fails with the mean in place of the root mean square."""
    scene = draw(load_scene(write_tiny(tmp_path, TEXT)), 2, 0)
    points, scale = places(scene), scale_px_per_mm(scene)
    camera, size = scene.sensor.camera, scene.sensor.gel.size_mm
    # Of the pad's points those in the picture: the picture's share of the pad's area, within a row and a column.
    share = camera.width * camera.height / scale**2 / (size[0] * size[1])
    assert len(points) == pytest.approx(share * 81 * 67, rel=0.05)
    zero = np.zeros((3, len(points), 3))
    moved = zero.copy()
    moved[0] += (0.03, 0.04, 0.0)
    half = np.arange(len(points)) % 2 == 0
    moved[1, half] += (0.0, 0.1, 0.0)
    found, shares = picture_errors(moved, zero, scene)
    # At most one of the some 30 rows of points in the picture slides out of it.
    assert shares.min() > 0.95
    assert shares[2] == 1
    # The magnification is the same all over the face, to the 1e-3 by which slanted rays refract otherwise.
    np.testing.assert_allclose(found, [0.05 * scale, 0.1 * scale * np.sqrt(half.mean()), 0], rtol=5e-3)


@pytest.mark.parametrize("name", ["gelslim", "tac3d"])
def test_what_slides_out_of_the_picture_does_not_count(name: str) -> None:
    """By a mirror: a shift of the whole face is one of the picture, whichever points it takes beyond the mirror's end.

    Fails with all points of `places` taken in both states: 33 px for the 5 of `gelslim` (a point that is past the
    mirror in one of them is found 300 px away), none for `tac3d` (hidden there, it is nowhere).
    """
    scene = draw(load_scene(name), 3, 1)
    scale, zero = scale_px_per_mm(scene), np.zeros((3, len(places(scene)), 3))
    moved = zero + np.array([(0.3, 0.0, 0.0), (0.0, -0.3, 0.0), (0.0, 6.0, 0.0)])[:, None]
    found, shares = picture_errors(moved, zero, scene)
    # Two mirrors at 45 degrees to the view fold it without changing its magnification; drawn tilts of some 0.01 rad
    # do, by the square root of that squared.
    np.testing.assert_allclose(found[:2], 0.3 * scale, rtol=5e-3)
    # 0.3 mm are 3 % of the half of a picture that is 10 mm wide; 6 mm are most of its height, so that too few are left.
    assert (shares[:2] > 0.9).all()
    assert (shares[:2] < 1).all()
    assert shares[2] < LEAST_SEEN
    assert np.isnan(found[2])
