"""Error of the simulated flow against run time: one press on ever finer meshes, compared with the finest.

python examples/error_against_time.py --targets 0.4 0.2 0.1 0.05 --out data/error
"""

from argparse import ArgumentParser
from pathlib import Path

import numpy as np

import synth

parser = ArgumentParser(description=__doc__)
parser.add_argument("--targets", type=float, nargs="+", default=[0.4, 0.2, 0.1, 0.05], help="px, descending")
parser.add_argument("--out", type=Path, default=Path("data/error"))
given = parser.parse_args()

# Fixed numbers replace all distributions that the flow depends on: with another target, other values would be sampled.
PRESS = [
    'contact.indenter={ shape = "sphere", radius_mm = 4.0 }', "contact.friction=0.6", "motion.depth_mm=1.0",
    "motion.position_mm=[0.0, 0.0]", "motion.shear_mm=[0.5, 0.0]", "motion.twist_deg=0.0", "render.samples_per_pixel=4",
    "sensor.gel.youngs_modulus_kpa=200.0", "sensor.camera.cx=160.0", "sensor.camera.cy=120.0",
]  # fmt: skip

flows, seconds = [], []
for target in given.targets:
    scene = synth.load_scene("gelsight_mini", set=[*PRESS, f"numerics.target_error_px={target}"])
    out = given.out / f"target_{target:g}"
    synth.generate(scene, n=1, out=out, seed=0)
    dataset = synth.read_dataset(out)
    flows.append(dataset.read(0).forward)
    seconds.append(dataset.entry(0).seconds["simulate"])

print("target px   against the finest px (rms)   simulation s")
for target, flow, time in zip(given.targets, flows, seconds, strict=True):
    print(f"{target:9g}   {np.sqrt(np.nanmean(((flow - flows[-1]) ** 2).sum(axis=-1))):27.3f}   {time:12.2f}")
