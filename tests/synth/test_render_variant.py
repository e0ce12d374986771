"""The choice of a Mitsuba variant: faked libraries, and a real process that has none but an old one."""

import ctypes.util
import subprocess
import sys
from pathlib import Path

import pytest

from synth.errors import InputError
from synth.render.variant import (
    LLVM_HINT,
    Variant,
    choose_variant,
    cpu_variant,
    cuda_trouble,
    llvm_candidates,
    llvm_version,
)

OLD, NEW = Path("/lib/libLLVM-15.so.1"), Path("/lib/libLLVM.so.19.1")
VERSIONS = {OLD: (15, 0, 6), NEW: (19, 1, 7), Path("/lib/libLLVM.so.16"): (16, 0, 0)}


@pytest.mark.parametrize(
    ("found", "name", "llvm"),
    [
        ([], "scalar_rgb", None),
        ([OLD], "scalar_rgb", None),
        ([Path("/lib/libLLVM.so.16")], "llvm_ad_rgb", Path("/lib/libLLVM.so.16")),
        ([OLD, NEW], "llvm_ad_rgb", NEW),
        ([Path("/lib/broken.so"), NEW], "llvm_ad_rgb", NEW),
    ],
)
def test_only_llvm_16_or_newer_is_taken(found: list[Path], name: str, llvm: Path | None) -> None:
    variant = cpu_variant(found, VERSIONS.get, "rgb")
    assert (variant.name, variant.llvm) == (name, llvm)
    assert variant.hint == (LLVM_HINT if llvm is None else None)


def test_grey_scenes_render_one_channel_where_mitsuba_can() -> None:
    assert cpu_variant([NEW], VERSIONS.get, "mono").is_mono
    assert cpu_variant([], VERSIONS.get, "mono").name == "scalar_rgb"


def test_library_without_the_version_function_counts_as_too_old(tmp_path: Path) -> None:
    libc = ctypes.util.find_library("c")
    assert libc is not None
    assert llvm_version(Path(libc)) is None
    text = tmp_path / "libLLVM.so.19"
    text.write_text("not a library")
    assert llvm_version(text) is None


def test_versions_found_here_are_plausible() -> None:
    for path in llvm_candidates()[:1]:
        version = llvm_version(path)
        assert version is None or 16 <= version[0] < 100


def test_cuda_is_refused_with_a_reason_where_there_is_none() -> None:
    trouble = cuda_trouble("cuda_ad_rgb")
    if trouble is None:
        pytest.skip("this machine has CUDA with OptiX")
    with pytest.raises(InputError, match="cuda"):
        choose_variant("cuda")


def test_vectorised_variants_are_known_by_name() -> None:
    assert Variant("llvm_ad_mono", "").is_vectorised
    assert not Variant("scalar_rgb", "").is_vectorised


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


def _old_libraries() -> list[Path]:
    """Real LLVM libraries before 16 on this machine."""
    return [path for path in llvm_candidates() if llvm_version(path) is None]


@pytest.mark.parametrize("real", [False, True])
def test_process_with_nothing_but_an_old_library_renders(tmp_path: Path, real: bool) -> None:
    if real:
        old = _old_libraries()
        if not old:
            pytest.skip("this machine has no LLVM before 16")
        target = old[0]
    else:
        target = next(Path("/").glob("lib*/**/libc.so.6"), None)  # a library that loads and has no LLVMGetVersion
        if target is None:
            pytest.skip("no C library found to stand in for an old LLVM")
    (tmp_path / "libLLVM-15.so.1").symlink_to(target)
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-c", OLD_ONLY, str(tmp_path / "libLLVM*.so*")],
        cwd=root,
        env={"PATH": "/usr/bin", "PYTHONPATH": str(root), "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "rendered" in done.stdout
