"""Training: one run in one folder, resumable, with logs and weights."""

from gelflow.train.run import TrainResult, train

__all__ = ["TrainResult", "train"]
