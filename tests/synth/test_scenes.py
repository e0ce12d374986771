"""The shipped scenes: every draw is whole in every camera, and says where its numbers come from; folders of objects."""

import re
from pathlib import Path

import numpy as np
import pytest
from commands import refused
from scipy import stats
from tiny_scene import TEXT, write_tiny

from benchmarks.capsule_surface import surface_at_rest
from synth.dataset.reader import read_dataset
from synth.flow.trace import trace
from synth.mesh import face_of
from synth.optics import Optics
from synth.pipeline.generate import generate
from synth.planning import job_variant, plan, predict
from synth.press.indenter import turned_by
from synth.render.lights import check_view
from synth.render.pattern import albedo, pixels_per_mm
from synth.sampling import draw, draw_sensor
from synth.scene import MeshIndenter, Scene
from synth.scene.template import SCENES, Template, load_scene

WIDE = ["gelsight_mini", "deltact", "gelsight"]  # Scenes of six kinds of indenter and motions up to 25 px
OPTICAL = ["gelslim", "gelstereo", "tac3d", "fingervision", "digit", "digit_calibrated", "soft_bubble"]
NAMES = [*WIDE, *OPTICAL, "gelsight_fingertip"]
ROUND = {"allsight": 0.8, "densetact": 0.95, "omnitact": 1.0}  # Share of an image that shows gel
CAMERAS = {"gelstereo": ["right"], "omnitact": ["east", "west", "south", "north"]}
PATHS = {"gelslim": {1}, "tac3d": {0, 1, 2}}
ANY = 'contact.indenter={ shape = "mesh", file = "objects/*.stl", rotation_deg = "any" }'


def _draws(name: str, count: int) -> list[Scene]:
    template = load_scene(name)
    return [draw(template, 3, trajectory) for trajectory in range(0, 2 * count, 2)]


@pytest.mark.parametrize("name", NAMES)
def test_every_pixel_of_every_camera_sees_gel_and_no_light(name: str) -> None:
    """Also when the gel is sheared as far as it may be: gel moves less than its indenter."""
    for scene in _draws(name, 30 if name in WIDE else 8):
        shear = np.abs(scene.motion.shear_mm)
        assert list(scene.sensor.views) == ["", *CAMERAS.get(name, [])]
        for sensor in scene.sensor.views.values():
            check_view(sensor)
            optics = Optics.of(sensor)
            border = [p for p in np.ndindex(9, 9) if 0 in p or 8 in p]
            rays = optics.look(np.concatenate([optics.centres, np.array(border) / 8 * optics.size]))
            assert set(rays.path) == PATHS.get(name, {0})
            assert np.all(np.abs(rays.on_flat_face[:, :2]) + shear < np.array(sensor.gel.size_mm[:2]) / 2)


@pytest.mark.parametrize(("name", "share"), ROUND.items())
def test_round_sensors_see_gel_and_no_light_and_are_pressed_where_a_camera_looks(name: str, share: float) -> None:
    for scene in _draws(name, 8):
        place, _ = face_of(scene.sensor.gel).place(scene.motion.polar_deg, None, scene.motion.azimuth_deg)
        is_seen = []
        for sensor in scene.sensor.views.values():
            check_view(sensor)
            surface, optics = surface_at_rest(sensor.gel), Optics.of(sensor)
            rays = optics.look(optics.centres)
            hits = trace(surface.material, surface.triangles, rays.origins, rays.directions)
            assert np.mean(hits.triangle >= 0) >= share
            is_seen.append(optics.is_inside(optics.project(place[None]))[0])
        assert any(is_seen)


@pytest.mark.parametrize("name", [*NAMES, *ROUND])
def test_sources_and_simplifications_are_told(name: str) -> None:
    scene = _draws(name, 1)[0]
    assert scene.name == name
    assert scene.description
    assert len(scene.references) >= 2
    text = (SCENES / f"{name}.toml").read_text()
    if name not in WIDE:
        assert "# Simplified:" in text
        assert "assumed" in text
    if scene.sensor.mirrors:
        assert re.search(r"mirrors? takes? no part in the lighting", text.replace("\n# ", " "))


@pytest.mark.parametrize("name", OPTICAL)
def test_images_are_small_and_scales_plausible(name: str) -> None:
    """A tenth of a millimetre between two neighbouring points of the gel is between a half and two pixels."""
    for scene in _draws(name, 2):
        for sensor in scene.sensor.views.values():
            camera, optics = sensor.camera, Optics.of(sensor)
            assert camera.width * camera.height <= 320 * 240
            middle = optics.look(np.array([[camera.width / 2 + 0.5, camera.height / 2 + 0.5]]))
            at = middle.on_flat_face[0]
            pair = optics.project(np.array([at, at + np.array([0.1, 0.0, 0.0])]), int(middle.path[0]))
            assert 0.5 < np.linalg.norm(pair[1] - pair[0]) < 2.0


@pytest.mark.parametrize("name", WIDE)
def test_every_kind_of_indenter_and_a_fraction_of_a_pixel_to_25(name: str) -> None:
    scenes = _draws(name, 100)
    assert {scene.contact.indenter.shape for scene in scenes} == {"sphere", "cylinder", "box", "cone", "torus"}
    motion = np.hypot(*np.array([scene.motion.shear_mm for scene in scenes]).T) * pixels_per_mm(scenes[0].sensor)
    assert 15 < motion.max() < 35


