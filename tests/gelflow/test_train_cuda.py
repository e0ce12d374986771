"""Training on a CUDA device: recorded passes, resident pairs and the device's correlation against plain execution."""

from pathlib import Path

import pytest
import torch
from torch.nn.utils import parameters_to_vector
from waves import Shifts

from gelflow.config import REGISTRATIONS, LossConfig, ModelConfig, Registration, TrainConfig
from gelflow.models import GelFlow
from gelflow.models.estimate import estimate_flow, flows_at
from gelflow.models.recorded import GraphedNetwork, Recorder
from gelflow.models.registration import registered
from gelflow.models.weights import load_weights, weights_file
from gelflow.models.working_size import sized_sigma
from gelflow.ops.correlation import local_correlation
from gelflow.training import train

pytestmark = [pytest.mark.cuda, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")]

SMALL = ModelConfig(levels=5, estimator="shared", refine="half")


def images(seed: int, side: int = 96) -> list[torch.Tensor]:
    random = torch.Generator().manual_seed(seed)
    return [torch.rand(2, 3, side, side, generator=random).cuda() for _ in range(2)]


def shifted(seed: int, side: int = 96) -> list[torch.Tensor]:
    """A pair that has a flow: on others registration would make much of rounding."""
    sample = Shifts(1, side, 1.0, seed=seed)[0]
    return [sample[name].expand(2, -1, -1, -1).cuda() for name in ("image1", "image2")]


def loss_and_gradient(network: object, model: GelFlow, pair: list[torch.Tensor]) -> tuple[float, torch.Tensor]:
    model.zero_grad()
    loss = sum(flow.square().mean() for flow in network(*pair))  # type: ignore[operator]
    loss.backward()
    return loss.item(), torch.cat([parameter.grad.flatten().clone() for parameter in model.parameters()])


@pytest.mark.parametrize(("half", "close"), [(False, 1e-3), (True, 0.05)])
def test_recorded_passes_are_the_networks_own(half: bool, close: float) -> None:
    torch.manual_seed(0)
    model = GelFlow(SMALL).cuda().train()
    graphed = GraphedNetwork(model)
    for seed in range(3):
        with torch.autocast("cuda", torch.bfloat16, enabled=half):
            loss, gradient = loss_and_gradient(graphed, model, images(seed))
            expected, plain = loss_and_gradient(model, model, images(seed))
        # float32 with sums in another order, TF32 in the convolutions of both.
        assert loss == pytest.approx(expected, rel=close)
        assert half or (gradient - plain).norm() < 1e-2 * plain.norm()
        with torch.no_grad():  # the recording reads the weights anew
            for parameter in model.parameters():
                parameter.mul_(1.1)
    if not half:
        assert graphed(*images(9, 64))[0].shape == (2, 2, 64, 64)


@pytest.mark.parametrize("aim", ["none", "motion", "both", "brightness"])
def test_a_network_in_use_is_recorded_for_each_shape(aim: Registration) -> None:
    torch.manual_seed(0)
    model = GelFlow(SMALL.model_copy(update={"registration": REGISTRATIONS[aim]})).cuda().eval()
    run = Recorder()
    # The second and third call with a shape replay.
    for seed, side in enumerate([96, 96, 96, 64, 96, 96]):
        pair = shifted(seed, side)
        sizes = ((side, side),)
        (found,) = run(flows_at, model, sizes, *pair)
        run(flows_at, model, sizes, *shifted(seed + 20, side))
        with torch.no_grad():
            expected = model.flow(*pair)
        torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-3)


def test_large_images_and_their_sigma_are_recorded_at_both_sizes() -> None:
    model, run = load_weights(weights_file(None), "cuda"), Recorder()
    pair = shifted(4, 480)
    expected = estimate_flow(model, *pair)
    sigma, _ = sized_sigma(expected, *pair, (240, 240))
    for _ in range(3):
        torch.testing.assert_close(estimate_flow(model, *pair, run=run), expected, rtol=1e-3, atol=1e-3)
        torch.testing.assert_close(run(sized_sigma, expected, *pair, (240, 240))[0], sigma, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("aim", ["motion", "both", "brightness"])
def test_registration_is_that_of_the_cpu(aim: Registration) -> None:
    settings = REGISTRATIONS[aim]
    first, second = shifted(3)
    place = torch.arange(96.0, device="cuda") - 48
    # A shade, where both aims follow brightness.
    second = second + 0.2 * torch.exp(-(place**2 + place.view(-1, 1) ** 2) / (2 * 8**2))
    flow = torch.zeros(2, 2, *first.shape[-2:], device="cuda")
    here = registered(flow.cpu(), first.cpu(), second.cpu(), settings)
    # float32: sums over some thousand pixels in another order, through up to 22 Gauss-Newton steps. Images off by 1e-6
    # move the flow by 2e-4 px at most, on a CPU.
    torch.testing.assert_close(registered(flow, first, second, settings).cpu(), here, rtol=0, atol=1e-2)


@pytest.mark.parametrize("radius", [1, 4])
def test_correlation_is_that_of_the_cpu(radius: int) -> None:
    random = torch.Generator().manual_seed(1)
    one, two = (torch.randn(2, 8, 12, 17, generator=random, dtype=torch.float64, requires_grad=True) for _ in range(2))
    there = [state.detach().cuda().requires_grad_() for state in (one, two)]
    here = local_correlation(one, two, radius)
    costs = local_correlation(*there, radius)
    torch.testing.assert_close(costs.cpu(), here, rtol=1e-12, atol=1e-12)
    weights = torch.randn(here.shape, generator=random, dtype=torch.float64)
    (here * weights).sum().backward()
    (costs * weights.cuda()).sum().backward()
    for plain, moved in zip((one, two), there, strict=True):
        torch.testing.assert_close(moved.grad.cpu(), plain.grad, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("supervision", ["flow", "mixed", "self"])
def test_a_run_with_graph_and_cache_is_one_without(tmp_path: Path, supervision: str) -> None:
    pairs = Shifts(6, 96, 2.0, seed=1)
    weights = []
    for fast in (True, False):
        config = TrainConfig(supervision=supervision, batch_size=2, steps=4, model=SMALL, cuda_graph=fast, cache=fast,
                             loss=LossConfig(lambda_s=(1.0,) * 4), device="cuda")  # fmt: skip
        result = train(config, pairs, None, tmp_path / str(fast))
        weights.append(parameters_to_vector(load_weights(result.weights).parameters()).detach())
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        start = parameters_to_vector(GelFlow(SMALL).parameters()).detach()
    # Adam's first steps are the learning rate times the gradient's sign: signs of gradients near zero may differ.
    assert (weights[0] - weights[1]).norm() < 0.2 * (weights[1] - start).norm()
