"""Scene files: distributions, overrides, corners and the hash; wrong ones get one clear message each."""

import pickle
import re
from pathlib import Path

import pytest
from commands import refused
from tiny_scene import CONTACT, TEXT, write_tiny

from synth.sampling import draw
from synth.scene.template import SCENES, checked_template, load_scene, shipped_scenes


def test_shipped_scenes_are_known_by_name_and_a_template_needs_no_file(tmp_path, monkeypatch) -> None:
    flat = "deltact digit digit_calibrated fingervision gelsight gelsight_fingertip gelsight_mini gelslim gelstereo"
    other = "allsight densetact dmtac objects omnitact soft_bubble tac3d tac3d_single"
    assert shipped_scenes() == sorted([*flat.split(), *other.split()])
    assert load_scene("gelsight_mini").source == SCENES / "gelsight_mini.toml"
    (tmp_path / "gelsight_mini").mkdir()
    monkeypatch.chdir(tmp_path)
    assert load_scene("gelsight_mini").name == "gelsight_mini"
    content = dict(load_scene("deltact").content)
    assert checked_template(content, tmp_path / "none.toml").hash == load_scene("deltact").hash


@pytest.mark.parametrize("name", ["gelsight_mini", "objects"])
def test_workers_are_handed_less_than_a_pipe_holds(name: str) -> None:
    template = load_scene(name)
    known, corners = template.hash, template.corners
    handed = pickle.dumps(template)
    assert len(handed) < 32 * 1024
    assert pickle.loads(handed).corners == corners
    assert vars(pickle.loads(handed))["hash"] == known, "files may change while a job runs"


def test_overrides_set_tables_lists_and_words_and_the_last_wins(tiny: Path) -> None:
    torus = 'contact.indenter={ shape = "torus", radius_mm = 1.0, tube_mm = 0.3 }'
    words = ["motion.depth_mm=0.25", "sensor.lights.1.power=7", "name=another", "outputs.depth=true", torus]
    numbers = ["sensor.camera.position_mm=[0, 0, 21.5]", "motion.steps=3", "motion.steps=4"]
    scene = load_scene(tiny, words + numbers).corners[0]
    assert (scene.motion.depth_mm, scene.sensor.lights[1].power, scene.name) == (0.25, 7, "another")
    assert scene.outputs.depth
    assert scene.contact.indenter.shape == "torus"
    assert scene.sensor.camera.position_mm == (0, 0, 21.5)
    assert scene.motion.steps == 4


def test_a_scene_extends_another_whose_files_stay_where_they_are(tmp_path: Path) -> None:
    mine = tmp_path / "mein Gerät 2.1.toml"
    mine.write_text('extends = "objects"\n[sensor.pattern]\nkind = "speckle"\ngrain_mm = 0.3\n[motion]\nsteps = 2\n')
    found, base = load_scene(mine), load_scene("objects")
    assert (found.name, found.content["references"]) == ("mein_Ger_t_2_1", [])
    assert found.content["sensor"].pop("pattern") == {"kind": "speckle", "grain_mm": 0.3}
    assert found.content["motion"] == {**base.content["motion"], "steps": 2}
    assert found.content["sensor"].items() <= base.content["sensor"].items()
    mine.write_text('extends = "gelsight_mini"\n[sensor.pattern]\nshape = "diamond"\n')
    assert load_scene(mine).content["sensor"]["pattern"]["shape"] == "diamond"
    mine.write_text(f'extends = "{mine.name}"')
    refused("cannot extend itself", load_scene, mine)


def test_corners_are_the_ends_of_distributions_and_every_option_of_nested_choices(tiny: Path) -> None:
    corners = load_scene(tiny).corners
    assert [corner.motion.depth_mm for corner in corners] == [0.1, 0.3]
    assert [corner.sensor.gel.youngs_modulus_kpa for corner in corners] == [100, 300]
    assert {corner.sensor.camera.cx for corner in corners} == {16.0}  # a normal is at its mean
    sphere = '{ shape = "sphere", radius_mm = { choice = [0.5, { uniform = [1.0, 2.0] }, 3.0] } }'
    cone = '{ shape = "cone", half_angle_deg = { choice = [30, 60] } }'
    template = load_scene(tiny, [f"contact.indenter={{ choice = [{cone}, {sphere}] }}", "motion.steps={choice=[1, 2]}"])
    indenters = {corner.contact.indenter for corner in template.corners}
    assert {body.half_angle_deg for body in indenters if body.shape == "cone"} == {30, 60}
    assert {body.radius_mm for body in indenters if body.shape == "sphere"} == {0.5, 1.0, 2.0, 3.0}
    assert {corner.motion.steps for corner in template.corners} == {1, 2}
    assert len(indenters) == 6


