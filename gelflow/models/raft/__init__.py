"""RAFT (Teed and Deng 2020), the general-purpose network that the paper compares with; runs published weights."""

from gelflow.models.raft.network import RAFT
from gelflow.models.raft.weights import load_raft, looks_like_raft

__all__ = ["RAFT", "load_raft", "looks_like_raft"]
