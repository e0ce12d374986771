"""From pairs to batches: fixed by (seed, draw) alone, physically consistent, with clear refusals."""

import numpy as np
import pytest
import torch
from commands import refused
from torch.utils.data import Dataset
from waves import Shifts, pixel_centres, wave_image

from gelflow.config import MotionConfig, TrainConfig
from gelflow.config.sources import train_config
from gelflow.ops.warp import inside, warp
from gelflow.training.augment import augmented
from gelflow.training.loading import resident
from gelflow.training.samples import (
    CheckedPairs,
    StepSampler,
    TrainingSamples,
    augmented_batch,
    checked,
    collate,
    resized,
)


def test_passes_see_every_pair_once_a_later_start_goes_on_and_processes_share_batches() -> None:
    keys = [key for batch in StepSampler(6, TrainConfig(batch_size=4), 0, 6) for key in batch]
    passes = [[index for index, _ in keys[i : i + 6]] for i in range(0, 24, 6)]
    assert all(sorted(one) == list(range(6)) for one in passes)
    assert passes[0] != passes[1] or passes[1] != passes[2]
    assert [draw for _, draw in keys] == list(range(24))
    config = TrainConfig(batch_size=4, seed=3)
    whole = list(StepSampler(7, config, 0, 10))
    assert list(StepSampler(7, config, 4, 10)) == whole[4:]
    halves = [list(StepSampler(7, TrainConfig(batch_size=2, seed=3), 0, 10, rank, 2)) for rank in (0, 1)]
    assert [first + second for first, second in zip(*halves, strict=True)] == whole
    assert list(StepSampler(7, TrainConfig(batch_size=4, seed=4), 0, 10)) != whole


def drawn(pairs: Dataset, config: TrainConfig, draw: int) -> dict:
    """Pair 0 as a training step gets it, alone in its batch, without the batch's axis."""
    batch = augmented_batch([TrainingSamples(pairs, config)[(0, draw)]], config)
    return {key: value[0] for key, value in batch.items()}


class Still(Shifts):
    """One sample of 96 x 112 px whose flow at the left half is unknown."""

    def __getitem__(self, index: int) -> dict:
        sample = super().__getitem__(index)
        sample |= {key: sample[key][:, :96].clone() for key in ("image1", "image2", "flow")}
        sample["flow"][:, :, :56] = torch.nan
        return sample


def test_augmented_pairs_still_obey_their_flow() -> None:
    pairs = Still(1, 112, 3.0, seed=5)
    config = TrainConfig(supervision="flow", crop_size=(64, 80), color_jitter=0.1)
    flipped, jittered = set(), set()
    for draw in range(12):
        sample = drawn(pairs, config, draw)
        flow = sample["flow"]
        assert sample["image1"].shape == (3, 64, 80)
        known = torch.isfinite(flow).all(dim=0)
        # bilinear interpolation of waves of 8 px and more: at most 5 % of what the motion makes, here
        assert left_after_warping(sample, known) < 0.2
        flipped.add(tuple(flow[:, known][:, 0].sign().tolist()))
        jittered.add(sample["image1"].mean().item())
        assert torch.equal(drawn(pairs, config, draw)["image1"], sample["image1"])
    assert (len(flipped), len(jittered)) == (4, 12)


def left_after_warping(sample: dict, counts: torch.Tensor, mode: str = "bilinear") -> float:
    """Difference of the images once image 2 is warped by the flow, per difference before; where inside and counted."""
    flow = torch.nan_to_num(sample["flow"])[None]
    counts = (counts & (inside(flow)[0, 0] > 0)).expand_as(sample["image1"])
    error, still = ((image - sample["image1"])[counts].abs().mean()
                    for image in (warp(sample["image2"][None], flow, mode)[0], sample["image2"]))  # fmt: skip
    return float(error / still)


def test_resizing_keeps_flow_and_batches_need_one_size_and_enough_pixels() -> None:
    former = checked(Shifts(1, 96, 6.0, seed=6)[0])
    sample = resized(former, (64, 192))
    scale = torch.tensor([2, 64 / 96])
    torch.testing.assert_close(sample["flow"][:, 0, 0], former["flow"][:, 0, 0] * scale)
    # low-pass filters of the resampling act near the border and attenuate waves alike elsewhere
    assert left_after_warping(sample, torch.ones(64, 192, dtype=torch.bool)) < 0.1
    small, large, bare = (checked(Shifts(1, side, 1.0, seed=8, flow=flow)[0])
                          for side, flow in ((64, True), (80, True), (64, False)))  # fmt: skip
    refused("different sizes; set image_size", collate, [small, large])
    for side, crop, words in ((48, None, "48x48 px, but each side must be at least 64"),
                              (64, (72, 64), "crop_size 72x64 does not fit")):  # fmt: skip
        refused(words, TrainingSamples(Shifts(1, side, 1.0, seed=8), TrainConfig(crop_size=crop)).__getitem__, (0, 0))
    mixed = collate([small, bare])["flow"]
    assert torch.isfinite(mixed[0]).all()
    assert torch.isnan(mixed[1]).all()
    assert collate([small, small])["flow"].shape == (2, 2, 64, 64)


@pytest.mark.parametrize("flow", [None, torch.full((2, 64, 64), torch.nan)])
def test_pairs_without_the_flow_that_supervision_needs_are_refused(flow: torch.Tensor | None) -> None:
    pair = Shifts(1, 64, 1.0, seed=7)[0] | {"flow": flow}
    refused(r'pair shift_0: .*use supervision = "self"', checked, pair, supervised=True)


