"""A sensor with a pattern of your own: draw a bitmap, put it on a shipped sensor's gel, and generate pairs.

python examples/own_pattern.py --n 4 --out data/rings
"""

from argparse import ArgumentParser
from pathlib import Path

import numpy as np
from PIL import Image

import synth

parser = ArgumentParser(description=__doc__)
parser.add_argument("--n", type=int, default=4)
parser.add_argument("--out", type=Path, default=Path("data/rings"))
given = parser.parse_args()

# Rings of 1.2 mm pitch at 40 px per mm. White is bare coating; darker values scale its reflectance.
pixels_per_mm, width_mm, height_mm = 40, 22.0, 17.0
y, x = np.mgrid[0 : round(height_mm * pixels_per_mm), 0 : round(width_mm * pixels_per_mm)] / pixels_per_mm
radius = np.hypot(x - width_mm / 2, y - height_mm / 2)
picture = np.where(radius % 1.2 < 0.4, 40, 255).astype(np.uint8)
picture[(x % 1.2 < 0.1) | (y % 1.2 < 0.1)] = 120  # rings alone would not show motion along them
given.out.parent.mkdir(parents=True, exist_ok=True)
bitmap = given.out.parent / "rings.png"
Image.fromarray(picture).save(bitmap)

pattern = f'{{ kind = "bitmap", file = "{bitmap}", width_mm = {width_mm} }}'
scene = synth.load_scene("gelsight_mini", set=[f"sensor.pattern={pattern}"])
summary = synth.generate(scene, given.n, given.out)
print(f"{summary.made} pairs of the new pattern in {given.out}; look at one: samples/000000/image2.png")
