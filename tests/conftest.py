"""Processes that run tests side by side leave one another a core each."""

import os

if "PYTEST_XDIST_WORKER" in os.environ:  # before numpy and PyTorch start their threads
    os.environ.setdefault("OMP_NUM_THREADS", "1")
