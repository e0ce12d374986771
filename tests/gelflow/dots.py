"""Pictures of dots whose motion is known exactly: a smooth function is evaluated at moved positions."""

import numpy as np
from numpy.typing import NDArray

PITCH = 22.0


def centres(height: int, width: int, seed: int = 0) -> NDArray[np.float64]:
    """Places (N, 2) of dots, px, some 22 px apart, each off its grid by up to 3 px, also beyond the picture."""
    random, margin = np.random.default_rng(seed), 4 * PITCH
    x, y = np.meshgrid(np.arange(-margin, width + margin, PITCH), np.arange(-margin, height + margin, PITCH))
    return np.stack([x, y], axis=-1).reshape(-1, 2) + random.uniform(-3, 3, (x.size, 2))


def picture(x: NDArray, y: NDArray, dots: NDArray[np.float64]) -> NDArray[np.float32]:
    """Dark dots of 6 px with soft edges on a lit ground, (H, W, 3) in [0, 1], at positions in px."""
    value = np.full(x.shape, 0.0)
    for column, row in dots:
        near = (np.abs(x - column) < 10) & (np.abs(y - row) < 10)
        value[near] += 1 / (1 + np.exp((np.hypot(x[near] - column, y[near] - row) - 3) / 0.6))
    return ((0.7 - 0.5 * np.clip(value, 0, 1))[..., None] * np.array([1.0, 0.9, 0.8])).astype(np.float32)


def grid(height: int, width: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return x, y


class Turn:
    """A motion of the plane: a turn about the picture's centre, an enlargement, and a shift."""

    def __init__(self, turn_deg: float = 0.0, zoom: float = 1.0, shift: tuple[float, float] = (0.0, 0.0)) -> None:
        angle = np.deg2rad(turn_deg)
        self._matrix = zoom * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        self._shift = np.array(shift)

    def flow(self, height: int, width: int) -> NDArray[np.float64]:
        places = np.stack(grid(height, width), axis=-1)
        return self.moved(places, height, width) - places

    def moved(self, places: NDArray[np.float64], height: int, width: int) -> NDArray[np.float64]:
        middle = np.array([width, height]) / 2
        return (places - middle) @ self._matrix.T + middle + self._shift

    def frame(self, height: int, width: int, dots: NDArray[np.float64], noise: float = 0.005) -> NDArray[np.uint8]:
        """The picture after the motion, I_t(x) = I_0(motion^-1(x)), with the camera's noise."""
        middle = np.array([width, height]) / 2
        before = (np.stack(grid(height, width), axis=-1) - middle - self._shift) @ np.linalg.inv(self._matrix).T
        image = picture(*np.moveaxis(before + middle, -1, 0), dots)
        random = np.random.default_rng(int(1e3 * abs(self._shift[0])) + 1)
        return np.rint(255 * np.clip(image + random.normal(0, noise, image.shape), 0, 1)).astype(np.uint8)
