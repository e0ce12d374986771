"""Added motion: the flow follows image 2 exactly, stays as it was without it, and is fixed by the draw."""

import numpy as np
import pytest
import torch
from waves import Shifts, pixel_centres, wave_image

from gelflow.config import MotionConfig, TrainConfig
from gelflow.config.sources import train_config
from gelflow.ops.warp import warp
from gelflow.train.augment import augmented
from gelflow.train.samples import TrainingBatches, TrainingSamples, collate


def sample() -> dict:
    """96 x 112 px with a flow of a turn and a stretch that image 2 obeys exactly, unknown in a corner."""
    x, y = pixel_centres(96, 112)
    flow = torch.stack([0.04 * (y - 48) + 2, -0.03 * (x - 56) - 1])
    image1, image2 = (wave_image(a, b, 3, 12, 30).float() for a, b in ((x + flow[0], y + flow[1]), (x, y)))
    flow[:, :4, :4] = torch.nan
    return {"image1": image1, "image2": image2, "flow": flow.float(), "name": "one", "bare": False}


def moved(before: dict, motion: MotionConfig, seed: int) -> dict:
    """A sample after motion alone, in a batch between two others."""
    config = TrainConfig(motion=motion, flip=False)
    randoms = [np.random.default_rng(number) for number in (seed + 50, seed, seed + 90)]
    return {key: value[1] for key, value in augmented(collate([before] * 3), config, randoms).items()}


@pytest.mark.parametrize("seed", range(4))
def test_the_moved_pair_obeys_its_flow(seed: int) -> None:
    """Fails with the shift added instead of taken away, with the turn's sense reversed, and with the zoom inverted."""
    before = sample()
    after = moved(before, MotionConfig(), seed)
    assert torch.equal(after["image1"], before["image1"])
    assert torch.isnan(after["flow"][:, :4, :4]).all()
    assert (after["flow"] - before["flow"]).nan_to_num().abs().max() > 0.5
    middle = (slice(None), slice(32, 64), slice(36, 76))  # 12 px of shift and turn do not carry the border in here
    found = warp(after["image2"][None], torch.nan_to_num(after["flow"])[None], "spline")[0]
    error = (found - after["image1"])[middle].abs().mean()
    # Two spline interpolations of waves of 12 px and more: below 0.1 % of their height each.
    assert error < 0.01 * (after["image2"] - after["image1"])[middle].abs().mean()


def test_no_motion_leaves_everything_as_it_is() -> None:
    before = sample()
    after = moved(before, MotionConfig(shift_px=0, turn_deg=0, zoom=0), 0)
    # Sampling positions are rounded to 1e-7 of 112 px, the waves' slope is below 0.1 per px.
    torch.testing.assert_close(after["image2"], before["image2"], rtol=0, atol=1e-5)
    torch.testing.assert_close(after["flow"], before["flow"], rtol=0, atol=1e-5, equal_nan=True)


def test_a_bare_gel_stays_as_it_is_beside_others() -> None:
    """Fails with any of motion, flips and colours drawn for it."""
    bare, dotted = sample() | {"bare": True}, sample()
    config = TrainConfig(motion=MotionConfig(), flip=True, color_jitter=0.2)
    for seed in range(4):
        randoms = [np.random.default_rng(number) for number in (seed, seed + 10)]
        after = augmented(collate([bare, dotted]), config, randoms)
        for key in ("image1", "image2", "flow"):
            # As without motion, above.
            torch.testing.assert_close(after[key][0], bare[key], rtol=0, atol=1e-5, equal_nan=True)
            assert not torch.allclose(after[key][1], dotted[key], atol=0.01, equal_nan=True)


def test_training_draws_it_where_the_configuration_asks_for_it() -> None:
    """Fails with `augmented` passing over `config.motion`."""
    pairs = Shifts(1, 80, 1.0, seed=2)

    def flow(draw: int, motion: MotionConfig | None) -> torch.Tensor:
        config = TrainConfig(supervision="flow", flip=False, motion=motion)
        return TrainingBatches(config)([TrainingSamples(pairs, config)[(0, draw)]])["flow"][0]

    assert torch.equal(flow(3, None), pairs[0]["flow"])
    shifts = MotionConfig(turn_deg=0, zoom=0)
    added = [(flow(draw, shifts) - pairs[0]["flow"]).mean(dim=(1, 2)) for draw in range(20)]
    assert all(shift.abs().max() <= 12 for shift in added)
    assert max(float(shift.abs().max()) for shift in added) > 4
    assert torch.equal(flow(3, shifts), flow(3, shifts))
    assert train_config(None, ["motion.turn_deg=5"]).motion == MotionConfig(turn_deg=5)
    config = TrainConfig(motion=MotionConfig())
    unlabelled = TrainingSamples(Shifts(1, 80, 1.0, seed=2, flow=False), config)
    assert "flow" not in TrainingBatches(config)([unlabelled[(0, 0)]])
