"""Scene files: distributions, overrides, corners, and the hash that says which scene it is."""

import pickle
from pathlib import Path

import pytest
from tiny_scene import CONTACT, TEXT

from synth.errors import InputError
from synth.scene.sampling import draw
from synth.scene.template import SCENES, checked_template, load_scene, replaced, shipped_scenes


def test_shipped_scenes_are_known_by_name() -> None:
    flat = "deltact digit fingervision gelsight gelsight_fingertip gelsight_mini gelslim gelstereo omnitact soft_bubble"
    assert shipped_scenes() == sorted([*flat.split(), "densetact", "dmtac", "objects", "tac3d", "tac3d_single"])
    assert load_scene("gelsight_mini").source == SCENES / "gelsight_mini.toml"


def test_a_folder_of_a_scenes_name_does_not_hide_the_scene(tmp_path, monkeypatch) -> None:
    (tmp_path / "gelsight_mini").mkdir()
    monkeypatch.chdir(tmp_path)
    assert load_scene("gelsight_mini").name == "gelsight_mini"


def test_overrides_set_tables_lists_and_words_and_the_last_wins(tiny: Path) -> None:
    template = load_scene(
        tiny,
        [
            "motion.depth_mm=0.25",
            "sensor.lights.1.power=7",
            "name=another",
            "outputs.depth=true",
            'contact.indenter={ shape = "torus", radius_mm = 1.0, tube_mm = 0.3 }',
            "sensor.camera.position_mm=[0, 0, 21.5]",
            "motion.steps=3",
            "motion.steps=4",
        ],
    )
    scene = template.corners[0]
    assert (scene.motion.depth_mm, scene.sensor.lights[1].power, scene.name) == (0.25, 7, "another")
    assert scene.outputs.depth
    assert scene.contact.indenter.shape == "torus"
    assert scene.sensor.camera.position_mm == (0, 0, 21.5)
    assert scene.motion.steps == 4


def test_corners_are_the_ends_of_the_distributions(tiny: Path) -> None:
    corners = load_scene(tiny).corners
    assert [corner.motion.depth_mm for corner in corners] == [0.1, 0.3]
    assert [corner.sensor.gel.youngs_modulus_kpa for corner in corners] == [100, 300]
    assert {corner.sensor.camera.cx for corner in corners} == {16.0}  # a normal is at its mean


def test_corners_see_every_option_of_nested_choices(tiny: Path) -> None:
    """A choice of two in a choice of three, beside another choice of two: each option turns up."""
    sphere = '{ shape = "sphere", radius_mm = { choice = [0.5, { uniform = [1.0, 2.0] }, 3.0] } }'
    cone = '{ shape = "cone", half_angle_deg = { choice = [30, 60] } }'
    template = load_scene(tiny, [f"contact.indenter={{ choice = [{cone}, {sphere}] }}", "motion.steps={choice=[1, 2]}"])
    indenters = {corner.contact.indenter for corner in template.corners}
    assert {body.half_angle_deg for body in indenters if body.shape == "cone"} == {30, 60}
    assert {body.radius_mm for body in indenters if body.shape == "sphere"} == {0.5, 1.0, 2.0, 3.0}
    assert {corner.motion.steps for corner in template.corners} == {1, 2}
    assert len(indenters) == 6


def test_a_wrong_option_of_a_nested_choice_is_found_when_the_file_is_loaded(tiny: Path) -> None:
    torus = '{ shape = "torus", radius_mm = 1, tube_mm = 0.2 }'
    sphere = '{ shape = "sphere", radius_mm = { choice = [1.0, -2.0] } }'
    with pytest.raises(InputError, match=r"contact.indenter.radius_mm = -2.0: must be greater than or equal to 0.05"):
        load_scene(tiny, [f"contact.indenter={{ choice = [{sphere}, {torus}] }}"])


def test_replaced_asks_for_each_distribution_and_leaves_the_rest() -> None:
    content = {"b": [1, {"uniform": [2, 3]}], "a": {"choice": [{"x": {"normal": [0, 1]}}, 5]}, "c": "word"}
    asked = []

    def choose(kind: str, arguments: list) -> object:
        asked.append(kind)
        return arguments[0]

    assert replaced(content, choose) == {"a": {"x": 0}, "b": [1, 2], "c": "word"}
    assert asked == ["choice", "normal", "uniform"]  # by the keys' names, not by their order


def test_hash_and_draws_are_of_the_content_not_of_its_layout(tmp_path: Path, tiny: Path) -> None:
    template = load_scene(tiny)
    assert len(template.hash) == 16
    name, words = 'name = "tiny"\n', 'description = "words"\nreferences = ["a book"]\n'
    sensor = TEXT.removesuffix(CONTACT).replace(name, "")
    (tmp_path / "other.toml").write_text(words + name + CONTACT + sensor)
    other = load_scene(tmp_path / "other.toml")
    assert other.hash == template.hash
    one, same = draw(template, 3, 5), draw(other, 3, 5)
    assert (one.sensor, one.contact, one.motion) == (same.sensor, same.contact, same.motion)
    assert load_scene(tiny, ["motion.steps=3"]).hash != template.hash
    assert load_scene(tiny, ["name=other"]).hash != template.hash
    assert pickle.loads(pickle.dumps(template)).hash == template.hash


def test_hash_covers_the_files_of_mesh_indenters(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A dataset must not go on with another object under the same file name."""
    monkeypatch.chdir(tiny.parent)
    override = 'contact.indenter={ shape = "mesh", file = { choice = ["a.stl", "b.stl"] } }'
    (tiny.parent / "a.stl").write_text("first")
    with pytest.raises(InputError, match=r"there is no file .*b\.stl"):
        load_scene(tiny, [override])
    (tiny.parent / "b.stl").write_text("second")
    before = load_scene(tiny, [override]).hash
    (tiny.parent / "b.stl").write_text("changed")
    assert load_scene(tiny, [override]).hash != before


def test_a_template_needs_no_file(tmp_path: Path) -> None:
    content = dict(load_scene("deltact").content)
    assert checked_template(content, tmp_path / "none.toml").hash == load_scene("deltact").hash


def test_content_is_plain_json(tmp_path: Path) -> None:
    """TOML knows dates; what is kept in dataset.json does not."""
    (tmp_path / "s.toml").write_text("description = 2026-11-21\n" + TEXT)
    assert load_scene(tmp_path / "s.toml").content["description"] == "2026-11-21"
