"""Image pairs: data sets with and without exact flow, and the choice of pairs from recordings."""

from gelflow.data.open import open_all, open_pairs
from gelflow.data.pairs import PairDataset, PairRecord, join

__all__ = ["PairDataset", "PairRecord", "join", "open_all", "open_pairs"]
