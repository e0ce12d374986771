"""Functions on faces that are nearest (L²) to samples on them."""

from typing import Any

import numpy as np

from synth.arrays import BoolArray, Image


def projected(values: list[Any], weights: tuple[Any, Any, Any], count: int, is_linear: BoolArray) -> Image:
    """Corner values (faces, channels, 3) of the functions nearest to samples of evenly distributed points.

    The corners' functions φ have the mass matrix A/12 (1 + I), whose inverse makes of the means m_i of φ_i f the
    values 12 m_i - 3 Σ m. The nearest constant is Σ m, since Σ φ = 1.
    """
    import drjit as dr

    parts = [value * weight for value in values for weight in weights]
    dr.eval(parts)
    means = np.stack([np.array(dr.block_sum(part, count)) for part in parts], axis=-1) / count
    means = means.reshape(-1, len(values), 3)
    whole = means.sum(axis=2, keepdims=True)
    return np.where(is_linear[:, None, None], 12 * means - 3 * whole, whole).astype(np.float32)
