"""From pairs to batches: fixed by (seed, draw) alone, physically consistent, with clear refusals."""

import numpy as np
import pytest
import torch
from torch.utils.data import Dataset
from waves import Shifts, pixel_centres, wave_image

from gelflow.config import MotionConfig, TrainConfig
from gelflow.config.sources import train_config
from gelflow.errors import InputError
from gelflow.ops.warp import inside, warp
from gelflow.train.augment import augmented
from gelflow.train.resident import resident
from gelflow.train.samples import CheckedPairs, StepSampler, TrainingBatches, TrainingSamples, checked, collate, resized


def test_every_pass_sees_every_pair_once_in_another_order() -> None:
    batches = list(StepSampler(6, TrainConfig(batch_size=4), 0, 6))
    indices = [index for batch in batches for index, _ in batch]
    assert all(sorted(indices[i : i + 6]) == list(range(6)) for i in range(0, 24, 6))
    assert indices[:6] != indices[6:12] or indices[6:12] != indices[12:18]
    assert [draw for batch in batches for _, draw in batch] == list(range(24))


def test_a_later_start_goes_on_with_the_same_batches_and_processes_share_them() -> None:
    config = TrainConfig(batch_size=4, seed=3)
    whole = list(StepSampler(7, config, 0, 10))
    assert list(StepSampler(7, config, 4, 10)) == whole[4:]
    halves = [list(StepSampler(7, TrainConfig(batch_size=2, seed=3), 0, 10, rank, 2)) for rank in (0, 1)]
    assert [first + second for first, second in zip(*halves, strict=True)] == whole
    assert list(StepSampler(7, TrainConfig(batch_size=4, seed=4), 0, 10)) != whole


def drawn(pairs: Dataset, config: TrainConfig, draw: int) -> dict:
    """Pair 0 as a training step gets it, alone in its batch, without the batch's axis."""
    batch = TrainingBatches(config)([TrainingSamples(pairs, config)[(0, draw)]])
    return {key: value[0] for key, value in batch.items()}


class Still(Dataset):
    """One sample of 96 x 112 px whose flow at the left half is unknown."""

    def __len__(self) -> int:
        return 1

    def __getitem__(self, _: int) -> dict:
        sample = Shifts(1, 112, 3.0, seed=5)[0]
        for key in ("image1", "image2", "flow"):
            sample[key] = sample[key][:, :96].clone()
        sample["flow"][:, :, :56] = torch.nan
        return sample


def test_augmented_pairs_still_obey_their_flow() -> None:
    config = TrainConfig(supervision="flow", crop_size=(64, 80), color_jitter=0.1)
    flipped, jittered = set(), set()
    for draw in range(12):
        sample = drawn(Still(), config, draw)
        flow = sample["flow"]
        assert sample["image1"].shape == (3, 64, 80)
        known = torch.isfinite(flow).all(dim=0)
        filled = torch.nan_to_num(flow)[None]
        counts = (known & (inside(filled)[0, 0] > 0)).expand(3, 64, 80)
        error = (warp(sample["image2"][None], filled)[0] - sample["image1"])[counts].abs().mean()
        still = (sample["image2"] - sample["image1"])[counts].abs().mean()
        # bilinear interpolation of waves of 8 px and more: at most 5 % of what the motion makes, here
        assert error < 0.2 * still
        flipped.add(tuple(flow[:, known][:, 0].sign().tolist()))
        jittered.add(sample["image1"].mean().item())
        assert torch.equal(drawn(Still(), config, draw)["image1"], sample["image1"])
    assert len(flipped) == 4
    assert len(jittered) == 12


def test_resizing_brings_flow_and_images_to_the_new_px() -> None:
    sample = resized(checked(Shifts(1, 96, 6.0, seed=6)[0]), (64, 192))
    flow = sample["flow"]
    former = Shifts(1, 96, 6.0, seed=6)[0]["flow"]
    torch.testing.assert_close(flow[0, 0, 0], former[0, 0, 0] * 2)
    torch.testing.assert_close(flow[1, 0, 0], former[1, 0, 0] * 64 / 96)
    keep = inside(flow[None])[0].expand(3, 64, 192) > 0
    error = (warp(sample["image2"][None], flow[None])[0] - sample["image1"])[keep].abs().mean()
    # low-pass filters of the resampling act near the border and attenuate waves alike elsewhere
    assert error < 0.1 * (sample["image2"] - sample["image1"]).abs().mean()