def test_wrong_options_are_found_at_loading_and_the_hash_covers_files_of_mesh_indenters(tiny, monkeypatch) -> None:
    torus = '{ shape = "torus", radius_mm = 1, tube_mm = 0.2 }'
    sphere = '{ shape = "sphere", radius_mm = { choice = [1.0, -2.0] } }'
    found = _refusal(tiny, f"contact.indenter={{ choice = [{sphere}, {torus}] }}")
    assert "contact.indenter.radius_mm = -2.0: must be greater than or equal to 0.05" in found
    monkeypatch.chdir(tiny.parent)
    override = 'contact.indenter={ shape = "mesh", file = { choice = ["a.stl", "b.stl"] } }'
    (tiny.parent / "a.stl").write_text("first")
    assert re.search(r"there is no file .*b\.stl", _refusal(tiny, override))
    (tiny.parent / "b.stl").write_text("second")
    before = load_scene(tiny, [override]).hash
    (tiny.parent / "b.stl").write_text("changed")
    assert load_scene(tiny, [override]).hash != before


def test_hash_and_draws_are_of_the_content_which_is_plain_json(tmp_path: Path, tiny: Path) -> None:
    template = load_scene(tiny)
    assert len(template.hash) == 16
    head, sensor = TEXT.removesuffix(CONTACT).split("[sensor]")
    words = 'description = "words"\nreferences = ["a book"]\n'
    (tmp_path / "other.toml").write_text(f"{words}{head}{CONTACT}[sensor]{sensor}")
    other = load_scene(tmp_path / "other.toml")
    assert other.hash == template.hash
    one, same = draw(template, 3, 5), draw(other, 3, 5)
    assert (one.sensor, one.contact, one.motion) == (same.sensor, same.contact, same.motion)
    assert load_scene(tiny, ["motion.steps=3"]).hash != template.hash
    assert load_scene(tiny, ["name=other"]).hash != template.hash
    assert pickle.loads(pickle.dumps(template)).hash == template.hash
    # TOML knows dates; what is kept in dataset.json does not.
    (tmp_path / "s.toml").write_text("description = 2026-11-21\n" + TEXT)
    assert load_scene(tmp_path / "s.toml").content["description"] == "2026-11-21"


def _refusal(source: Path | str, *overrides: str) -> str:
    return refused(".", load_scene, source, overrides)


