"""Methods without weights that this project's are compared with."""

from gelflow.baselines.registry import CLASSICAL, named_methods

__all__ = ["CLASSICAL", "named_methods"]
