"""The service by which processes share GPUs begins and ends with the process that wants it."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from synth.pipeline import shared_gpus
from synth.pipeline.shared_gpus import PIPES, share_gpus

CONTROL = """#!/bin/sh
if [ "$1" = -d ]; then echo "begun, GPUs $CUDA_VISIBLE_DEVICES" >> "$LOG"; exit $STATUS; fi
read word; echo "$word" >> "$LOG"
"""
WORKS, FAILS = "raise SystemExit(0)", "raise SystemExit(1)"


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What a program of the service's name is told."""
    control = tmp_path / shared_gpus.CONTROL
    control.write_text(CONTROL)
    control.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    for name, value in (("LOG", str(tmp_path / "log")), ("STATUS", "0"), ("CUDA_VISIBLE_DEVICES", "1")):
        monkeypatch.setenv(name, value)
    monkeypatch.setenv(PIPES, "")
    monkeypatch.delenv(PIPES)  # and again at the end
    monkeypatch.setattr(shared_gpus, "USUAL", tmp_path / "none")
    share_gpus.cache_clear()
    return tmp_path / "log"


def ended(log: Path) -> bool:
    until = time.monotonic() + 30
    while time.monotonic() < until:
        if log.read_text().endswith("quit\n"):
            return True
        time.sleep(0.02)
    return False


def test_a_service_begins_once_and_ends_when_its_pipe_does(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_gpus, "_PROBE", WORKS)
    service = share_gpus()
    assert service is not None
    assert share_gpus() is service
    assert log.read_text() == "begun, GPUs \n"  # which it would number anew
    folder = Path(os.environ[PIPES])
    assert folder.is_dir()
    service.stdin.close()
    assert ended(log)
    service.wait(30)
    assert not folder.exists()


def test_it_ends_with_a_process_that_is_killed(log: Path) -> None:
    code = (
        "import os, signal; from synth.pipeline import shared_gpus as s; from pathlib import Path;"
        f"s._PROBE, s.USUAL = {WORKS!r}, Path('none'); assert s.share_gpus(); os.kill(os.getpid(), signal.SIGKILL)"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == -9
    assert ended(log)


@pytest.mark.parametrize("lacks", ["program", "start", "gpu", "need"])
def test_none_is_left_behind_where_it_cannot_serve(log: Path, monkeypatch: pytest.MonkeyPatch, lacks: str) -> None:
    monkeypatch.setattr(shared_gpus, "_PROBE", FAILS)
    if lacks == "program":
        (log.parent / shared_gpus.CONTROL).unlink()
    elif lacks == "start":
        monkeypatch.setenv("STATUS", "1")
    elif lacks == "need":
        monkeypatch.setattr(shared_gpus, "USUAL", log.parent)  # the user's own
    assert share_gpus() is None
    assert PIPES not in os.environ
    assert ended(log) if lacks in ("start", "gpu") else not log.exists()