def test_gelsight_mini_covers_its_field_of_view_and_the_fingertips_markers_lie_above() -> None:
    """18.6 mm x 14.3 mm (datasheet), edge to edge along the middles; the principal point moves by some pixels."""
    sensor = _draws("gelsight_mini", 1)[0].sensor
    camera, scale = sensor.camera, pixels_per_mm(sensor)
    edges = [[0, camera.cy], [camera.width, camera.cy], [camera.cx, 0], [camera.cx, camera.height]]
    left, right, top, bottom = Optics.of(sensor).look(np.array(edges, dtype=np.float64)).on_flat_face
    assert right[0] - left[0] == pytest.approx(18.6, rel=0.01)
    assert bottom[1] - top[1] == pytest.approx(14.3, rel=0.01)
    assert 30 < sensor.pattern.spacing_mm[0] * scale < 33  # px, measured in the recordings
    assert 10 < 2 * sensor.pattern.radius_mm * scale < 14.5
    sensor = _draws("gelsight_fingertip", 1)[0].sensor
    assert not sensor.coating.is_matt
    texture = albedo(sensor, np.random.default_rng(0))
    assert texture.shape[2] == 4
    radius, (across, down) = sensor.pattern.radius_mm, sensor.pattern.spacing_mm
    # Some 280 dots, each 16 % off in area (radius_jitter 0.08): 1 %; up to 3 % of them cut by the pad's border.
    covered = texture[:, :, 3].mean() / (np.pi * radius**2 / (across * down))
    assert abs(covered - 1) < 0.06


def test_the_stereo_pair_sees_height() -> None:
    """The middle of the pad is in both images; raising it by 1 mm changes the disparity as base and distance say."""
    left, right = (Optics.of(sensor) for sensor in _draws("gelstereo", 1)[0].sensor.views.values())
    x, y = np.meshgrid(np.linspace(-4, 4, 9), np.linspace(-3, 3, 7))
    points = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    disparity = []
    for height in (0.0, 1.0):
        raised = points + np.array([0.0, 0.0, height])
        seen = [camera.project(raised) for camera in (left, right)]
        assert all(camera.is_inside(pixels).all() for camera, pixels in zip((left, right), seen, strict=True))
        disparity.append((seen[0] - seen[1])[:, 0])
    # 1 mm under the window is 1 / 1.41 mm of apparent height; base 12 mm, distance 29.4 mm, f = 316 px: 3.1 px, for
    # rays along the axis. The cameras look 10 degrees askew: the cosine's square, and as much again from Snell's law.
    np.testing.assert_allclose(disparity[1] - disparity[0], 316 * 12 / 1.41 / 29.4**2, rtol=0.08)


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "objects" / "folder.stl").mkdir(parents=True)
    for name in ("b.stl", "a.stl", "notes.txt"):
        (tmp_path / "objects" / name).write_text(name)
    monkeypatch.chdir(tmp_path)
    return write_tiny(tmp_path)


def drawn_indenters(template: Template, count: int) -> list[MeshIndenter]:
    sensor = draw_sensor(template, 0, 0)
    drawn = (draw(template, 0, trajectory, sensor=sensor).contact.indenter for trajectory in range(count))
    return [indenter for indenter in drawn if isinstance(indenter, MeshIndenter)]


def test_a_pattern_is_a_choice_of_the_files_that_match_wherever_it_stands(tiny: Path) -> None:
    folder = tiny.parent / "objects"
    choice = {"choice": [str(folder / "a.stl"), str(folder / "b.stl")]}
    assert load_scene(tiny, [ANY]).content["contact"]["indenter"]["file"] == choice
    sphere = '{ shape = "sphere", radius_mm = 1 }'
    nested = load_scene(tiny, [f"contact.indenter={{ choice = [{ANY.partition('=')[2]}, {sphere}] }}"])
    assert nested.content["contact"]["indenter"]["choice"][0]["file"] == choice
    files = {indenter.file for indenter in drawn_indenters(nested, 40)}
    assert files == set(choice["choice"])


def test_a_pattern_in_a_scenes_file_is_relative_to_it_and_stays_so(tiny: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny.write_text(re.sub(r"indenter = .*", 'indenter = { shape = "mesh", file = "objects/*.stl" }', TEXT))
    monkeypatch.chdir("/")
    assert load_scene(tiny).content["contact"]["indenter"]["file"] == {"choice": ["objects/a.stl", "objects/b.stl"]}


def test_unmatched_patterns_are_refused_new_objects_count_and_names_like_patterns_are_names(tiny: Path) -> None:
    words = rf"contact\.indenter\.file: there is no file {tiny.parent}/objects/\*\.obj"
    refused(words, load_scene, tiny, [ANY.replace("stl", "obj")])
    refused(r"objects is a folder; end it in /\*\.stl", load_scene, tiny, [ANY.replace("/*.stl", "")])
    before = load_scene(tiny, [ANY]).hash
    assert load_scene(tiny, [ANY]).hash == before
    (tiny.parent / "objects" / "c.stl").touch()
    assert load_scene(tiny, [ANY]).hash != before
    file = tiny.parent / "objects" / "a[1].stl"
    file.touch()
    override = 'contact.indenter={ shape = "mesh", file = "objects/a[1].stl" }'
    assert load_scene(tiny, [override]).content["contact"]["indenter"]["file"] == str(file)


def test_every_object_is_drawn_and_all_orientations_are_alike_likely(tiny: Path) -> None:
    """Entries of uniformly distributed rotation matrices are uniform on [-1, 1] (Archimedes)."""
    indenters = drawn_indenters(load_scene(tiny, [ANY]), 1000)
    rotations = np.array([turned_by(indenter.rotation_deg) for indenter in indenters])
    for entries in rotations.reshape(-1, 9).T:
        assert stats.kstest(entries, stats.uniform(-1, 2).cdf).pvalue > 1e-4
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
