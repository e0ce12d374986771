"""Make a clip of a ball that is pressed in and dragged until it slides; plot force and slip, and save its film.

python examples/make_clip.py --out data/clip
"""

from argparse import ArgumentParser
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

import synth

parser = ArgumentParser(description=__doc__)
parser.add_argument("--out", type=Path, default=Path("data/clip"))
parser.add_argument("--set", nargs="*", default=[], help="more settings, such as motion.steps=47")
given = parser.parse_args()

slide = ["motion.depth_mm=0.8", "motion.shear_mm=[1.0, 0.0]", "contact.friction=0.4", "motion.steps=23"]
ball = ['contact.indenter={ shape = "sphere", radius_mm = 4.0 }', 'sampling.kind="clips"', "outputs.slip=true"]
scene = synth.load_scene("gelsight_mini", set=[*slide, *ball, *given.set])
synth.generate(scene, 1, given.out, seed=0)

clip = next(iter(synth.read_dataset(given.out)))
states = clip.states  # a row for each frame
figure = Figure(figsize=(6, 4), layout="constrained")
force, slip = figure.subplots(2, 1, sharex=True)
for axis in "xyz":
    force.plot(states["time_s"], states[f"f{axis}_n"], label=f"F{axis}, N")
slip.plot(states["time_s"], states["slip_ratio"], label="slip ratio over seconds")
area = states["contact_area_mm2"]
slip.plot(states["time_s"], area / area.max(), label="contact area / largest")
for axes in (force, slip):
    axes.legend()
figure.savefig(given.out / "states.png", dpi=150)

first, *others = map(Image.fromarray, clip.images)
first.save(given.out / "film.webp", save_all=True, append_images=others, duration=40, loop=0)
slides = states["gross_slip"].sum()
print(f"{len(clip)} frames, at most {states['fz_n'].max():.2f} N; slides as a whole in {slides} of them")
