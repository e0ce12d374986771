"""Make ten image pairs of a GelSight Mini, read them back, and plot the flow of one.

python examples/make_pairs.py --n 10 --out data/ten
"""

from argparse import ArgumentParser
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import synth

parser = ArgumentParser(description=__doc__)
parser.add_argument("--n", type=int, default=10)
parser.add_argument("--out", type=Path, default=Path("data/ten"))
given = parser.parse_args()

scene = synth.load_scene("gelsight_mini", set=["motion.depth_mm={ uniform = [0.8, 1.5] }"])
summary = synth.generate(scene, given.n, given.out, seed=0)
print(f"{summary.made} pairs made, {summary.found} already there, in {summary.seconds:.0f} s")

sample = next(iter(synth.read_dataset(given.out)))  # its first pair: the undeformed gel and the last state of a press
image1, image2 = sample.images
rows, columns = np.mgrid[6 : image1.shape[0] : 12, 6 : image1.shape[1] : 12]
u, v = np.moveaxis(sample.forward[rows, columns], -1, 0)

figure = Figure(figsize=(9, 3.6), layout="constrained")
left, right = figure.subplots(1, 2)
left.imshow(image1, extent=(0, image1.shape[1], image1.shape[0], 0))
left.quiver(columns + 0.5, rows + 0.5, u, v, angles="xy", scale_units="xy", scale=1, color="w")
left.set_title("image 1 and the motion to image 2 (true length)")
right.imshow(image2)
right.set_title("image 2")
figure.savefig(given.out / "flow.png", dpi=150)
print(f"largest motion {np.nanmax(np.linalg.norm(sample.forward, axis=-1)):.2f} px: {given.out / 'flow.png'}")