WRONG_KEYS_AND_TYPES = [
    ("motion.dept_mm=1", ": unknown key; did you mean 'depth_mm'?"),
    ("sensor.camera.focal=3", ": unknown key; allowed here are width, height, fx, fy, cx, cy"),
    ("sensor.lights.1.colour=[1, 1, 1]", "sensor.lights[1].colour: unknown key; did you mean 'color'?"),
    ("contact.indenter.radius=1", ": unknown key; did you mean 'radius_mm'?"),
    ("motion.depth_mm=true", " = True: must be a valid number"),
    ('motion.depth_mm="0.2"', " = '0.2': must be a valid number"),
    ("motion.depth_mm=nan", " = nan: must be a finite number"),
    ("motion.steps=2.0", " = 2.0: must be a whole number"),
    ("motion.steps={ uniform = [2, 4] }", " = 2.0: must be a whole number; to draw one, use { choice"),
    ("outputs.depth=1", " = 1: must be a valid boolean"),
    ("sensor.gel.size_mm=[8, 6]", "[2]: is missing"),
    ("sensor.gel.size_mm=[8, 6, 2, 1]", " = [8, 6, 2, 1]: must have at most 3 entries, not 4"),
    ("sensor.gel=3", " = 3: must be a table"),
    ("sensor.lights=[{position_mm=[1,1,2],size_mm=[1,1],color=[1,1,1],power=-1}]", "[0].power = -1: must be"),
    ("sensor.lights=[]", " = []: must have at least 1 entry, not 0"),
    ("sensor.gel.shape=bowl", " = 'bowl': allowed are 'box', 'dome', 'capsule', 'file'"),
    ("sensor.gel={ youngs_modulus_kpa = 100.0 }", "sensor.gel.size_mm: is missing"),
    ("sensor.gel.radius_mm=9", ": belongs to 'capsule', this is 'box'"),
    ("sensor.gel.cut_end=held", ": belongs to 'capsule' or 'file', this is 'box'"),
    ("sensor.gel.shape=dome", "sensor.gel.dome_radius_mm: is missing"),
    ("sensor.window.radius_mm=9", ": belongs to 'sphere' or 'cylinder' or 'capsule', this is 'plane'"),
    ("contact.indenter.tube_mm=1", ": belongs to 'torus', this is 'sphere'"),
    ("sensor.gel.layers=[{ thickness_mm = 1, youngs_modulus_kpa = 9, radius_mm = 1 }]", "[0].radius_mm: unknown key"),
    ('sensor.pattern={ kind = "bitmap", file = "a.png" }', ': placing = "z" needs width_mm'),
    (
        'sensor.pattern={ kind = "bitmap", file = "a.png", placing = "uv" }',
        'sensor: pattern.placing = "uv" does',
    ),
    (
        "sensor.pattern.placing=spherical",
        'sensor: pattern.placing = "spherical" does not suit gel.shape = "box", which',
    ),
    (
        'sensor.pattern={ kind = "bitmap", file = "a.png", placing = "uv", rotation_deg = 3.0 }',
        ': offset_mm and rotation_deg are for placing = "z"',
    ),
    ("render.samples_per_pixel=0", " = 0: must be greater than or equal to 1 or be 'auto'"),
    ("name=two words", " = 'two words': must consist of letters A to Z, digits, _ and - alone"),
    ("contact.indenter.shape=ball", " = 'ball': allowed are 'sphere', 'cylinder', 'box'"),
    ("contact.indenter={ radius_mm = 1 }", ": lacks the key 'shape'"),
    ("sensor.camera.bit_depth=9", " = 9: must be 8, 10, 12, 14 or 16"),
]
IMPOSSIBLE_PHYSICS = [
    ("sensor.gel.poisson_ratio=0.51", " = 0.51: must be less than or equal to 0.5"),
    ("sensor.gel.size_mm=[20000, 6, 2.5]", "[0] = 20000: must be less than or equal to 400"),
    ("sensor.gel.youngs_modulus_kpa=0", " = 0: must be greater than or equal to 0.1"),
    ("motion.depth_mm=2.4", " = 2.4 is more than 85 % of the gel's thickness (2.5 mm)"),
    ("motion.depth_mm={ uniform = [0.1, 2.4] }", " = 2.4 is more than 85 %"),
    ("motion.position_mm=[4.1, 0]", " x = 4.1 puts the indenter beside the pad (|x| <= 4.0)"),
    ("motion.shear_mm=[0, 6.1]", " y = 6.1 is longer than the pad (6.0 mm): check its unit"),
    ("motion.then=[{ depth_mm = 0, shear_mm = [-8.1, 0.0] }]", "[0].shear_mm x = -8.1 is longer than the pad (8.0 mm)"),
    ("motion.then=[{ depth_mm = 0.0 }]", "motion.steps = 2 cannot record every pose of motion.then: there are 3 moves"),
    ("sensor.camera.position_mm=[0, 0, 2]", "sensor: camera.position_mm z = 2.0 lies inside the sensor"),
    ("sensor.camera.look_at_mm=[0, 0, 30]", "sensor: camera.look_at_mm must lie on the gel's side of the camera"),
    ("sensor.lights.2.position_mm=[0, 0, -1]", "sensor: lights[2].position_mm z = -1.0 must lie inside"),
    ("numerics.edge_length_mm=0.01", " = 0.01 must lie between 0.0417 and 2.5 for this pad"),
]
WRONG_DISTRIBUTIONS = [
    ("motion.depth_mm={ uniform = [0.3, 0.1] }", ": uniform needs [lower, upper], it has [0.3, 0.1]"),
    ("motion.depth_mm={ uniform = [1] }", ": uniform needs two finite numbers, it has [1]"),
    ("motion.depth_mm={ normal = [0, true] }", ": normal needs two finite numbers"),
    ("motion.depth_mm={ normal = [0, -1] }", ": normal's standard deviation must not be negative"),
    ("motion.depth_mm={ log_uniform = [0, 1] }", ": log_uniform needs positive ends"),
    ("motion.depth_mm={ choice = [] }", ": choice needs a list with at least one entry"),
    ("motion.depth_mm={ unifrom = [0, 1] }", ": must be a valid number, it is a table; did you mean 'uniform'"),
    ("motion.depth_mm={ uniform = [0, 1], normal = [0, 1] }", ": must be a valid number, it is a table"),
    ("contact.indenter={ chocie = [1, 2] }", ": lacks the key 'shape'; did you mean 'choice'?"),
    ("contact.indenter.radius_mm={ choice = [1, { uniform = [2] }] }", ".choice[1]: uniform needs"),
    ("numerics.tolerance={ uniform = [1e-6, 1e-5] }", ": a distribution is not allowed here"),
]


