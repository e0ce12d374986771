"""Weight of a regulariser at each pixel, from the gradient of image 1.

``||grad I||_1 = |I_x| + |I_y|`` by forward differences, mean over colours, images in [0, 1].

- anti_edge (paper, eq. 6): ``1 - exp(-beta ||grad I||_1)``: strong on edges, none where there is no texture.
- edge_aware: ``exp(-beta ||grad I||_1)``: the usual opposite.
- floor: anti_edge, raised to at least `floor`, so that untextured gel is regularised too.
"""

import torch

from gelflow.arrays import Images, Mask
from gelflow.ops.gradients import forward_differences


def regulariser_weight(image: Images, kind: str, beta: float, floor: float) -> Mask:
    """The weight on the (H-1) x (W-1) pixels that have a right and a lower neighbour.

    Returns:
        (B, 1, H-1, W-1) in [0, 1].
    """
    across, down = forward_differences(image)
    fading = torch.exp(-beta * (across.abs() + down.abs()).mean(dim=1, keepdim=True))
    if kind == "edge_aware":
        return fading
    return 1 - fading if kind == "anti_edge" else (1 - fading).clamp(min=floor)
