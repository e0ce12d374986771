"""Image pairs: data sets with and without exact flow, and the choice of pairs from recordings."""

from gelflow.data.open import open_all
from gelflow.data.pairs import PairDataset

__all__ = ["PairDataset", "open_all"]
