"""The choice of a Mitsuba variant: faked libraries, and a real process that has none but an old one."""

import ctypes.util
import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from commands import refused

from synth.render import variant
from synth.render.variant import LLVM_HINT, PACKAGE, cpu_variant, llvm_candidates, llvm_version

OLD, LEAST, NEW = Path("/lib/libLLVM-15.so.1"), Path("/lib/libLLVM.so.16"), Path("/lib/libLLVM.so.19.1")
VERSIONS = {OLD: (15, 0, 6), LEAST: (16, 0, 0), NEW: (19, 1, 7)}
RENDER = """
import sys
from pathlib import Path
from synth.render.variant import Variant, llvm_version

library = Path(sys.argv[1])
if sys.argv[2] == "choose":
    assert llvm_version(library)[0] >= 16
mi = Variant("llvm_ad_rgb", "", llvm=library).load()
scene = mi.load_dict({"type": "scene", "shape": {"type": "rectangle"}})
assert scene.ray_test(mi.Ray3f([0, 0, 1], [0, 0, -1]))[0]
print("rendered")
"""
OLD_ONLY = """
import os, sys
os.environ["DRJIT_LIBLLVM_PATH"] = "/nonexistent/libLLVM.so.19"
import synth.render.variant as variant
variant._PATTERNS, variant.PACKAGE = (sys.argv[1],), "not-installed"
variant.sys.prefix = "/nonexistent"
chosen = variant.choose_variant("cpu")
assert chosen.name == "scalar_rgb", chosen
assert "too old" in chosen.reason and chosen.hint, chosen
mi = chosen.load()
scene = mi.load_dict({"type": "scene", "shape": {"type": "rectangle"}})
assert scene.ray_test(mi.Ray3f([0, 0, 1], [0, 0, -1]))
print("rendered")
from synth.cli import main
sys.exit(main(["doctor", "--json"]))
"""


@pytest.mark.parametrize(
    ("found", "llvm"),
    [([], None), ([OLD], None), ([LEAST], LEAST), ([OLD, NEW], NEW), ([Path("/lib/broken.so"), NEW], NEW)],
)
def test_only_llvm_16_or_newer_is_taken(found: list[Path], llvm: Path | None) -> None:
    chosen = cpu_variant(found, VERSIONS.get, "rgb")
    assert (chosen.name, chosen.llvm) == ("scalar_rgb" if llvm is None else "llvm_ad_rgb", llvm)
    assert chosen.hint == (LLVM_HINT if llvm is None else None)


def test_grey_scenes_render_one_channel_and_libraries_without_a_version_are_too_old(tmp_path: Path) -> None:
    mono, scalar = (cpu_variant(found, VERSIONS.get, "mono") for found in ([NEW], []))
    assert (mono.name, mono.is_mono, mono.is_vectorised) == ("llvm_ad_mono", True, True)
    assert (scalar.name, scalar.is_mono, scalar.is_vectorised) == ("scalar_rgb", False, False)
    libc = ctypes.util.find_library("c")
    assert llvm_version(Path(libc)) is None
    text = tmp_path / "libLLVM.so.19"
    text.write_text("not a library")
    assert llvm_version(text) is None
    versions = filter(None, map(llvm_version, llvm_candidates()))
    assert all(16 <= version[0] < 100 for version in versions)


def test_the_users_library_comes_before_the_packages_and_that_before_the_systems(tmp_path: Path, monkeypatch) -> None:
    installed = tmp_path / "site" / f"{PACKAGE.replace('-', '_')}-19.1.7.dist-info"
    installed.mkdir(parents=True)
    (installed / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {PACKAGE}\nVersion: 19.1.7\n")
    (installed / "RECORD").write_text("../lib/libLLVM.so.19.1,,\n../lib/libLTO.so.19.1,,\n../lib/libLLVM-gone.so,,\n")
    paths = [tmp_path / folder / f"libLLVM.so.{number}" for folder, number in (("lib", "19.1"), ("system", "24.1"))]
    for path in (*paths, paths[0].with_name("libLTO.so.19.1")):
        path.parent.mkdir(exist_ok=True)
        path.touch()
    monkeypatch.syspath_prepend(tmp_path / "site")
    monkeypatch.setattr(variant, "_PATTERNS", (f"{tmp_path}/system/libLLVM*.so*",))
    monkeypatch.setattr("sys.prefix", str(tmp_path / "empty"))
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    assert llvm_candidates() == paths
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(OLD))
    assert llvm_candidates() == [OLD, *paths]


@pytest.mark.parametrize("process", ["choose", "worker"])
def test_the_packages_library_renders_before_its_links_are_made(tmp_path: Path, process: str) -> None:
    packaged = variant._packaged()
    if not packaged:
        pytest.skip(f"{PACKAGE} is not installed")
    folder = tmp_path / "lib"
    for path in (packaged[0], *packaged[0].parent.glob("*-linux-gnu/*.so.1.0")):
        copy = folder / path.relative_to(packaged[0].parent)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, copy)
    done = _python(RENDER, tmp_path, str(folder / packaged[0].name), process)
    assert done.returncode == 0, done.stderr
    assert "rendered" in done.stdout


def test_cuda_is_refused_with_a_reason_where_there_is_none() -> None:
    if variant.cuda_trouble("cuda_ad_rgb") is None:
        pytest.skip("this machine has CUDA with OptiX")
    refused("cuda", variant.choose_variant, "cuda")


def _python(code: str, home: Path, *arguments: str) -> "subprocess.CompletedProcess[str]":
    environment = {"PATH": "/usr/bin:/bin", "PYTHONPATH": str(Path(__file__).parents[2]), "HOME": str(home)}
    command = [sys.executable, "-c", code, *arguments]
    return subprocess.run(command, cwd=home, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("real", [False, True])
def test_process_with_nothing_but_an_old_library_renders(tmp_path: Path, real: bool) -> None:
    old = (path for path in llvm_candidates() if llvm_version(path) is None)
    # Or a library that loads and has no LLVMGetVersion.
    target = next(old if real else Path("/").glob("lib*/**/libc.so.6"), None)
    if target is None:
        pytest.skip("this machine has no LLVM before 16" if real else "no C library to stand in for an old LLVM")
    (tmp_path / "libLLVM-15.so.1").symlink_to(target)
    done = _python(OLD_ONLY, tmp_path, str(tmp_path / "libLLVM*.so*"))
    assert done.returncode == 0, done.stderr
    rendered, _, findings = done.stdout.partition("\n")
    assert rendered == "rendered"
    # The doctor says so and never aborts, though DRJIT_LIBLLVM_PATH names a file that is not there.
    (rendering,) = [found for found in json.loads(findings) if found["what"] == "rendering on the CPU"]
    assert rendering["state"] == "slow"
    for words in ("scalar_rgb", "only too old or unusable ones were found", "apt install libllvm19"):
        assert words in rendering["detail"]
