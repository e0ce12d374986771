"""Smooth fields from few numbers: uniform cubic B-splines on a grid of control points.

``V(x, y) = sum_kl beta(y / S - k) beta(x / S - l) c_kl``, beta the centred cubic B-spline, S the spacing in px, control
points from one spacing before the first pixel to at least one after the last. Fields have continuous second
derivatives; constant and affine ones are reproduced exactly. As matrices, ``V = B_y c B_x^T``; the adjoint is
``B_y^T V B_x``. Unser, "Splines: a perfect fit for signal and image processing", 1999.
"""

import torch
from torch import Tensor


def spline_basis(pixels: int, spacing: int, like: Tensor) -> Tensor:
    """Value of each control point's spline at each pixel along one axis.

    Args:
        pixels: Number n of pixels.
        spacing: S, px.
        like: Gives dtype and device.

    Returns:
        (n, m) with m = ceil((n - 1) / S) + 3; every row sums to one.
    """
    points = -(-(pixels - 1) // spacing) + 3
    place = torch.arange(pixels, dtype=torch.float64).view(-1, 1) / spacing
    distance = (place - (torch.arange(points, dtype=torch.float64).view(1, -1) - 1)).abs()
    near = (4 - 6 * distance**2 + 3 * distance**3) / 6
    far = (2 - distance).clamp(min=0) ** 3 / 6
    return torch.where(distance < 1, near, far).to(like)


def differences(points: int, order: int, like: Tensor) -> Tensor:
    """Matrix of the differences of first or second order of neighbouring control points, (points - order, points)."""
    matrix = torch.eye(points, dtype=torch.float64)
    for _ in range(order):
        matrix = matrix[1:] - matrix[:-1]
    return matrix.to(like)


class SplineGrid:
    """Control points over an image, and the quadratic form that measures how much their field bends.

    Args:
        rows: Of the image.
        columns: Of the image.
        spacing: S, px.
        like: Gives dtype and device.

    Attributes:
        shape: Rows and columns of control points.
    """

    def __init__(self, rows: int, columns: int, spacing: int, like: Tensor) -> None:
        self.spacing = spacing
        self.basis_y, self.basis_x = spline_basis(rows, spacing, like), spline_basis(columns, spacing, like)
        self.shape = (self.basis_y.shape[1], self.basis_x.shape[1])
        self._pixels_per_point = rows * columns / (self.shape[0] * self.shape[1])
        (first_y, second_y), (first_x, second_x) = [
            [matrix.T @ matrix for matrix in (differences(points, 1, like), differences(points, 2, like))]
            for points in self.shape
        ]
        self._first, self._second = (first_y, first_x), (second_y, second_x)

    def field(self, points: Tensor) -> Tensor:
        """The field (B, C, H, W) of control points (B, C, *shape)."""
        return self.basis_y @ points @ self.basis_x.T

    def adjoint(self, field: Tensor) -> Tensor:
        """The transpose of `field`: from (B, C, H, W) to (B, C, *shape)."""
        return self.basis_y.T @ field @ self.basis_x

    def diagonal(self, weight: Tensor) -> Tensor:
        """Diagonal of adjoint · diag(weight) · field, (B, C, *shape), for a weight (B, C, H, W)."""
        return self.basis_y.square().T @ weight @ self.basis_x.square()

    def bending(self, points: Tensor) -> Tensor:
        """Half the gradient of the bending energy times S^2.

        The energy is ``sum over pixels of S^2 (V_xx^2 + 2 V_xy^2 + V_yy^2)``, derivatives taken as differences of the
        control points over S. The factor makes a stiffness mean the same at every spacing for bumps of the grid's size.

        Args:
            points: (B, C, *shape), px.
        """
        (first_y, first_x), (second_y, second_x) = self._first, self._second
        energy = second_y @ points + points @ second_x + 2 * (first_y @ points @ first_x)
        return self._pixels_per_point / self.spacing**2 * energy

    @property
    def bending_diagonal(self) -> float:
        """Largest entry of the diagonal of `bending` as a matrix: 6 + 6 + 2 · 2 · 2 differences."""
        return self._pixels_per_point / self.spacing**2 * 20.0
