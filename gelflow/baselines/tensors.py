"""Images and flows between the arrays of methods, (H, W, C), and torch's tensors, (1, C, H, W)."""

from typing import Any

import numpy as np

from gelflow.arrays import FlowArray, ImageArray, MapArray


def as_tensor(image: ImageArray, device: str) -> Any:
    """An image or flow (H, W, C) float32 as a tensor (1, C, H, W) on a device."""
    import torch

    return torch.from_numpy(np.ascontiguousarray(np.moveaxis(image, -1, 0)))[None].to(device)


def as_array(flow: Any) -> FlowArray:
    """The first flow of a tensor (B, 2, H, W) as (H, W, 2) float32; waits for the device."""
    array: FlowArray = flow[0].permute(1, 2, 0).float().contiguous().cpu().numpy()
    return array


def uncertainty(flow: FlowArray, image1: ImageArray, image2: ImageArray, device: str) -> tuple[MapArray, MapArray]:
    """Sigma in px and the probability to be seen in image 2, see `gelflow.models.uncertainty`; (H, W) float32."""
    from gelflow.models.uncertainty import flow_sigma

    sigma, visible = flow_sigma(*(as_tensor(array, device) for array in (flow, image1, image2)))
    return sigma[0, 0].cpu().numpy(), visible[0, 0].cpu().numpy()
