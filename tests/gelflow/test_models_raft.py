"""RAFT: published names and shapes, published weights where they lie beside the repository, padding, lookup."""

import itertools
from pathlib import Path

import pytest
import torch
from commands import refused
from torch import Tensor
from waves import moved_pair

from gelflow.models.raft import RAFT, load_raft
from gelflow.models.raft.network import correlation_pyramid, enlarge_bilinear, enlarge_convex, lookup

PUBLISHED = Path(__file__).resolve().parents[2].parent / "shared" / "weights" / "raft-small" / "raft-small.pth"


@pytest.fixture(scope="module")
def small() -> RAFT:
    torch.manual_seed(0)
    return RAFT(large=False, iterations=3).eval()


def published_names(large: bool) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the published state dictionaries, from the paper's description and the small file's list."""
    shapes: dict[str, tuple[int, ...]] = {}

    def conv(name: str, outputs: int, inputs: int, rows: int, columns: int | None = None) -> None:
        shapes.update({f"{name}.weight": (outputs, inputs, rows, columns or rows), f"{name}.bias": (outputs,)})

    def norm(name: str, channels: int, batch: bool) -> None:
        if batch:
            shapes.update({f"{name}.{part}": (channels,) for part in ("weight", "bias", "running_mean", "running_var")})
            shapes[f"{name}.num_batches_tracked"] = ()

    stages = (64, 96, 128) if large else (32, 64, 96)
    for net, outputs in (("fnet", 256 if large else 128), ("cnet", 256 if large else 160)):
        batch, inputs = large and net == "cnet", stages[0]
        conv(f"{net}.conv1", inputs, 3, 7)
        norm(f"{net}.norm1", inputs, batch)
        for (stage, channels), unit in itertools.product(enumerate(stages, start=1), (0, 1)):
            at, inner = f"{net}.layer{stage}.{unit}", channels // 4
            kernels = [(channels, inputs, 3), (channels, channels, 3)]
            if not large:
                kernels = [(inner, inputs, 1), (inner, inner, 3), (channels, inner, 1)]
            for number, kernel in enumerate(kernels, start=1):
                conv(f"{at}.conv{number}", *kernel)
            norms = ["norm1", "norm2"]
            if unit == 0 and stage > 1:
                conv(f"{at}.downsample.0", channels, inputs, 1)
                norms += ["downsample.1", "norm3"]  # the same tensors twice
            for name in norms:
                norm(f"{at}.{name}", channels, batch)
            inputs = channels
        conv(f"{net}.conv2", outputs, stages[2], 1)
    encoder, hidden, head = "update_block.encoder", 128 if large else 96, 256 if large else 128
    kernels = [("convc1", 96, 196, 1), ("convf1", 64, 2, 7), ("convf2", 32, 64, 3), ("conv", 80, 128, 3)]
    if large:
        kernels = [("convc1", 256, 324, 1), ("convc2", 192, 256, 3), ("convf1", 128, 2, 7), ("convf2", 64, 128, 3),
                   ("conv", 126, 256, 3)]  # fmt: skip
    for name, *kernel in kernels:
        conv(f"{encoder}.{name}", *kernel)
    sides = {"1": (1, 5), "2": (5, 1)} if large else {"": (3, 3)}
    for gate, suffix in itertools.product("zrq", sides):
        conv(f"update_block.gru.conv{gate}{suffix}", hidden, 384 if large else 242, *sides[suffix])
    conv("update_block.flow_head.conv1", head, hidden, 3)
    conv("update_block.flow_head.conv2", 2, head, 3)
    if large:
        conv("update_block.mask.0", 256, 128, 3)
        conv("update_block.mask.2", 576, 256, 1)
    return shapes


@pytest.mark.parametrize("large", [False, True])
def test_a_published_state_dictionary_loads_strictly(large: bool, tmp_path: Path) -> None:
    torch.manual_seed(1)
    tensors: dict[str, Tensor] = {}
    for name, shape in published_names(large).items():
        copy = name.replace("norm3", "downsample.1")
        tensors[name] = tensors[copy] if copy in tensors else 0.01 * torch.rand(shape)
    path = tmp_path / "raft.pth"
    torch.save({f"module.{name}": value for name, value in tensors.items()}, path)
    network = load_raft(path)
    loaded = network.state_dict()
    assert set(loaded) == {name for name in tensors if "norm3" not in name}
    assert all(torch.equal(loaded[name], tensors[name].to(loaded[name].dtype)) for name in loaded)
    # the published numbers of weights, in millions: 5.3 and 1.0 (paper, table 1 and section 4.5)
    assert sum(p.numel() for p in network.parameters()) == (5_257_536 if large else 990_162)


@pytest.mark.parametrize(("large", "size"), [(False, (64, 64)), (False, (67, 90)), (True, (65, 72))])
def test_the_flow_has_the_images_size(large: bool, size: tuple[int, int]) -> None:
    images = torch.rand(2, 2, 3, *size).unbind()
    with torch.no_grad():
        flow = RAFT(large=large, iterations=2).eval()(*images)
    assert flow.shape == (2, 2, *size)
    assert torch.isfinite(flow).all()


def test_encoders_see_images_from_minus_one_to_one_and_neither_batch_nor_padding_matters(small: RAFT) -> None:
    seen: list[tuple[float, float]] = []
    image = torch.zeros(1, 3, 64, 64)
    image[..., 32:] = 1
    hooks = [net.register_forward_pre_hook(lambda _, inputs: seen.append(inputs[0].aminmax()))
             for net in (small.fnet, small.cnet)]  # fmt: skip
    with torch.no_grad():
        small(image, image)
    for hook in hooks:
        hook.remove()
    assert seen == [(-1, 1)] * 3
    batch = torch.rand(2, 2, 3, 76, 84).unbind()
    alone = [image[1:] for image in batch]
    # 76 x 84 is padded by 2 px on each side to 80 x 88, which is what `framed` is already.
    framed = [torch.nn.functional.pad(image, (2, 2, 2, 2), mode="replicate") for image in alone]
    with torch.no_grad():
        flow = small(*alone)
        # The same sums in another order: float32 rounding (6e-8) through three updates and upsampling by 8, on 1 px.
        torch.testing.assert_close(small(*batch)[1:], flow, rtol=0, atol=1e-4)
        torch.testing.assert_close(small(*framed)[..., 2:-2, 2:-2], flow, rtol=0, atol=1e-4)


def test_the_lookup_orders_displacements_column_by_column_and_enlarging_multiplies_by_eight() -> None:
    features1, features2 = torch.rand(2, 1, 5, 16, 24, dtype=torch.float64)
    pyramid = correlation_pyramid(features1, features2)
    product = torch.einsum("bchw,bcij->bhwij", features1, features2) / 5**0.5
    assert [tuple(level.shape[2:]) for level in pyramid] == [(16, 24), (8, 12), (4, 6), (2, 3)]
    row, column = 6, 8
    position = torch.tensor([column + 0.0, row + 2.0], dtype=torch.float64).view(1, 2, 1, 1).expand(1, 2, 16, 24)
    found = lookup(pyramid, position, radius=1)[0, :, row, column].view(4, 3, 3)  # level, across, down
    at_pixel = product[0, row, column]
    fine = at_pixel[row + 1 : row + 4, column - 1 : column + 2].T  # exact reads at integers: double precision
    torch.testing.assert_close(found[0], fine, rtol=0, atol=1e-12)
    # level 1: index 8 is read at 4, index 8 (row) at 4; each value is the mean of a 2x2 block
    blocks = torch.nn.functional.avg_pool2d(at_pixel[None], 2)[0, 3:6, 3:6].T
    torch.testing.assert_close(found[1], blocks, rtol=0, atol=1e-12)
    flow = torch.tensor([1.5, -0.25]).view(1, 2, 1, 1).expand(1, 2, 4, 5).contiguous()
    assert torch.allclose(enlarge_bilinear(flow), 8 * flow[..., :1, :1].expand(1, 2, 32, 40))
    weights = torch.randn(1, 9 * 64, 4, 5)
    fine = enlarge_convex(flow, weights)[..., 8:24, 8:32]  # away from the border, where zeros are neighbours
    assert torch.allclose(fine, (8 * flow[..., :1, :1]).expand_as(fine), atol=1e-5)
    # All weight on the centre (neighbour 4): a block of constant flow per coarse pixel.
    chosen = torch.full((1, 9, 64, 4, 5), -1e4)
    chosen[:, 4] = 0
    flow = torch.rand(1, 2, 4, 5)
    blocks = enlarge_convex(flow, chosen.view(1, 576, 4, 5))
    assert torch.allclose(blocks, 8 * flow.repeat_interleave(8, -1).repeat_interleave(8, -2))


@pytest.mark.skipif(not PUBLISHED.is_file(), reason="no published RAFT-small weights beside the repository")
def test_published_small_weights_see_shifts_and_no_motion() -> None:
    network = load_raft(PUBLISHED)
    for shift in ((0.0, 0.0), (1.5, -0.75), (3.3, 2.1), (6.0, -4.0)):
        true = torch.tensor(shift, dtype=torch.float64).view(2, 1, 1).expand(2, 101, 131)
        with torch.no_grad():
            flow = network(*(image[None].float() for image in moved_pair(true, seed=4)))[0]
        error = (flow - true).norm(dim=0)[16:-16, 16:-16]
        # The network works at an eighth of the resolution: 0.3 px is 0.04 px there. Seen: .05, .10, .07, .19 px.
        assert error.mean() < (0.3 if any(shift) else 0.1), (shift, error.mean())


@pytest.mark.parametrize("kind", ["list", "other", "missing key"])
def test_files_of_other_tensors_are_refused(kind: str, tmp_path: Path) -> None:
    tensors = {f"module.{name}": torch.zeros(shape) for name, shape in published_names(False).items()}
    contents = {"list": [1, 2], "other": {"layer.weight": torch.zeros(3)}}
    contents["missing key"] = {name: value for name, value in tensors.items() if "convf1" not in name}
    torch.save(contents[kind], tmp_path / "weights.pth")
    assert "\n" not in refused(r"weights\.pth: ", load_raft, tmp_path / "weights.pth")
