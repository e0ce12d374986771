"""The losses of the paper, their alternatives, and their sum over scales."""

from gelflow.losses.multiscale import flow_loss, self_supervised_loss

__all__ = ["flow_loss", "self_supervised_loss"]
