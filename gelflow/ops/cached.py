"""Tensors that depend on an image's sides and a window alone: made once and cached for the life of the process.

The cache is never emptied, because a recorded CUDA graph goes on reading its tensors where they lie.
"""

import functools
from collections.abc import Callable
from typing import ParamSpec

import torch
from torch import Tensor

P = ParamSpec("P")


def cached(make: Callable[P, Tensor]) -> Callable[P, Tensor]:
    """A function whose tensors, which must not be changed, are made once for each set of its (hashable) arguments."""
    made = functools.cache(make)

    @functools.wraps(make)
    def tensor(*args: P.args, **kwargs: P.kwargs) -> Tensor:
        if torch.compiler.is_compiling() or torch.onnx.is_in_onnx_export():
            return make(*args, **kwargs)  # a tensor of the tracer's must not be kept
        with torch.inference_mode(False), torch.no_grad():  # one of inference mode could not take part in training
            return made(*args, **kwargs)  # type: ignore[arg-type]  # hashable, as asked for

    return tensor
