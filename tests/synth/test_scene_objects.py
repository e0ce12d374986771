"""A folder of objects: patterns of files, orientations of all kinds, and the scene `objects`, which has both."""

from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from tiny_scene import write_tiny

from synth.dataset.reader import read_dataset
from synth.errors import InputError
from synth.pipeline.generate import generate
from synth.planning import job_variant, plan, predict
from synth.scene import MeshIndenter
from synth.scene.sampling import draw, draw_sensor
from synth.scene.template import SCENES, Template, load_scene, with_files
from synth.simulate.indenter import turned_by

ANY = 'contact.indenter={ shape = "mesh", file = "objects/*.stl", rotation_deg = "any" }'


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A scene beside a folder of two objects, which is the working directory."""
    (tmp_path / "objects").mkdir()
    for name in ("b.stl", "a.stl", "notes.txt"):
        (tmp_path / "objects" / name).write_text(name)
    monkeypatch.chdir(tmp_path)
    return write_tiny(tmp_path)


def drawn_indenters(template: Template, count: int) -> list[MeshIndenter]:
    sensor = draw_sensor(template, 0, 0)
    drawn = [draw(template, 0, trajectory, sensor=sensor).contact.indenter for trajectory in range(count)]
    return [indenter for indenter in drawn if isinstance(indenter, MeshIndenter)]


def test_a_pattern_is_a_choice_of_the_files_that_match(tiny: Path) -> None:
    folder = tiny.parent / "objects"
    choice = {"choice": [str(folder / "a.stl"), str(folder / "b.stl")]}
    assert load_scene(tiny, [ANY]).content["contact"]["indenter"]["file"] == choice
    sphere = '{ shape = "sphere", radius_mm = 1 }'
    nested = load_scene(tiny, [f"contact.indenter={{ choice = [{ANY.partition('=')[2]}, {sphere}] }}"])
    assert nested.content["contact"]["indenter"]["choice"][0]["file"] == choice
    files = {indenter.file for indenter in drawn_indenters(nested, 40)}
    assert files == set(choice["choice"])


def test_a_pattern_in_a_scenes_file_is_relative_to_it_and_stays_so(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    head, _, _ = tiny.read_text().partition("[contact.indenter]")
    tiny.write_text(f'{head}[contact.indenter]\nshape = "mesh"\nfile = "objects/*.stl"\n[motion]\ndepth_mm = 0.1\n')
    monkeypatch.chdir("/")
    assert load_scene(tiny).content["contact"]["indenter"]["file"] == {"choice": ["objects/a.stl", "objects/b.stl"]}


def test_a_file_whose_name_looks_like_a_pattern_is_that_file(tiny: Path) -> None:
    file = tiny.parent / "objects" / "a[1].stl"
    file.touch()
    override = 'contact.indenter={ shape = "mesh", file = "objects/a[1].stl" }'
    assert load_scene(tiny, [override]).content["contact"]["indenter"]["file"] == str(file)


def test_a_pattern_that_nothing_matches_is_refused(tiny: Path) -> None:
    with pytest.raises(InputError, match=rf"contact\.indenter\.file: there is no file {tiny.parent}/objects/\*\.obj"):
        load_scene(tiny, [ANY.replace("stl", "obj")])


def test_another_object_in_the_folder_makes_another_scene(tiny: Path) -> None:
    before = load_scene(tiny, [ANY]).hash
    assert load_scene(tiny, [ANY]).hash == before
    (tiny.parent / "objects" / "c.stl").touch()
    assert load_scene(tiny, [ANY]).hash != before


def test_files_are_renamed_wherever_they_stand() -> None:
    content = {"file": {"choice": ["a", {"choice": ["b"]}]}, "more": [{"file": "c", "name": "file"}]}
    renamed = {"file": {"choice": ["A", {"choice": ["B"]}]}, "more": [{"file": "C", "name": "file"}]}
    assert with_files(content, str.upper) == renamed


def test_all_orientations_are_alike_likely(tiny: Path) -> None:
    """Every entry of a uniformly distributed rotation matrix is a coordinate of a uniform point on the unit sphere.

    Such a coordinate is uniform on [-1, 1] (Archimedes). Angles about y drawn uniformly would give arcsine
    distributions, 0.11 away, and fail.
    """
    indenters = drawn_indenters(load_scene(tiny, [ANY]), 1000)
    rotations = np.array([turned_by(indenter.rotation_deg) for indenter in indenters])
    for entries in rotations.reshape(-1, 9).T:
        assert stats.kstest(entries, stats.uniform(-1, 2).cdf).pvalue > 1e-4


def test_scene_has_the_sensor_of_gelsight_mini() -> None:
    scene, mini = load_scene("objects").content, load_scene("gelsight_mini").content
    for part in ("references", "sensor", "render", "numerics", "outputs", "sampling"):
        assert scene[part] == mini[part], part


def test_scene_draws_every_object_upright_and_in_any_orientation() -> None:
    """400 draws leave out one of 26 files with a probability of at most 26 (25 / 26)^400 = 4e-6."""
    indenters = drawn_indenters(load_scene("objects"), 400)
    files = {SCENES / indenter.file for indenter in indenters}
    assert files == set((SCENES / "objects").glob("*.stl"))
    assert all(isinstance(angle, float) for indenter in indenters for angle in indenter.rotation_deg)
    upright = np.mean([indenter.rotation_deg[:2] == (0.0, 0.0) for indenter in indenters])
    assert upright == pytest.approx(0.5, abs=5 * 0.5 / np.sqrt(400))  # five standard deviations
    assert indenters == drawn_indenters(load_scene("objects"), 400)


def test_plan_and_samples_tell_how_edges_are_rounded(tiny: Path, tmp_path: Path) -> None:
    washer = f'{{ shape = "mesh", file = "{SCENES / "objects" / "washer.stl"}", size_mm = 4.0, fillet_mm = 0.9 }}'
    bodies = washer, '{ shape = "sphere", radius_mm = 2.0 }'
    scenes = [load_scene(tiny, [f"contact.indenter={b}", "numerics={ target_error_px = 3.0 }"]) for b in bodies]
    mesh, ball = (predict(plan(template, job_variant(template, "cpu"))) for template in scenes)
    assert "edges of objects rounded to 0.9 to 0.9 mm" in mesh.resolution
    # A mesh takes several times a ball's iterations.
    assert mesh.seconds_per_pair["simulate"] > 3 * ball.seconds_per_pair["simulate"]
    generate(scenes[0], 1, tmp_path / "data")
    assert read_dataset(tmp_path / "data").entry(0).diagnostics["edge_radius_mm"] == 0.9
