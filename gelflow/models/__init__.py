"""The GelFlow network and its parts."""

from gelflow.models.gelflow import GelFlow

__all__ = ["GelFlow"]