@pytest.mark.parametrize(("override", "message"), WRONG_KEYS_AND_TYPES + IMPOSSIBLE_PHYSICS + WRONG_DISTRIBUTIONS)
def test_a_wrong_value_is_named_with_file_place_and_what_is_allowed(tiny: Path, override: str, message: str) -> None:
    """A message that begins with no name is about the override's own key."""
    key, found = override.partition("=")[0], _refusal(tiny, override)
    assert found.startswith(f"{tiny} with --set {key}: {message if message[0].isalpha() else key + message}")
    assert "\n" not in found


@pytest.mark.parametrize(("override", "message"), [
    ("motion", "give key=value, for instance --set motion.depth_mm=1.2"),
    ("=1", "give key=value"),
    ("motion..depth_mm=1", "give key=value"),
    ("sensor.lights.5.power=1", "'5' is not an entry of a list of 5 (0 is the first)"),
    ("motion.steps.more=1", "'more' lies inside a value that is not a table"),
    ("motion.depth_mm.uniform=[0, 1]", "motion.depth_mm is a distribution; give all of it, as in --set 'motion."),
])  # fmt: skip
def test_overrides(tiny: Path, override: str, message: str) -> None:
    assert re.match(rf"{re.escape(f'--set {override!r}: ')}.*{re.escape(message)}", _refusal(tiny, override))
    refused("a list of texts is needed", load_scene, tiny, set=override)


def test_every_problem_is_told_once_on_a_short_line_as_are_missing_files(tiny: Path, tmp_path: Path) -> None:
    lines = _refusal(tiny, "motion.dept_mm=1", "contact.friction=-1", "sensor.gel.poisson_ratio=1").splitlines()
    assert len(lines) == 3
    assert all(line.startswith(f"{tiny} with --set motion.dept_mm, contact.friction, ") for line in lines)
    assert len(_refusal(tiny, f"motion.depth_mm={list(range(5000))}")) < 400
    assert len(_refusal(tiny, f"motion.depth_mm={'9' * 400}")) < 1000
    shipped = ", ".join(shipped_scenes())
    assert _refusal("gelsight_mni") == f"there is no scene 'gelsight_mni'; shipped: {shipped}; or give a .toml file"
    assert _refusal(tmp_path / "none.toml") == f"there is no scene file {tmp_path / 'none.toml'}"
    assert "is a folder, not a scene: give a .toml file" in _refusal(tmp_path)
    (tmp_path / "noise.toml").write_bytes(bytes(range(256)))
    assert "not valid TOML" in _refusal(tmp_path / "noise.toml")


@pytest.mark.parametrize(("content", "message"), [
    ("name = ", "not valid TOML"),
    ("", "is empty; a scene may begin with extends"),
    ("extends = 'nosuch'\n", "extends = 'nosuch': there is no scene 'nosuch'"),
    ("extends = ['digit']\n", "extends = ['digit']: must be the name of a shipped scene or a TOML file"),
    ("extend = 'digit'\n", "extend: unknown key; did you mean 'extends'?"),
    (TEXT.replace('kind = "dots",', ""), "sensor.pattern: lacks the key 'kind'"),
    (TEXT.replace("{ uniform = [90.0, 110.0] }", "0"), "sensor: lights: no light has power; give at least one"),
    (TEXT.replace("width = 32", "widht = 32"), "sensor.camera.width: is missing"),
])  # fmt: skip
def test_files(tmp_path: Path, content: str, message: str) -> None:
    path = write_tiny(tmp_path, content)
    found = _refusal(path)
    assert found.startswith(str(path))
    assert message in found
