"""What each setting of registration does: `python docs/registration_settings.py DATA [DATA ...] [--aim both]`

The shipped network's flow, alone and registered with one setting changed at a time. On data sets of synth: the mean
endpoint error, by kind of pattern. On real pairs: PSNR and SSIM of image 2 moved back. DATA must serve nothing else;
docs/reports/gelflow.md says where it came from.
"""

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np
import torch

from gelflow.compare.metrics import flow_errors, image_similarity
from gelflow.compare.report import markdown
from gelflow.config import REGISTRATIONS, RegistrationConfig
from gelflow.data import PairDataset, open_all
from gelflow.data.pairs import without_pattern
from gelflow.models.estimate import estimate_flow
from gelflow.models.registration import registered
from gelflow.models.weights import load_weights, weights_file

CHANGES: dict[str, dict[str, tuple[object, ...]]] = {
    "motion": {
        "noise": (0.01, 0.02, 0.03, 0.04, 0.05, 0.07, 0.1),
        "prior_px": (0.1, 0.2, 0.4),
        "background_px": (2.0, 4.0, 8.0, None),
        "windows_px": ((12.0, 8.0, 5.0), (12.0, 8.0, 3.0), (16.0, 8.0, 4.0), (8.0, 5.0, 3.0)),
        "smoothing_px": ((6.0, 2.0, 1.0), (8.0, 3.0, 2.0), (4.0, 2.0, 1.0), (2.0, 2.0, 1.0)),
        "iterations": (1, 2, 4),
        "propagation_px": ((), (16, 32), (4, 8, 16, 32)),
    },
    "both": {"after": tuple(RegistrationConfig(noise=noise) for noise in (0.02, 0.03, 0.035, 0.045, 0.05, 0.06, 0.08))},
    "brightness": {
        "propagation_px": ((), (4, 8), (4, 8, 16, 32), (4, 8, 16, 32, 64), (4, 8, 16, 32, 64, 128)),
        "noise": (0.005, 0.01, 0.02, 0.04),
        "prior_px": (0.5, 1.0, 2.0),
        "windows_px": ((12.0, 6.0, 3.0, 1.0), (12.0, 6.0, 3.0, 2.0), (16.0, 8.0, 4.0, 1.0)),
        "smoothing_px": ((4.0, 2.0, 1.0, 0.0), (2.0, 1.0, 0.0, 0.0), (8.0, 4.0, 2.0, 0.0)),
        "iterations": (2, 4, 8),
    },
}


def variants(aim: str) -> dict[str, RegistrationConfig | None]:
    """The network alone, the setting as it is, and every change of it."""
    usual = REGISTRATIONS[aim]  # type: ignore[index]  # one of its names, as argparse has made sure
    assert usual is not None
    found: dict[str, RegistrationConfig | None] = {"network alone": None, "as it is": usual}
    for name, values in CHANGES[aim].items():
        for value in values:
            if value != getattr(usual, name):
                label = f"after.noise = {value.noise}" if isinstance(value, RegistrationConfig) else f"{name} = {value}"
                found[label] = usual.model_copy(update={name: value})
    return found


def scores(pairs: PairDataset, index: int, flow: torch.Tensor) -> dict[str, float]:
    """Of one pair and flow, by column."""
    truth = pairs.truth(index)
    given = np.ascontiguousarray(flow[0].permute(1, 2, 0).numpy())
    if truth is None:
        return dict(zip(("PSNR dB", "SSIM"), image_similarity(*pairs.images(index), given), strict=True))
    mean = flow_errors(given, truth.flow, truth.visible).mean_px
    scene = str(pairs.records[index].scene)
    columns = [scene.rpartition(", ")[2]] + ([] if without_pattern(scene) else ["all with a pattern"])
    return dict.fromkeys((f"px, {column}" for column in columns), mean)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", nargs="+", type=Path)
    parser.add_argument("--aim", choices=tuple(CHANGES), default="motion")
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--weights", default="best")
    given = parser.parse_args()
    torch.set_num_threads(1)
    model = load_weights(weights_file(Path(given.weights)))
    model.config = model.config.model_copy(update={"registration": None})
    pairs = open_all(given.data)
    table: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for index in range(0, len(pairs), given.every):
        image1, image2 = (torch.from_numpy(image).permute(2, 0, 1)[None] for image in pairs.images(index))
        flow = estimate_flow(model, image1, image2)
        for name, config in variants(given.aim).items():
            found = flow if config is None else registered(flow, image1, image2, config)
            for column, score in scores(pairs, index, found).items():
                table[name][column].append(score)
    columns = sorted(table["as it is"])
    head = ["setting", *(f"{column} ({len(table['as it is'][column])} pairs)" for column in columns)]
    rows = [[name, *(f"{np.mean(row[column]):.4f}" for column in columns)] for name, row in table.items()]
    print(markdown((head, rows)))


if __name__ == "__main__":
    main()
