"""Batches: each sample as if it were alone, whatever happens to the others.

Each comment "fails with" names a change of `synth.simulate` that was tried.
"""

from pathlib import Path as FilePath
from typing import Any

import pytest
from pads import DRAG, MIXED, PUNCH, brick, gentle, same, scene

from synth.errors import InputError
from synth.scene import Scene
from synth.simulate import simulate, simulate_batch

MESH = brick()
each = pytest.mark.parametrize("element", MIXED)


def scenes(folder: FilePath, element: str) -> list[Scene]:
    """No touch, no friction, friction, a path of four legs, and mesh indenters of unequal grids."""
    import pyvista as pv

    pv.Icosphere(radius=2.5, nsub=3).save(folder / "large.stl")
    pv.Cube(x_length=2.0, y_length=1.5, z_length=1.0).triangulate().save(folder / "small.stl")
    short = {"depth_mm": 0.5, "shear_mm": [0.2, 0.1], "steps": 2}
    large = {"shape": "mesh", "file": "large.stl", "cell_mm": 0.3}
    small = {"shape": "mesh", "file": "small.stl", "cell_mm": 0.25}
    back = {**short, "then": [{"depth_mm": 0.4, "shear_mm": [-0.2, 0.1]}, {"depth_mm": 0.0}], "steps": 4}
    numerics = {"element": element}
    return [
        gentle(motion={**DRAG, "depth_mm": -1.0}, numerics=numerics),
        gentle(friction=0.0, numerics=numerics),
        gentle(gel={"youngs_modulus_kpa": 50.0}, indenter=PUNCH, motion=short, numerics=numerics),
        gentle(indenter=large, motion=short, numerics=numerics),
        gentle(indenter=small, motion={**short, "position_mm": [-1, 1]}, numerics=numerics),
        gentle(motion=back, numerics=numerics),
    ]


@each
def test_each_of_a_batch_is_as_if_it_were_alone(tmp_path: FilePath, element: str) -> None:
    """Bitwise."""
    # Fails with a strided residual in System.balance, with the smallest det F or the predictor's ratio taken over
    # the batch.
    given = scenes(tmp_path, element)
    together = simulate_batch(given, MESH, tmp_path)
    assert [result.status for result in together] == ["complete"] * len(given)
    for posed, result in zip(given, together, strict=True):
        assert same(simulate(posed, MESH, tmp_path), result)
    if element == "p1p1":
        order = [4, 1, 3, 0, 2, 5]
        for i, result in zip(order, simulate_batch([given[i] for i in order], MESH, tmp_path), strict=True):
            assert same(result, together[i])


def test_batch_must_share_the_pad() -> None:
    with pytest.raises(InputError, match=r"mm pad"):
        simulate(scene((8.0, 6.0, 3.0)), MESH)
    different: list[dict[str, Any]] = [
        {"gel": {"poisson_ratio": 0.45}},
        {"gel": {"stiffening": [0.1, 0.0]}},
        {"numerics": {"penalty": 20.0}},
    ]
    for parts in different:
        with pytest.raises(InputError, match="must share the gel's materials and numerics"):
            simulate_batch([gentle(), gentle(**parts)], MESH)


def test_youngs_modulus_may_differ_where_the_layers_differ_alike() -> None:
    """Deformation depends on ratios of moduli only."""
    # Fails with absolute moduli in `_elastic`.
    film = {"thickness_mm": 1.0, "youngs_modulus_kpa": 600.0}
    soft = gentle(gel={"layers": [film]})
    hard = gentle(gel={"youngs_modulus_kpa": 400.0, "layers": [{**film, "youngs_modulus_kpa": 1200.0}]})
    one, other = simulate_batch([soft, hard], MESH)
    for s, t in zip(one.states, other.states, strict=True):
        assert (s.displacement == t.displacement).all()
        assert t.force_n == pytest.approx([2 * value for value in s.force_n], rel=1e-12)


WIRE = {"shape": "torus", "radius_mm": 1.5, "tube_mm": 0.3}


def test_one_bad_sample_does_not_spoil_its_batch() -> None:
    """A ring of thin wire is pressed through four fifths of a pad whose faces are three times as wide as the wire."""
    numerics = {"edge_length_mm": 0.1}
    hopeless = scene(indenter=WIRE, friction=0.2, motion={"depth_mm": 3.3, "steps": 8}, numerics=numerics)
    lost, kept = simulate_batch([hopeless, gentle(numerics=numerics)], MESH)
    assert lost.status == "partial"
    assert same(kept, simulate(gentle(numerics=numerics), MESH))
