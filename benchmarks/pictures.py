"""Draws the pictures of data in README and guide: `gallery` and `row` from datasets of synth, `bare_gel` of flow.

gallery: of each data set, as ordered, the first sample's second image and its flow in colour; data/gallery/NAME is made
by `python -m synth generate --scene NAME --n 2 --out data/gallery/NAME`. row: the images alone, side by side.
bare_gel: a row for each of the given pairs of one data set: image 1, image 2, the exact flow, the shipped network's and
Farnebäck's, in the colours of its largest motion.
"""

from argparse import ArgumentParser
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from synth.dataset.reader import read_dataset
from synth.dataset.sample_reader import SampleData
from synth.inspect.panels import flow_colours, image_picture, robust_scale


def gallery(folders: list[Path], out: Path) -> None:
    """A panel for each data set, three in a row."""
    rows = -(-len(folders) // 3)
    figure = Figure(figsize=(3 * 4.3, rows * 1.8), dpi=100)
    axes = figure.subplots(rows, 3, squeeze=False).ravel()
    for axis in axes:
        axis.set_axis_off()
    for axis, folder in zip(axes, folders, strict=False):
        name, sample = _first(folder)
        scale = robust_scale(sample.flow.forward)
        axis.imshow(np.hstack([image_picture(sample.images[1]), flow_colours(sample.flow.forward, scale)]))
        axis.set_title(f"{name}: image 2, flow to {scale:.3g} px", fontsize=8, pad=2)
    figure.tight_layout(pad=0.3)
    figure.savefig(out, pil_kwargs={"quality": 88})


def row(folders: list[Path], out: Path) -> None:
    """The second images, as high as each other."""
    samples = [_first(folder) for folder in folders]
    images = [image_picture(sample.images[1]) for _, sample in samples]
    widths = [image.shape[1] / image.shape[0] for image in images]
    figure = Figure(figsize=(2.4 * sum(widths), 2.6), dpi=100)
    for axis, image, (name, _) in zip(figure.subplots(1, len(images), width_ratios=widths, squeeze=False)[0], images,
                                      samples, strict=True):  # fmt: skip
        axis.set_axis_off()
        axis.imshow(image)
        axis.set_title(name, fontsize=8, pad=2)
    figure.tight_layout(pad=0.3)
    figure.savefig(out, pil_kwargs={"quality": 88})


def _first(folder: Path) -> tuple[str, SampleData]:
    """The scene's name and the first sample of a data set."""
    dataset = read_dataset(folder)
    return dataset.info["scene"]["name"], dataset.read(dataset.samples[0])


def bare_gel(folder: Path, pairs: list[int], out: Path) -> None:
    """Two images and three flows of each pair."""
    from PIL import Image

    from gelflow.baselines.registry import named_methods
    from gelflow.data.open import open_all
    from gelflow.errors import InputError
    from gelflow.files.image import to_bytes
    from gelflow.methods.learned import open_network
    from gelflow.models.weights import weights_file
    from gelflow.predict.pictures import flow_to_colour

    dataset = open_all([folder])
    methods = [open_network(weights_file(None), device="cpu"), *named_methods(["farneback"])]
    rows = []
    for number in pairs:
        images, truth = dataset.images(number), dataset.truth(number)
        if truth is None:
            raise InputError(f"{folder}: pair {number} has no exact flow")
        flows = [truth.flow, *(method.flow(*images) for method in methods)]
        scale = float(np.nanmax(np.linalg.norm(truth.flow, axis=-1)))
        rows.append(np.hstack([*map(to_bytes, images), *(flow_to_colour(flow, scale) for flow in flows)]))
    Image.fromarray(np.vstack(rows)).save(out, quality=88)


def main(argv: list[str]) -> int:
    """Draw one of them."""
    parser = ArgumentParser("python -m benchmarks pictures", description=__doc__)
    parser.add_argument("picture", choices=("gallery", "row", "bare_gel"))
    parser.add_argument("datasets", nargs="+", type=Path)
    parser.add_argument("--pairs", type=int, nargs="+", default=[2, 10, 14, 16], help="of bare_gel")
    parser.add_argument("--out", type=Path, required=True, help="JPEG file")
    given = parser.parse_args(argv)
    if given.picture == "bare_gel":
        bare_gel(given.datasets[0], given.pairs, given.out)
    else:
        {"gallery": gallery, "row": row}[given.picture](given.datasets, given.out)
    return 0
