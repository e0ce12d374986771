"""Samples as synth writes them, without simulation: moving waves, random flow and visibility beside them."""

from pathlib import Path

import numpy as np
from textures import moved

from synth.dataset.job import Job
from synth.dataset.sample import Sample
from synth.dataset.writer import DatasetWriter
from synth.flow.field import FlowField
from synth.scene import Scene
from synth.surface import ContactFaces, GelSurface

SIDE = 64
SCENE = {
    "name": "toy",
    "sensor": {
        "gel": {"size_mm": [4.0, 4.0, 1.0], "youngs_modulus_kpa": 100.0},
        "pattern": {"kind": "none"},
        "lights": [{"position_mm": [0.0, 0.0, 0.5], "size_mm": [1.0, 1.0], "color": [1.0, 1.0, 1.0], "power": 1.0}],
        "camera": {"width": SIDE, "height": SIDE, "fx": 80, "fy": 80, "cx": 32, "cy": 32, "position_mm": [0, 0, 20]},
    },
    "contact": {"indenter": {"shape": "sphere", "radius_mm": 1.0}},
    "motion": {"depth_mm": 0.1},
}


def synth_sample(index: int, dtype: type = np.uint8, backward: bool = True) -> Sample:
    """An exchange of any two arrays shows, and of rows or columns; the first rows and columns see no gel."""
    rng = np.random.default_rng(index)
    full = np.iinfo(dtype).max
    images = [np.rint(full * moved(SIDE, SIDE, k * 1.5, -k, seed=index)).astype(dtype) for k in (0, 1)]
    flows = rng.normal(0, 2, (2, SIDE, SIDE, 2)).astype(np.float32)
    seen = (rng.random((2, SIDE, SIDE)) < 0.7).astype(np.float32)
    flows[:, :4, :9], seen[:, :4, :9] = np.nan, 0
    nodes = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float64)
    return Sample(
        index=index, trajectory=0, frames=(0, 1), seed=1, image1=images[0], image2=images[1],
        flow=FlowField(flows[0], seen[0], flows[1], seen[1]) if backward else FlowField(flows[0], seen[0]),
        scene=Scene.model_validate(SCENE), surface=GelSurface(ContactFaces(nodes, np.array([[0, 2, 1]], np.int32))),
        displacement1=np.zeros((3, 3)), displacement2=np.zeros((3, 3)),
    )  # fmt: skip


def write_dataset(folder: Path, samples: list[Sample]) -> Path:
    with DatasetWriter(folder, Job(scene=SCENE, scene_name="toy", scene_hash="0", seed=1, n=9)) as writer:
        for sample in samples:
            writer.write(sample)
    return folder
