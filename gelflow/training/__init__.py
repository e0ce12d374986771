"""Training: one run in one folder, resumable, with logs and weights."""

from gelflow.training.run import train

__all__ = ["train"]
