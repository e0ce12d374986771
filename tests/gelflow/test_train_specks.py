"""Specks in training pairs: they stand still in both images, where and as the pair's random numbers say."""

import numpy as np
import pytest
import torch

import gelflow.training.specks as module
from gelflow.config import TrainConfig
from gelflow.training.augment import augmented
from gelflow.training.samples import collate
from gelflow.training.specks import NOISE, OPACITY, specked

SIDES = (96, 112)


def specks(seed: int, light: float = 0.0) -> torch.Tensor:
    return specked(torch.full((2, 3, *SIDES), light), np.random.default_rng(seed))


def test_specks_lie_at_the_same_pixels_of_both_images_under_noise_of_their_own() -> None:
    covered = []
    for seed in range(20):
        on_black, on_white = specks(seed), specks(seed, 1.0)
        # What black and white gels leave between them is what the specks let through.
        cover = 1 - (on_white - on_black)
        inside = (cover.mean(dim=1) > 0.05)[0]
        # Clipping to [0, 1] and noise of at most NOISE[1] change it; 5 standard deviations in a million values.
        torch.testing.assert_close(cover[0], cover[1], rtol=0, atol=12 * NOISE[1])
        torch.testing.assert_close(on_black[0], on_black[1], rtol=0, atol=12 * NOISE[1])
        assert not torch.equal(on_black[0], on_black[1])
        assert torch.equal(specks(seed), on_black)
        covered.append(float(inside.float().mean()))
    # Twelve discs of 7 px would cover 17 %, scratches and blurred edges more.
    assert 0 < min(covered) < max(covered) < 0.5


def test_far_from_specks_images_stay_as_they_are_and_within_them_little_of_the_gel_is_left() -> None:
    images = torch.rand(2, 3, *SIDES, generator=torch.Generator().manual_seed(2))
    share = []
    for seed in range(20):
        changed = (specked(images, np.random.default_rng(seed)) - images).abs().amax(dim=(0, 1))
        assert changed.isfinite().all()
        share.append(float((changed < 1e-3).float().mean()))
    assert min(share) > 0.3
    strongest = [float((1 - (specks(seed, 1.0) - specks(seed))).max()) for seed in range(20)]
    assert OPACITY[0] / 2 < min(strongest) < max(strongest) <= OPACITY[1] + 12 * NOISE[1]


def test_scratches_follow_their_direction_bubbles_are_hollow_and_noise_is_the_pairs_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    half, place = np.sqrt(0.5), (50.0, 40.0)
    scratch = [*place, half, half, 12.0, 1.0, 0.0, 0.3, 1.0, 0.5, 0.5, 0.5]
    bubble = [*place, 1.0, 0.0, 0.0, 6.0, 1.0, 0.3, 1.0, 0.5, 0.5, 0.5]
    found = {}
    for name, numbers in (("scratch", scratch), ("bubble", bubble)):
        monkeypatch.setattr(module, "_sampled", lambda *_, n=numbers: np.array(n, np.float32)[:, None])
        found[name] = specks(0)[0, 0] / 0.5
        noise = [(one[0] - one[1])[0][found[name] > 0.9] for one in (specks(0), specks(1))]
        assert abs(np.corrcoef(noise[0], noise[1])[0, 1]) < 0.6  # some 40 pixels
    assert found["scratch"].diagonal(10)[34:47].min() > 0.8  # (34, 44) to (46, 56): 8.5 px to each side
    assert found["scratch"][35, 55] < 0.1  # 7 px across
    assert found["scratch"][28, 38] < 0.1  # 17 px along
    for row, column in ((40, 56), (40, 44), (34, 50), (46, 50)):
        assert found["bubble"][row, column] > 0.8
    assert found["bubble"][40, 50] < 0.1


def test_a_quarter_are_bubbles_and_scratches_alone_are_long() -> None:
    drawn = np.concatenate([module._sampled(np.random.default_rng(seed), *SIDES) for seed in range(200)], axis=1)
    half, radius, rim = drawn[4:7]
    # Of 1,300 specks; half of the dust and of the bubbles has a half length of 1 px or more, of scratches 2 or more.
    assert 0.2 < (rim > 0).mean() < 0.3
    assert 0.2 < ((half >= 2) & (radius <= module.SCRATCH_PX[1])).mean() < 0.3
    assert half[rim > 0].max() < 2


def pair(seed: int, **more: object) -> dict:
    random = torch.Generator().manual_seed(seed)
    images = torch.rand(2, 3, *SIDES, generator=random)
    flow = torch.full((2, *SIDES), 3.0)
    return {"image1": images[0], "image2": images[1], "flow": flow, "name": "one", "bare": False} | more


def changed(pairs: list[dict], share: float) -> list[bool]:
    config = TrainConfig(flip=False, specks=share)
    batch = augmented(collate(pairs), config, [np.random.default_rng(number) for number in range(len(pairs))])
    for before, flow in zip(pairs, batch["flow"], strict=True):
        torch.testing.assert_close(flow, before["flow"], rtol=0, atol=0, equal_nan=True)
    both = [[not torch.equal(batch[key][i], one[key]) for i, one in enumerate(pairs)] for key in ("image1", "image2")]
    assert both[0] == both[1]
    return both[0]


def test_a_share_of_the_pairs_with_exact_flow_gets_them_and_bare_gels_and_recordings_do_not() -> None:
    pairs = [pair(0), pair(1, bare=True), pair(2, flow=torch.full((2, *SIDES), torch.nan))]
    assert changed(pairs, 1.0) == [True, False, False]
    assert changed(pairs, 0.0) == [False] * 3
    assert 10 < sum(changed([pair(3)] * 40, 0.5)) < 30  # less likely than 0.2 % at 0.5
    without = {key: value for key, value in pair(4).items() if key != "flow"}
    after = augmented(collate([without]), TrainConfig(flip=False, specks=1.0), [np.random.default_rng(0)])
    assert torch.equal(after["image1"][0], without["image1"])


@pytest.mark.parametrize("compression", [0.0, 0.1])
def test_other_augmentation_does_not_depend_on_whether_there_are_specks(compression: float) -> None:
    found = []
    for share in (0.0, 1.0):
        config = TrainConfig(color_jitter=0.1, compression=compression, specks=share)
        found.append(augmented(collate([pair(0)]), config, [np.random.default_rng(5)]))
    assert torch.equal(found[0]["flow"], found[1]["flow"])
    apart = (found[0]["image1"] - found[1]["image1"]).abs()
    assert apart.max() > 0.1
    assert apart.median() < 0.01 + compression