@pytest.mark.parametrize("supervision", ["flow", "mixed"])
def test_a_pair_smaller_than_the_crop_is_set_into_it_without_flow_around(supervision: str) -> None:
    config = TrainConfig(supervision=supervision, crop_size=(96, 160), flip=False)
    bare = TrainingSamples(Shifts(1, 80, 1.0, seed=8, flow=False), TrainConfig(crop_size=(96, 160)))
    refused("crop_size 96x160 does not fit into its 80x80 px", bare.__getitem__, (0, 0))
    pairs = Shifts(1, 80, 1.0, seed=8)
    places = set()
    for draw in range(6):
        sample = drawn(pairs, config, draw)
        known = torch.isfinite(sample["flow"]).all(dim=0)
        top, left = known.nonzero().min(dim=0).values.tolist()
        assert known.sum() == 80 * 80
        for key in ("image1", "image2", "flow"):
            assert sample[key].shape[1:] == (96, 160)
            assert torch.equal(sample[key][:, top : top + 80, left : left + 80], pairs[0][key])
        # Beyond its border an image goes on.
        assert torch.equal(sample["image2"][:, 0, left : left + 80], pairs[0]["image2"][:, 0])
        places.add((top, left))
    assert len(places) > 1


@pytest.mark.parametrize("place", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
def test_resident_pairs_are_those_of_the_files(place: str) -> None:
    if place == "cuda" and not torch.cuda.is_available():
        pytest.skip("no CUDA device")

    class Bytes(Shifts):
        def __getitem__(self, index: int) -> dict:
            sample = super().__getitem__(index)
            return sample | {"image1": (255 * sample["image1"]).round() / 255}

    pairs, device = CheckedPairs(Bytes(3, 64, 1.0, seed=8), supervised=True), torch.device(place)
    kept = resident(pairs, device, room=10**7)
    assert len(kept) == 3
    for index in range(3):
        original, sample = pairs[index], kept[index]
        assert sample.pop("name") == original.pop("name")
        torch.testing.assert_close(sample, original, rtol=0, atol=0, check_device=False)
    # image1 is kept as bytes, image2, whose values are no whole 255ths, as it is.
    needed = 3 * 64 * 64 * (3 + 12 + 8)
    assert resident(pairs, device, room=needed) is not None
    assert resident(pairs, device, room=needed - 1) is None


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
    middle = torch.zeros(96, 112, dtype=torch.bool)
    middle[32:64, 36:76] = True  # 12 px of shift and turn do not carry the border in here
    # Two spline interpolations of waves of 12 px and more: below 0.1 % of their height each.
    assert left_after_warping(after, middle, "spline") < 0.01


def test_no_motion_leaves_everything_and_any_leaves_a_bare_gel_as_it_is() -> None:
    before = sample()
    after = moved(before, MotionConfig(shift_px=0, turn_deg=0, zoom=0), 0)
    # Sampling positions are rounded to 1e-7 of 112 px, the waves' slope is below 0.1 per px.
    torch.testing.assert_close(after["image2"], before["image2"], rtol=0, atol=1e-5)
    torch.testing.assert_close(after["flow"], before["flow"], rtol=0, atol=1e-5, equal_nan=True)
    bare, dotted = sample() | {"bare": True}, sample()
    config = TrainConfig(motion=MotionConfig(), flip=True, color_jitter=0.2, compression=0.1)
    for seed in range(4):
        randoms = [np.random.default_rng(number) for number in (seed, seed + 10)]
        after = augmented(collate([bare, dotted]), config, randoms)
        for key in ("image1", "image2", "flow"):
            # As without motion, above.
            torch.testing.assert_close(after[key][0], bare[key], rtol=0, atol=1e-5, equal_nan=True)
            assert not torch.allclose(after[key][1], dotted[key], atol=0.01, equal_nan=True)


def test_pairs_with_exact_flow_are_compressed_and_recordings_are_not() -> None:
    config, pairs = TrainConfig(flip=False, compression=0.1), Shifts(1, 80, 1.0, seed=2)
    found = [drawn(pairs, config, draw) for draw in range(10)]
    lost = [(each["image2"] - pairs[0]["image2"]).abs().mean().item() for each in found]
    assert 0 < 1.5 * min(lost) < max(lost)  # steps differ by up to 32 times; chroma always loses half its resolution
    assert all(torch.equal(each["flow"], pairs[0]["flow"]) for each in found)
    recorded = pairs[0] | {"flow": torch.full_like(pairs[0]["flow"], torch.nan)}
    batch = augmented(collate([pairs[0], recorded]), config, [np.random.default_rng(seed) for seed in (1, 2)])
    assert not torch.equal(batch["image1"][0], pairs[0]["image1"])
    assert torch.equal(batch["image1"][1], recorded["image1"])
    without = Shifts(1, 80, 1.0, seed=2, flow=False)
    assert torch.equal(drawn(without, config, 3)["image2"], without[0]["image2"])


def test_training_draws_it_where_the_configuration_asks_for_it() -> None:
    pairs = Shifts(1, 80, 1.0, seed=2)

    def flow(draw: int, motion: MotionConfig | None) -> torch.Tensor:
        return drawn(pairs, TrainConfig(supervision="flow", flip=False, motion=motion), draw)["flow"]

    assert torch.equal(flow(3, None), pairs[0]["flow"])
    shifts = MotionConfig(turn_deg=0, zoom=0)
    added = [(flow(draw, shifts) - pairs[0]["flow"]).mean(dim=(1, 2)) for draw in range(20)]
    assert all(shift.abs().max() <= 12 for shift in added)
    assert max(float(shift.abs().max()) for shift in added) > 4
    assert torch.equal(flow(3, shifts), flow(3, shifts))
    assert train_config(None, ["motion.turn_deg=5"]).motion == MotionConfig(turn_deg=5)
    assert "flow" not in drawn(Shifts(1, 80, 1.0, seed=2, flow=False), TrainConfig(motion=MotionConfig()), 0)
