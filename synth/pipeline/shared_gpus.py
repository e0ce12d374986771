"""GPUs for many processes at once, by NVIDIA's Multi-Process Service (MPS).

By default processes take turns on a GPU, in slices of time. By MPS their kernels run side by side, which halves the
time that a worker waits for a frame. A process that has begun to use CUDA before stays outside.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path

PIPES = "CUDA_MPS_PIPE_DIRECTORY"
"""What NVIDIA's libraries and programs find a service by."""
USUAL = Path("/tmp/nvidia-mps")
CONTROL = "nvidia-cuda-mps-control"
_SERVE = f'{CONTROL} -d && echo ready || echo no; cat; echo quit | {CONTROL}; rm -rf "${PIPES}"'
_PROBE = (
    "import ctypes; cuda, p = ctypes.CDLL('libcuda.so.1'), ctypes.c_void_p();"
    "raise SystemExit(cuda.cuInit(0) or cuda.cuDevicePrimaryCtxRetain(ctypes.byref(p), 0))"
)


@cache
def share_gpus() -> subprocess.Popen[bytes] | None:
    """Have the processes that this one starts share GPUs by a service; None where none was begun.

    A service of the user's own is left alone, and none is begun where it does not work. One that is begun ends with
    this process, however that ends: it waits for the end of a pipe.
    """
    if PIPES in os.environ or USUAL.exists() or shutil.which(CONTROL) is None:
        return None
    folder = tempfile.mkdtemp(prefix="synth-mps-")
    own = {key: value for key, value in os.environ.items() if key != "CUDA_VISIBLE_DEVICES"}  # would number GPUs anew
    own |= {PIPES: folder, "CUDA_MPS_LOG_DIRECTORY": folder}
    service = subprocess.Popen(
        ["sh", "-c", _SERVE], env=own, start_new_session=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    assert service.stdin is not None
    assert service.stdout is not None
    if service.stdout.readline() == b"ready\n":
        probe = [sys.executable, "-c", _PROBE]
        if subprocess.run(probe, env=os.environ | {PIPES: folder}, capture_output=True).returncode == 0:
            os.environ[PIPES] = folder
            return service
    service.stdin.close()
    return None
