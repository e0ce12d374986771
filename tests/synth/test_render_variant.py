"""The choice of a Mitsuba variant: faked libraries, and a real process that has none but an old one."""

import ctypes.util
import subprocess
import sys
from pathlib import Path

import pytest

from synth.errors import InputError
from synth.render.variant import LLVM_HINT, choose_variant, cpu_variant, cuda_trouble, llvm_candidates, llvm_version

OLD, LEAST, NEW = Path("/lib/libLLVM-15.so.1"), Path("/lib/libLLVM.so.16"), Path("/lib/libLLVM.so.19.1")
VERSIONS = {OLD: (15, 0, 6), LEAST: (16, 0, 0), NEW: (19, 1, 7)}


@pytest.mark.parametrize(
    ("found", "llvm"),
    [([], None), ([OLD], None), ([LEAST], LEAST), ([OLD, NEW], NEW), ([Path("/lib/broken.so"), NEW], NEW)],
)
def test_only_llvm_16_or_newer_is_taken(found: list[Path], llvm: Path | None) -> None:
    variant = cpu_variant(found, VERSIONS.get, "rgb")
    assert (variant.name, variant.llvm) == ("scalar_rgb" if llvm is None else "llvm_ad_rgb", llvm)
    assert variant.hint == (LLVM_HINT if llvm is None else None)


def test_grey_scenes_render_one_channel_where_mitsuba_can() -> None:
    mono, scalar = (cpu_variant(found, VERSIONS.get, "mono") for found in ([NEW], []))
    assert (mono.name, mono.is_mono, mono.is_vectorised) == ("llvm_ad_mono", True, True)
    assert (scalar.name, scalar.is_mono, scalar.is_vectorised) == ("scalar_rgb", False, False)


def test_library_without_the_version_function_counts_as_too_old(tmp_path: Path) -> None:
    libc = ctypes.util.find_library("c")
    assert libc is not None
    assert llvm_version(Path(libc)) is None
    text = tmp_path / "libLLVM.so.19"
    text.write_text("not a library")
    assert llvm_version(text) is None
    versions = filter(None, map(llvm_version, llvm_candidates()))
    assert all(16 <= version[0] < 100 for version in versions)


def test_cuda_is_refused_with_a_reason_where_there_is_none() -> None:
    trouble = cuda_trouble("cuda_ad_rgb")
    if trouble is None:
        pytest.skip("this machine has CUDA with OptiX")
    with pytest.raises(InputError, match="cuda"):
        choose_variant("cuda")


OLD_ONLY = """
import sys
import synth.render.variant as variant
variant._PATTERNS = (sys.argv[1],)
variant.sys.prefix = "/nonexistent"
chosen = variant.choose_variant("cpu")
assert chosen.name == "scalar_rgb", chosen
assert "too old" in chosen.reason and chosen.hint, chosen
mi = chosen.load()
scene = mi.load_dict({"type": "scene", "shape": {"type": "rectangle"}})
assert scene.ray_test(mi.Ray3f([0, 0, 1], [0, 0, -1]))
print("rendered")
"""


@pytest.mark.parametrize("real", [False, True])
def test_process_with_nothing_but_an_old_library_renders(tmp_path: Path, real: bool) -> None:
    old = (path for path in llvm_candidates() if llvm_version(path) is None)
    # Or a library that loads and has no LLVMGetVersion.
    target = next(old if real else Path("/").glob("lib*/**/libc.so.6"), None)
    if target is None:
        pytest.skip("this machine has no LLVM before 16" if real else "no C library to stand in for an old LLVM")
    (tmp_path / "libLLVM-15.so.1").symlink_to(target)
    root, command = Path(__file__).parents[2], [sys.executable, "-c", OLD_ONLY, str(tmp_path / "libLLVM*.so*")]
    environment = {"PATH": "/usr/bin", "PYTHONPATH": str(root), "HOME": str(tmp_path)}
    done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "rendered" in done.stdout
