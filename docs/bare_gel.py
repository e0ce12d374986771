"""The report's picture of bare gels: `python docs/bare_gel.py data/test/digit --pairs 2 10 14 16 --out FILE`

A row for each pair: image 1, image 2, the exact flow, that of the shipped network, that of Farnebäck, all three in the
colours of the pair's largest motion.
"""

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from gelflow.baselines.learned import open_network
from gelflow.baselines.registry import named_methods
from gelflow.data import open_all
from gelflow.files.image import to_bytes
from gelflow.models.weights import weights_file
from gelflow.predict.pictures import flow_to_colour


def main() -> None:
    """Draw it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--pairs", type=int, nargs="+", required=True)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    dataset = open_all([given.dataset])
    methods = [open_network(weights_file(None), device="cpu"), *named_methods(["farneback"])]
    rows = []
    for number in given.pairs:
        image1, image2 = dataset.images(number)
        truth = dataset.truth(number)
        if truth is None:
            parser.error(f"{given.dataset}: pair {number} has no exact flow")
        exact = truth.flow
        flows = [exact, *(method.flow(image1, image2) for method in methods)]
        scale = float(np.nanmax(np.linalg.norm(exact, axis=-1)))
        rows.append(np.hstack([to_bytes(image1), to_bytes(image2), *(flow_to_colour(flow, scale) for flow in flows)]))
        print(number, *(f"{method.name}: {np.nanmean(np.linalg.norm(flow - exact, axis=-1)):.2f} px"
                        for method, flow in zip(methods, flows[1:], strict=True)))  # fmt: skip
    Image.fromarray(np.vstack(rows)).save(given.out, quality=88)


if __name__ == "__main__":
    main()
