"""Meshes kept by content: made once, read bitwise, made again where the file is damaged."""

from pathlib import Path

import numpy as np
import pytest
from pads import crooked

import synth.mesh.cache as cache
from synth.errors import InputError
from synth.mesh import PadMesh, default_edge_length, mesh_key, pad_mesh
from synth.scene import Gel, Layer, Numerics

GEL = Gel(size_mm=(4.0, 4.0, 3.0), youngs_modulus_kpa=200.0)
NUMERICS = Numerics(edge_length_mm=1.5)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """A fast mesher that, like the real one, never makes the same mesh twice; its calls are counted."""
    calls: list[float] = []

    def counted(size: tuple[float, float, float], edge: float) -> PadMesh:
        calls.append(edge)
        return crooked(size, seed=len(calls))

    monkeypatch.setattr(cache, "tetrahedralise_box", counted)
    return calls


def test_made_once_and_read_bitwise(tmp_path: Path, made: list[float]) -> None:
    first = pad_mesh(GEL, NUMERICS, [tmp_path])
    again = pad_mesh(GEL, NUMERICS, [tmp_path])
    assert made == [1.5]
    assert (again.points == first.points).all()
    assert (again.tets == first.tets).all()
    assert again.tets.dtype == np.int32
    assert again.hash == first.hash
    assert [path.name for path in tmp_path.iterdir()] == [f"{mesh_key(GEL, NUMERICS)}.npz"]  # nothing left aside


@pytest.mark.parametrize("damage", ["empty", "cut", "flipped", "text", "no tets"])
def test_damaged_file_is_made_again(tmp_path: Path, made: list[float], damage: str) -> None:
    pad_mesh(GEL, NUMERICS, [tmp_path])
    path = tmp_path / f"{mesh_key(GEL, NUMERICS)}.npz"
    content = path.read_bytes()
    if damage == "no tets":
        np.savez(path, points=np.zeros((4, 3)))
    else:
        middle = len(content) // 2
        path.write_bytes(
            {
                "empty": b"",
                "cut": content[:middle],
                "flipped": content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :],
                "text": b"not a mesh",
            }[damage]
        )
    mesh = pad_mesh(GEL, NUMERICS, [tmp_path])
    assert len(made) == 2
    assert pad_mesh(GEL, NUMERICS, [tmp_path]).hash == mesh.hash
    assert len(made) == 2


def test_every_folder_gets_the_mesh_of_the_first_that_has_it(tmp_path: Path, made: list[float]) -> None:
    dataset, user, other = tmp_path / "dataset", tmp_path / "user", tmp_path / "other"
    kept = pad_mesh(GEL, NUMERICS, [dataset])
    pad_mesh(GEL, NUMERICS, [user])
    assert len(made) == 2
    assert pad_mesh(GEL, NUMERICS, [dataset, user, other]).hash == kept.hash
    assert pad_mesh(GEL, NUMERICS, [other]).hash == kept.hash
    assert len(made) == 2


def test_user_cache_follows_xdg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, made: list[float]) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache.user_cache() == tmp_path / "gelflow-synth" / "meshes"
    mesh = pad_mesh(GEL, NUMERICS)
    assert (cache.user_cache() / f"{mesh_key(GEL, NUMERICS)}.npz").is_file()
    assert pad_mesh(GEL, NUMERICS).hash == mesh.hash
    assert len(made) == 1


def test_key_depends_on_what_the_mesh_depends_on_only() -> None:
    key = mesh_key(GEL, NUMERICS)
    assert mesh_key(GEL.model_copy(update={"size_mm": (4.0, 4.0, 3.1)}), NUMERICS) != key
    assert mesh_key(GEL, Numerics(edge_length_mm=1.4)) != key
    assert mesh_key(GEL.model_copy(update={"youngs_modulus_kpa": 7.0, "poisson_ratio": 0.3}), NUMERICS) == key
    assert mesh_key(GEL, Numerics(edge_length_mm=1.5, tolerance=1e-4)) == key
    assert mesh_key(GEL, Numerics()) == mesh_key(GEL, Numerics(edge_length_mm=default_edge_length(GEL)))


def test_layered_pad_is_refused(tmp_path: Path, made: list[float]) -> None:
    """Every tetrahedron would count as the first layer."""
    layered = GEL.model_copy(update={"layers": (Layer(thickness_mm=0.1, youngs_modulus_kpa=900.0),)})
    with pytest.raises(InputError, match="cannot follow layers"):
        pad_mesh(layered, NUMERICS, [tmp_path])
    assert made == []


@pytest.mark.parametrize(("thickness", "edge"), [(2.0, 0.4), (4.0, 0.8), (8.0, 1.0)])
def test_default_edge_length(thickness: float, edge: float) -> None:
    gel = GEL.model_copy(update={"size_mm": (20.0, 20.0, thickness)})
    assert default_edge_length(gel) == pytest.approx(edge)
