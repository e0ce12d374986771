r"""The gel's constitutive law: neo-Hookean or Yeoh, compressible to exactly incompressible, per element.

With s = I_1 - 3 - 2 ln J, which is 0 in the undeformed state and never negative, and pressure p:

.. math::  W = μ/2 (s + c_2 s² + c_3 s³) + p (J - 1) - p²/(2λ)

At J = 1 this is Yeoh's law (Rubber Chem. Technol. 66, 1993) with C10 = μ/2, C20 = c_2 C10, C30 = c_3 C10, and
neo-Hookean where c_2 = c_3 = 0. λ = ∞ makes it exactly incompressible. Without a pressure field the last two terms are
λ/2 (J - 1)². Lamé's constants are relative to the gel's Young's modulus: the deformation depends on ratios only.
"""

from dataclasses import dataclass

import numpy as np

from synth.arrays import FloatArray
from synth.mesh import PadMesh
from synth.scene import Gel

DISPLACEMENT_ONLY_BELOW = 0.3
"""Poisson ratio under which no pressure field is needed; at 0 the mixed form would not even be defined."""


@dataclass(frozen=True, eq=False)
class Material:
    """Per-element constants in units of a reference Young's modulus: μ (m,), λ (m,), and c_2 and c_3 (m, 2).

    λ is infinite where incompressible, which needs `mixed`: that pressure is a field of its own.
    """

    shear: FloatArray
    lame: FloatArray
    yeoh: FloatArray
    mixed: bool


def lame_constants(poisson_ratio: float) -> tuple[float, float]:
    """μ and λ for E = 1."""
    shear = 1 / (2 * (1 + poisson_ratio))
    if poisson_ratio == 0.5:
        return shear, np.inf
    return shear, poisson_ratio / ((1 + poisson_ratio) * (1 - 2 * poisson_ratio))


def uniform(count: int, poisson_ratio: float, stiffening: tuple[float, float] = (0.0, 0.0)) -> Material:
    """One material of E = 1 in all `count` elements."""
    shear, lame = lame_constants(poisson_ratio)
    return Material(
        np.full(count, shear), np.full(count, lame), np.tile(stiffening, (count, 1)),
        poisson_ratio >= DISPLACEMENT_ONLY_BELOW,
    )  # fmt: skip


def pad_material(gel: Gel, mesh: PadMesh) -> Material:
    """The gel with its layers, relative to the gel's own Young's modulus."""
    bulk = uniform(len(mesh.tets), gel.poisson_ratio, gel.stiffening)
    for number, layer in enumerate(gel.layers):
        inside = mesh.layer == number
        stiffness = layer.youngs_modulus_kpa / gel.youngs_modulus_kpa
        shear, lame = lame_constants(layer.poisson_ratio)
        bulk.shear[inside], bulk.lame[inside] = stiffness * shear, stiffness * lame
        bulk.yeoh[inside] = layer.stiffening
    return bulk
