"""Samples as synth writes them, without simulation: moving waves, random flow and visibility beside them."""

from dataclasses import replace

import numpy as np
from samples import translation_sample
from textures import moved

from synth.dataset.sample import Sample
from synth.flow.field import FlowField

SIDE = 64


def synth_sample(index: int, dtype: type = np.uint8, backward: bool = True) -> Sample:
    """An exchange of any two arrays shows, and of rows or columns; the first rows and columns see no gel."""
    rng, full = np.random.default_rng(index), np.iinfo(dtype).max
    images = [np.rint(full * moved(SIDE, SIDE, k * 1.5, -k, seed=index)).astype(dtype) for k in (0, 1)]
    flows = rng.normal(0, 2, (2, SIDE, SIDE, 2)).astype(np.float32)
    seen = (rng.random((2, SIDE, SIDE)) < 0.7).astype(np.float32)
    flows[:, :4, :9], seen[:, :4, :9] = np.nan, 0
    flow = FlowField(flows[0], seen[0], flows[1], seen[1]) if backward else FlowField(flows[0], seen[0])
    return replace(translation_sample(index), image1=images[0], image2=images[1], flow=flow)
