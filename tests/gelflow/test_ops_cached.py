"""Tensors made once: for each set of arguments one, of use in training wherever it was made."""

import torch

from gelflow.ops.cached import cached


def test_one_tensor_for_each_set_of_arguments() -> None:
    made: list[int] = []

    @cached
    def ones(pixels: int, dtype: torch.dtype) -> torch.Tensor:
        made.append(pixels)
        return torch.ones(pixels, dtype=dtype)

    assert ones(3, torch.float32) is ones(3, torch.float32)
    assert ones(3, torch.float64).dtype == torch.float64
    assert made == [3, 3]


def test_a_tensor_made_in_inference_mode_takes_part_in_training() -> None:
    """Fails without leaving inference mode: autograd refuses to save what was made there."""

    @cached
    def twos(pixels: int) -> torch.Tensor:
        return torch.full((pixels,), 2.0)

    with torch.inference_mode():
        twos(3)
    x = torch.ones(3, requires_grad=True)
    (twos(3) * x).sum().backward()
    assert x.grad is not None
    assert x.grad.tolist() == [2.0, 2.0, 2.0]
