"""Training: one run in one folder, resumable, with logs and weights."""

from gelflow.train.run import train

__all__ = ["train"]
