"""The README's gallery, scenes as ordered: `python docs/gallery.py data/gallery/* --out docs/images/gallery.jpg`.

Each of data/gallery is made by `python -m synth generate --scene NAME --n 2 --out data/gallery/NAME`.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from synth.dataset.reader import read_dataset
from synth.inspection.panels import image_picture
from synth.inspection.wheel import flow_colours, robust_scale

COLUMNS = 3
HEIGHT_INCHES = 1.55
WIDTH_INCHES = 4.3


def main() -> None:
    """Draw of each data set's first sample the second image, and beside it the pair's flow in colour."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("datasets", nargs="+", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    rows = -(-len(arguments.datasets) // COLUMNS)
    figure = Figure(figsize=(COLUMNS * WIDTH_INCHES, rows * (HEIGHT_INCHES + 0.25)), dpi=100)
    axes = np.atleast_2d(figure.subplots(rows, COLUMNS))
    for axis in axes.ravel():
        axis.set_axis_off()
    for axis, folder in zip(axes.ravel(), arguments.datasets, strict=False):
        dataset = read_dataset(folder)
        sample = dataset.read(dataset.samples[0])
        flow, name = sample.flow.forward, dataset.info["scene"]["name"]
        scale = robust_scale(flow)
        axis.imshow(np.hstack([image_picture(sample.image2), flow_colours(flow, scale)]))
        axis.set_title(f"{name}: image 2, flow to {scale:.3g} px", fontsize=8, pad=2)
    figure.tight_layout(pad=0.3)
    figure.savefig(arguments.out, pil_kwargs={"quality": 88})


if __name__ == "__main__":
    main()
