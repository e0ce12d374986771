"""Which Mitsuba variant renders on this machine: CUDA with OptiX, else LLVM, else scalar.

Dr.Jit accepts LLVM 15 and then aborts the whole process on processors with AVX-512 ("Cannot select: fminimum"), so a
library's version is read before Mitsuba may touch it. `LLVMGetVersion` exists in LLVM's C interface since release 16,
which is also the first that works: a library without that symbol is too old. The library of the Python package comes
before the system's, so that environments installed alike render alike; of the system's the newest names are tried
first, and an old library is opened only where nothing newer was found.
"""

import ctypes
import functools
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, files
from pathlib import Path
from types import ModuleType
from typing import Literal

from synth.errors import InputError
from synth.render.pattern import is_grey
from synth.scene.template import Template

Device = Literal["auto", "cpu", "cuda"]
Version = tuple[int, int, int]

MINIMUM_LLVM = 16
"""Oldest major version that Dr.Jit uses without aborting."""
PACKAGE = "karellen-llvm-core"
"""PyPI's package of LLVM's library; a dependency where it has wheels."""
LLVM_HINT = (
    f"rendering is several times faster with LLVM 16 or newer: 'pip install {PACKAGE}' (Linux on x86-64), 'apt install "
    "libllvm19' (Debian, Ubuntu), 'dnf install llvm-libs' (Fedora), 'conda install -c conda-forge llvm' or 'brew "
    "install llvm' (macOS)"
)
_PATTERNS = (
    "/usr/lib/*-linux-gnu/libLLVM*.so*",
    "/usr/lib/llvm-*/lib/libLLVM*.so*",
    "/usr/lib64/libLLVM*.so*",
    "/usr/lib64/llvm*/lib*/libLLVM*.so*",
    "/usr/lib/libLLVM*.so*",
    "/usr/local/lib/libLLVM*.so*",
    "/opt/homebrew/opt/llvm/lib/libLLVM*.dylib",
    "/usr/local/opt/llvm/lib/libLLVM*.dylib",
)
_PROBE = (
    "import sys, mitsuba as mi; mi.set_variant(sys.argv[1]);"
    "s = mi.load_dict({'type': 'scene', 'shape': {'type': 'rectangle'}});"
    "r = s.ray_test(mi.Ray3f(mi.Point3f(0, 0, 1), mi.Vector3f(0, 0, -1))); sys.exit(0 if r[0] else 3)"
)


@dataclass(frozen=True)
class Variant:
    """A Mitsuba variant that works here, by Mitsuba's name, e.g. "llvm_ad_rgb", and why this one.

    The hint says how to get a faster one, None when there is nothing to gain on this machine; the caller says it, once.
    `llvm` is the library that Dr.Jit is to load; None for other back ends.
    """

    name: str
    reason: str
    hint: str | None = None
    llvm: Path | None = None

    @property
    def is_vectorised(self) -> bool:
        """Whether whole wavefronts of rays are traced at once."""
        return not self.name.startswith("scalar")

    @property
    def is_on_gpu(self) -> bool:
        return self.name.startswith("cuda")

    @property
    def is_mono(self) -> bool:
        """Whether one channel stands for all three."""
        return "_mono" in self.name

    def load(self) -> ModuleType:
        """Import Mitsuba with this variant active.

        Mitsuba's active variant is global to a process: whoever uses Mitsuba calls this first.
        """
        if self.llvm is not None:
            _opened(self.llvm)
            os.environ["DRJIT_LIBLLVM_PATH"] = str(self.llvm)  # Dr.Jit has no other way to be told
        import mitsuba as mi

        if mi.variant() != self.name:
            mi.set_variant(self.name)
        return mi


@functools.cache
def choose_variant(device: Device = "auto", grey: bool = False) -> Variant:
    """The fastest variant that works here; the machine is asked once per process.

    Device "cpu" stands for never CUDA, and "cuda" for nothing else: InputError where CUDA with OptiX does not work.
    `grey` says that pattern, coating and lights are all grey, so that one channel is enough.
    """
    kind = "mono" if grey else "rgb"
    if device != "cpu":
        name = f"cuda_ad_{kind}"
        trouble = cuda_trouble(name)
        if trouble is None:
            return Variant(name, "an NVIDIA GPU with OptiX was found")
        if device == "cuda":
            raise InputError(f"device 'cuda' was asked for, but {trouble}; use device 'auto' or 'cpu'")
    return cpu_variant(llvm_candidates(), llvm_version, kind)


def job_variant(template: Template, device: Device) -> Variant:
    """What renders a job: one channel where every instance of it is grey; InputError where the device is not there."""
    return choose_variant(device, grey=always_grey(template))


