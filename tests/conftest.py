"""Processes that run tests side by side leave one another a core each; `--permute` as `permuted` says."""

import os
from pathlib import Path

import pytest

if "PYTEST_XDIST_WORKER" in os.environ:  # before numpy and PyTorch start their threads
    os.environ.setdefault("OMP_NUM_THREADS", "1")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--permute", type=int, metavar="SEED", help="number the unknowns of sparse factors at random")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("permute") is not None:
        from permuted import permute

        permute(config.getoption("permute"))


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """With `-m cuda`, files without such a test are not imported: a GPU's machine need not have what they ask for."""
    if config.option.markexpr == "cuda" and collection_path.match("test_*.py"):
        return "mark.cuda" not in collection_path.read_text(encoding="utf-8") or None
    return None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("permute") is not None:
        for item in items:
            if item.get_closest_marker("processes"):
                item.add_marker(pytest.mark.skip(reason="other processes number their unknowns as ever"))