def broken(**changes: object) -> dict:
    sample = Shifts(1, 64, 1.0, seed=7)[0]
    sample.update(changes)
    return sample


@pytest.mark.parametrize(
    ("sample", "words"),
    [
        (broken(image1=None), "pair shift_0: image1 must be"),
        (broken(image2=torch.zeros(1, 64, 64)), r"image2 must be a \(3, rows, columns\)"),
        (broken(image1=torch.zeros(3, 64, 65)), "different sizes"),
        (broken(image1=torch.full((3, 64, 64), torch.nan)), "image1 holds NaN"),
        (broken(flow=torch.zeros(2, 5, 5)), "its flow has another size"),
        (broken(flow=torch.full((2, 64, 64), torch.nan)), 'use supervision = "self"'),
        (broken(flow=None), 'use supervision = "self"'),
    ],
)
def test_samples_that_cannot_be_used_are_named(sample: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        checked(sample, supervised=True)


def test_batches_need_one_size_and_enough_pixels() -> None:
    small, large = checked(Shifts(1, 64, 1.0, seed=8)[0]), checked(Shifts(1, 80, 1.0, seed=8)[0])
    with pytest.raises(InputError, match="different sizes; set image_size"):
        collate([small, large])
    with pytest.raises(InputError, match="48x48 px, but each side must be at least 64"):
        TrainingSamples(Shifts(1, 48, 1.0, seed=8), TrainConfig())[(0, 0)]
    with pytest.raises(InputError, match="crop_size 72x64 does not fit"):
        TrainingSamples(Shifts(1, 64, 1.0, seed=8), TrainConfig(crop_size=(72, 64)))[(0, 0)]


def test_a_batch_has_flow_only_if_all_its_samples_do() -> None:
    both = [checked(Shifts(1, 64, 1.0, seed=9, flow=known)[0]) for known in (True, False)]
    assert "flow" not in collate(both)
    assert collate([both[0], both[0]])["flow"].shape == (2, 2, 64, 64)


@pytest.mark.parametrize("supervision", ["flow", "mixed"])
def test_a_pair_smaller_than_the_crop_is_set_into_it_without_flow_around(supervision: str) -> None:
    config = TrainConfig(supervision=supervision, crop_size=(96, 160), flip=False)
    with pytest.raises(InputError, match="crop_size 96x160 does not fit into its 80x80 px"):
        TrainingSamples(Shifts(1, 80, 1.0, seed=8, flow=False), TrainConfig(crop_size=(96, 160)))[(0, 0)]
    pairs = Shifts(1, 80, 1.0, seed=8)
    first = pairs[0]
    places = set()
    for draw in range(6):
        sample = drawn(pairs, config, draw)
        assert sample["image1"].shape == (3, 96, 160)
        known = torch.isfinite(sample["flow"]).all(dim=0).nonzero()
        top, left = known.min(dim=0).values.tolist()
        assert (known.max(dim=0).values - known.min(dim=0).values).tolist() == [79, 79]
        assert len(known) == 80 * 80
        for key in ("image1", "image2", "flow"):
            assert torch.equal(sample[key][:, top : top + 80, left : left + 80], first[key])
        assert torch.equal(sample["image2"][:, 0, left : left + 80], first["image2"][:, 0])
        places.add((top, left))
    assert len(places) > 1


def test_resident_pairs_are_those_of_the_files() -> None:
    class Bytes(Shifts):
        def __getitem__(self, index: int) -> dict:
            sample = super().__getitem__(index)
            return sample | {"image1": (255 * sample["image1"]).round() / 255}

    pairs = CheckedPairs(Bytes(3, 64, 1.0, seed=8), supervised=True)
    kept = resident(pairs, torch.device("cpu"), room=10**7)
    assert len(kept) == 3
    for index in range(3):
        original, sample = pairs[index], kept[index]
        assert sample.keys() == original.keys()
        assert sample["name"] == original["name"]
        # image1 was kept as bytes, image2, whose values are no whole 255ths, as it is.
        for key in ("image1", "image2", "flow"):
            assert torch.equal(sample[key], original[key])
    pixels = 64 * 64
    assert resident(pairs, torch.device("cpu"), room=3 * pixels * (3 + 12 + 8)) is not None
    assert resident(pairs, torch.device("cpu"), room=3 * pixels * (3 + 12 + 8) - 1) is None


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