def always_grey(template: Template) -> bool:
    """Whether every instance is grey; where a single channel is drawn, grey corners do not tell."""
    drawn = any(re.search(r"\.(color|reflectance)\[\d\]$|\.saturation$", at) for _, _, at in template.distributions())
    return not drawn and all(is_grey(scene.sensor) for scene in template.corners)


def cpu_variant(candidates: Iterable[Path], version_of: Callable[[Path], Version | None], kind: str) -> Variant:
    """LLVM where one of the candidates, best first, is new enough, else scalar.

    `version_of` reads a library's version; None where it is older than 16 or does not load. The kind is "rgb" or
    "mono"; Mitsuba's packages hold no scalar mono variant, so scalar is always rgb.
    """
    rejected = []
    for path in candidates:
        version = version_of(path)
        if version is not None and version[0] >= MINIMUM_LLVM:
            number = ".".join(map(str, version))
            return Variant(f"llvm_ad_{kind}", f"LLVM {number} was found ({path})", llvm=path)
        rejected.append(path.name)
    found = f"only too old or unusable ones were found ({', '.join(rejected)})" if rejected else "none was found"
    return Variant("scalar_rgb", f"no LLVM library of version {MINIMUM_LLVM} or newer: {found}", hint=LLVM_HINT)


def llvm_candidates() -> list[Path]:
    """LLVM libraries here, each once: the one in DRJIT_LIBLLVM_PATH, the package's, others by newest name."""
    found = [path for pattern in _PATTERNS for path in Path("/").glob(pattern.lstrip("/"))]
    found += [
        path for pattern in ("libLLVM*.so*", "libLLVM*.dylib") for path in (Path(sys.prefix) / "lib").glob(pattern)
    ]
    newest_first = sorted({path.resolve() for path in found}, key=_name_version, reverse=True)
    named = os.environ.get("DRJIT_LIBLLVM_PATH")
    return list(dict.fromkeys([*([Path(named)] if named else []), *_packaged(), *newest_first]))


def llvm_version(path: Path) -> Version | None:
    """Version that the library itself reports; None when it does not load or is older than 16 (see the module)."""
    try:
        get_version = _opened(path).LLVMGetVersion
    except (OSError, AttributeError):
        return None
    numbers = [ctypes.c_uint() for _ in range(3)]
    get_version.restype = None
    get_version(*(ctypes.byref(number) for number in numbers))
    major, minor, patch = (number.value for number in numbers)
    return major, minor, patch


def cuda_trouble(name: str) -> str | None:
    """Why the CUDA variant `name` cannot be used; None when it can.

    Asks the driver first, which costs nothing where there is no GPU; then one ray is traced in another process, so that
    a broken OptiX cannot take this one down.
    """
    try:
        cuda = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return "there is no NVIDIA driver"
    count = ctypes.c_int(0)
    if cuda.cuInit(0) != 0 or cuda.cuDeviceGetCount(ctypes.byref(count)) != 0 or count.value < 1:
        return "the NVIDIA driver finds no GPU"
    try:
        ctypes.CDLL("libnvoptix.so.1")
    except OSError:
        return "the NVIDIA driver has no OptiX (libnvoptix.so.1; in a container, add the 'graphics' capability)"
    probe = subprocess.run([sys.executable, "-c", _PROBE, name], capture_output=True, text=True, check=False)
    if probe.returncode != 0:
        last = (probe.stderr.strip().splitlines() or [f"exit status {probe.returncode}"])[-1]
        return f"Mitsuba's {name} does not work: {last}"
    return None


def _packaged() -> list[Path]:
    """The library of the Python package, where that is installed."""
    try:
        listed = files(PACKAGE) or []
    except PackageNotFoundError:
        return []
    found = (Path(str(file.locate())).resolve() for file in listed if file.name.startswith("libLLVM"))
    return [path for path in found if path.is_file()]


def _opened(path: Path) -> ctypes.CDLL:
    """An LLVM library, loaded.

    The package's has its C++ runtime in a folder beside it, without the links by which the loader would find it: Python
    makes them at its next start, where it may write there. Libraries that are loaded already need not be found.
    """
    for name in ("libunwind", "libc++abi", "libc++"):
        for runtime in path.parent.glob(f"*-linux-gnu/{name}.so.1.0"):
            ctypes.CDLL(str(runtime))
    return ctypes.CDLL(str(path))


def _name_version(path: Path) -> tuple[int, ...]:
    """Version numbers in a library's path, for sorting: .../libLLVM.so.19.1 -> (19, 1); without numbers: (0,)."""
    numbers = re.findall(r"\d+", path.name) or re.findall(r"llvm-(\d+)", str(path))
    return tuple(map(int, numbers)) or (0,)
