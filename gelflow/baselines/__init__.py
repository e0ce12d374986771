"""Methods that estimate the flow of a pair, behind one interface."""

from gelflow.baselines.method import Method
from gelflow.baselines.registry import CLASSICAL, named_methods

__all__ = ["CLASSICAL", "Method", "named_methods"]
