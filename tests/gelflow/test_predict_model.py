"""`gelflow.load_model` and `gelflow.PairDataset`: arrays and tensors give one flow; what cannot be used is refused."""

from pathlib import Path

import numpy as np
import pytest
import torch
from synth_samples import synth_sample, write_dataset
from textures import as_bytes, moved

import gelflow
from gelflow.errors import InputError


def test_arrays_and_tensors_give_one_flow(tmp_path: Path) -> None:
    pairs = gelflow.PairDataset(write_dataset(tmp_path, [synth_sample(0), synth_sample(1)]))
    batch = next(iter(torch.utils.data.DataLoader(pairs, batch_size=2)))
    model = gelflow.load_model("best", device="cpu")
    flow = model.flow(batch["image1"], batch["image2"])
    assert flow.shape == batch["flow"].shape
    one = model.flow(batch["image1"][1], batch["image2"][1])
    arrays = model.flow(*pairs.images(1))
    # Batches and single pairs are summed in different orders: float32 rounding, some ten layers deep.
    np.testing.assert_allclose(one.numpy(), flow[1].numpy(), atol=1e-3)
    np.testing.assert_allclose(arrays, np.moveaxis(one.numpy(), 0, -1), atol=1e-3)


def test_flow_follows_a_known_motion() -> None:
    image1, image2 = (as_bytes(moved(96, 128, shift, 0)) for shift in (0, 2))
    flow = gelflow.load_model(device="cpu").flow(image1, image2)
    assert flow.dtype == np.float32
    # 8-bit images of texture: a tenth of a px is twenty times what rounding leaves.
    assert np.median(flow, axis=(0, 1)) == pytest.approx((2.0, 0.0), abs=0.1)


@pytest.mark.parametrize(
    ("image1", "image2", "message"),
    [
        (np.zeros((64, 64, 3)), torch.zeros(3, 64, 64), "ndarray and Tensor: two NumPy arrays or two torch tensors"),
        (np.full((64, 64, 3), 9.0), np.zeros((64, 64, 3)), r"image 1 is float64 with values from 9 to 9"),
        (torch.zeros(3, 64, 64), torch.full((3, 64, 64), -1.0), r"image 2 is torch.float32 with values from -1 to -1"),
        (np.zeros((64, 64)), np.zeros((64, 64)), r"\(rows, columns, 3\) is needed"),
        (torch.zeros(3, 64, 64), torch.zeros(3, 64, 80), "differ in shape"),
        (np.full((64, 64, 3), np.nan), np.zeros((64, 64, 3)), "NaN or infinite"),
    ],
)
def test_images_that_cannot_be_used(image1: object, image2: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        gelflow.load_model(device="cpu").flow(image1, image2)  # type: ignore[call-overload]
