"""Augmented-Lagrangian digital image correlation: pyALDIC (PyPI al-dic, BSD-3), the accuracy to beat.

Windows of 32 px, a node every 8 px, its defaults otherwise; float64 luma. Nodes that it could not track are dropped,
the others interpolated as in `gelflow.baselines.scattered`, which also fills the margin of half a window that has no
nodes. The first call compiles its code, which takes minutes.

It is optional and not a requirement of this package: it asks for a graphical toolkit and for a build of OpenCV that
hides the one used here, neither of which its numerical part needs.
"""

import warnings
from importlib import import_module
from typing import Any

import numpy as np

from gelflow.arrays import FlowArray, ImageArray
from gelflow.baselines.scattered import dense_flow
from gelflow.errors import InputError
from gelflow.files.image import check_images
from gelflow.methods.name import MethodName

INSTALL = "pip install --no-deps al-dic && pip install numba imageio"
LUMA = np.array([0.299, 0.587, 0.114])
MINIMUM_SIDE = 64
"""Shortest side of an image, px, that holds enough windows."""


class ALDIC:
    """pyALDIC with windows of 32 px and a node every 8 px."""

    name = MethodName("pyALDIC")

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        """See `Method.flow`; InputError also where pyALDIC is not installed, or could not solve this pair."""
        check_images(image1, image2)
        height, width = image1.shape[:2]
        if min(height, width) < MINIMUM_SIDE:
            raise InputError(f"{width} x {height} px: {self.name} needs {MINIMUM_SIDE} px a side")
        dic, grid = _package()
        roi = grid(gridx=(0, width - 1), gridy=(0, height - 1))
        settings = dic.dicpara_default(winsize=32, winstepsize=8, img_size=(height, width), gridxy_roi_range=roi)
        grey = [image.astype(np.float64) @ LUMA for image in (image1, image2)]
        everywhere = np.ones((height, width))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # notes that it adapts its search to small images
                result = dic.run_aldic(settings, grey, [everywhere, everywhere], compute_strain=False)
        except (ValueError, RuntimeError, IndexError, np.linalg.LinAlgError) as error:
            raise InputError(f"{self.name} could not solve this pair: {error}") from error
        points = np.asarray(result.dic_mesh.coordinates_fem, np.float64)
        motion = np.asarray(result.result_disp[0].U, np.float64).reshape(-1, 2)
        tracked = np.isfinite(motion).all(axis=1)
        if not tracked.any():
            raise InputError(f"{self.name} could not track any point of this pair")
        return dense_flow(points[tracked], motion[tracked], height, width)


def _package() -> tuple[Any, Any]:
    try:
        # Numba's OpenMP layer would change torch's number of threads: networks took five times as long afterwards.
        import_module("numba").config.THREADING_LAYER = "workqueue"
        return import_module("al_dic"), import_module("al_dic.core.data_structures").GridxyROIRange
    except ImportError as error:
        raise InputError(f"method al-dic: pyALDIC cannot be imported ({error}); {INSTALL}") from error
