"""Flow fields in Middlebury's .flo format (Baker et al. 2011, vision.middlebury.edu/flow).

Little-endian: float32 202021.25, int32 width, int32 height, then height x width x (u, v) float32, row by row. By the
format's convention a value above 1e9 means unknown; here unknown flow is NaN in memory and 1e10 in the file.
"""

from pathlib import Path

import numpy as np

from gelflow.arrays import FlowArray
from gelflow.files.atomic import replacing

MAGIC = np.float32(202021.25)
UNKNOWN = np.float32(1e10)


def write_flo(path: Path, flow: FlowArray) -> None:
    """Writes a flow (H, W, 2) in px; NaN becomes the format's unknown flow. Replaces the file as a whole."""
    height, width = flow.shape[:2]
    data = np.where(np.isnan(flow), UNKNOWN, flow).astype("<f4")
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(MAGIC.astype("<f4").tobytes() + np.array([width, height], "<i4").tobytes() + data.tobytes())
