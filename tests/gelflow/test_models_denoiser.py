"""The denoiser: a fresh one changes nothing, the shipped one takes noise away, and training it leaves the network."""

from pathlib import Path

import pytest
import torch
from commands import refused
from waves import Shifts, moved_pair, press_flow, random_weights, weights_of

from gelflow.config import REGISTRATIONS, ModelConfig, TrainConfig
from gelflow.config.sources import train_config
from gelflow.models.denoiser import Denoiser
from gelflow.models.weights import load_weights, weights_file
from gelflow.training import train

MODEL = ModelConfig(levels=4, projected_channels=8, registration=REGISTRATIONS["motion"])
LOSS = {"lambda_s": [1.0, 1.0, 1.0]}


def test_a_fresh_denoiser_leaves_the_flow_of_any_size_and_a_pair_does_not_see_the_others_of_its_batch() -> None:
    torch.manual_seed(0)
    denoiser = Denoiser()
    flow, network, image1, image2 = (torch.rand(2, channels, 67, 91) for channels in (2, 2, 3, 3))
    assert torch.equal(denoiser(flow, network, image1, image2), flow)
    torch.nn.init.normal_(denoiser.head.weight)
    both = denoiser(flow, network, image1, image2)
    alone = denoiser(flow[1:], network[1:], image1[1:], image2[1:])
    assert not torch.allclose(both, flow)
    torch.testing.assert_close(both[1:], alone, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("registration", ["motion", "brightness"])
def test_the_shipped_denoiser_brings_noisy_images_closer_to_the_motion_but_not_to_brightness(registration: str) -> None:
    truth = press_flow(120, 160, 1.0)[None]
    images = [image[None].float() for image in moved_pair(truth[0], 3)]
    random = torch.Generator().manual_seed(1)
    images = [image + 0.04 * torch.randn(image.shape, generator=random) for image in images]
    model = load_weights(weights_file(None))
    model.config = model.config.model_copy(update={"registration": REGISTRATIONS[registration]})
    errors = []
    for denoiser in (model.denoiser, None):
        model.denoiser = denoiser
        errors.append((model.flow(*images) - truth).norm(dim=1).mean())
    assert errors[0] < 0.95 * errors[1] if registration == "motion" else errors[0] == errors[1]


@pytest.mark.parametrize("radius", [30, 60])
def test_a_gel_in_a_round_window_on_black_has_a_flow_to_itself(radius: int) -> None:
    """Where nothing is seen, the variance of a step is rounding error of either sign."""
    y, x = torch.meshgrid(torch.arange(160.0), torch.arange(224.0), indexing="ij")
    gel = 0.6 - 0.4 * torch.exp(-(((x % 20) - 10) ** 2 + ((y % 20) - 10) ** 2) / 8)
    image = (255 * gel * ((x - 112) ** 2 + (y - 80) ** 2 < radius**2)).round().div(255).expand(1, 3, -1, -1)
    assert load_weights(weights_file(None)).flow(image, image).isfinite().all()


def test_training_on_registered_flow_adds_a_denoiser_and_teaches_it_alone(tmp_path: Path) -> None:
    start = random_weights(tmp_path / "network.safetensors", MODEL)
    config = TrainConfig(
        model=MODEL.model_copy(update={"denoise": True}), loss=LOSS, supervision="registered", batch_size=2, steps=3,
        learning_rate=1e-3, device="cpu", ema_decay=0.5,
    )  # fmt: skip
    trained = train(config, Shifts(2, 64, 2.0, seed=1), None, tmp_path / "a", initial=start).weights
    before, after = weights_of(start), weights_of(trained)
    assert all(torch.equal(after[name], value) for name, value in before.items())
    assert after["denoiser.head.weight"].abs().max() > 0
    refused("needs model.denoise = true", train_config, None, ["supervision=registered"])
    refused('"registered" need', train, config, Shifts(2, 64, 2.0, seed=1, flow=False), None, tmp_path / "b")
    others = train(config.model_copy(update={"supervision": "flow"}), Shifts(2, 64, 2.0, seed=1), None, tmp_path / "c")
    assert not load_weights(others.weights).denoiser.head.weight.any()
