"""Fixtures that several files share."""

from pathlib import Path

import pytest
from tiny_scene import own_cache, write_tiny


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    return write_tiny(tmp_path)


@pytest.fixture
def one_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    """One mesh for all runs: the mesher is random."""
    own_cache(monkeypatch)
