"""Samples for the tests of dataset, inspection and export: a flat gel that moves as a whole under a pinhole camera.

A patterned plane z = 0 seen from straight above at `scale` px per mm: a shift of s mm in x moves every pixel by exactly
U = scale * s, V = 0. The texture is a sum of cosines, so both images are exact.
"""

import contextlib
import hashlib
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from kinematic_double import sheet

from synth.dataset.job import Job
from synth.dataset.sample import CameraFrames, Sample
from synth.dataset.sample_files import write_sample_files
from synth.dataset.writer import DatasetWriter
from synth.flow.field import FlowField
from synth.scene import Scene

HEIGHT, WIDTH = 24, 32
SCENE = {
    "name": "flat",
    "sensor": {
        "gel": {"size_mm": [4.0, 3.0, 1.0], "youngs_modulus_kpa": 100.0},
        "pattern": {"kind": "none"},
        "lights": [{"position_mm": [0.0, 0.0, 0.5], "size_mm": [1.0, 1.0], "color": [1.0, 1.0, 1.0], "power": 1.0}],
        "camera": {"width": 32, "height": 24, "fx": 80, "fy": 80, "cx": 16, "cy": 12, "position_mm": [0.0, 0.0, 20.0]},
    },
    "contact": {"indenter": {"shape": "sphere", "radius_mm": 1.0}},
    "motion": {"depth_mm": 0.1},
}


class PairSample(Sample):
    """A pair with one camera, and its parts by name."""

    image1 = property(lambda self: self.cameras[""].images[0])
    image2 = property(lambda self: self.cameras[""].images[1])
    flow = property(lambda self: self.cameras[""].flows[0])
    displacement1 = property(lambda self: self.displacements[0])
    displacement2 = property(lambda self: self.displacements[1])


def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """(..., 3) in [0, 1]."""
    waves = [np.cos(0.7 * x + 0.3 * y + k) + np.cos(0.4 * y - 0.2 * x + 2 * k) for k in range(3)]
    return 0.5 + 0.2 * np.stack(waves, axis=-1)


def translation_sample(
    index: int = 0, shift: tuple[float, float] = (1.25, -0.5), *, dtype: type = np.uint8, grey: bool = False
) -> PairSample:
    """The gel moves by `shift` px. The last two columns see no gel; what moves off the image is not visible."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    x, y, full = columns + 0.5, rows + 0.5, np.iinfo(dtype).max
    images = [np.rint(texture(x - k * shift[0], y - k * shift[1]) * full).astype(dtype) for k in (0, 1)]
    if grey:
        images = [np.ascontiguousarray(image[:, :, 0]) for image in images]
    gel = columns < WIDTH - 2
    forward = np.where(gel[..., None], np.array(shift), np.nan).astype(np.float32)

    def visible(k: int) -> np.ndarray:
        u, v = x + k * shift[0], y + k * shift[1]
        return ((u > 0) & (u < WIDTH) & (v > 0) & (v < HEIGHT) & gel).astype(np.float32)

    contact, surface = np.where(gel, index, np.nan).astype(np.float32), sheet(1, 1, 4.0, 3.0, 2)
    rest = np.zeros_like(surface.coarse.nodes)
    solver = {
        "depth_mm": 0.1, "shear_mm": [0.0, 0.0], "twist_deg": 0.0, "converged": True, "newton_iterations": 4,
        "residual": 1e-9, "min_jacobian": 0.97, "max_penetration_mm": 1e-4,
    }  # fmt: skip
    flow = FlowField(forward, visible(1), -forward, visible(-1), extras={"contact.Y": contact})
    moved = rest + np.array([shift[0] / 4, shift[1] / 4, 0.0])
    return PairSample(
        index, index // 2, (0, 3), 7, Scene.model_validate(SCENE), surface, (rest, moved),
        {"": CameraFrames((HEIGHT, WIDTH), tuple(images), (flow,))},
        diagnostics={"solver": [solver, {**solver, "depth_mm": np.float64(0.2)}]},
        force_n=np.array([[0.0, 0.0, 0.5], [0.1, 0.0, 1.5]]),
        torque_nmm=np.zeros((2, 3)),
    )  # fmt: skip


def job(n: int = 3, *, seed: int = 7, **changes: object) -> Job:
    scene = {**SCENE, **changes}
    scene_hash = hashlib.sha256(repr(scene).encode()).hexdigest()[:16]
    software, device = {"synth": "0.1.0"}, {"device": "cpu", "variant": "scalar_rgb"}
    return Job(scene, "flat", scene_hash, seed, n, software, device)


def write(writer: DatasetWriter, *samples: Sample) -> None:
    for sample in samples:
        entry = write_sample_files(writer._store.out, sample, writer.job)
        writer.record(replace(entry, seconds={"simulate": 0.1 + sample.index, "render": 0.2}))


def write_dataset(folder: Path, samples: Iterable[Sample], n: int = 3) -> Path:
    with DatasetWriter(folder, job(n)) as writer:
        write(writer, *samples)
    return folder


HOLD = """
import sys
sys.path[:0] = sys.argv[4:]
from samples import job, translation_sample, write
from synth.dataset.shard import Shard
from synth.dataset.writer import DatasetWriter
with DatasetWriter(sys.argv[1], job(6), Shard.parse(sys.argv[2]), 2) as writer:
    for index in sys.argv[3].split():
        write(writer, translation_sample(int(index)))
    print("held", flush=True)
    sys.stdin.readline()
"""


@contextlib.contextmanager
def writing_elsewhere(directory: Path, shard: str, indices: Sequence[int]) -> Iterator[subprocess.Popen[str]]:
    """Another process that has made samples of a shard and goes on to hold it until it reads a line or is killed."""
    paths = [str(Path(__file__).parent), str(Path(__file__).parents[2])]
    command = [sys.executable, "-c", HOLD, str(directory), shard, " ".join(map(str, indices)), *paths]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout.readline() == "held\n"
        yield process
    finally:
        process.kill()
        process.communicate()


def tree(directory: Path) -> dict[str, bytes]:
    """Every file's content by relative path, the lock left out."""
    files = (file for file in sorted(directory.rglob("*")) if file.is_file() and file.name != ".lock")
    return {str(file.relative_to(directory)): file.read_bytes() for file in files}


def synth_sample(index: int, dtype: type = np.uint8) -> PairSample:
    """An exchange of any two arrays shows, and of rows or columns; the first rows and columns see no gel."""
    from textures import moved  # of the tests of gelflow

    rng, full = np.random.default_rng(index), np.iinfo(dtype).max
    images = [np.rint(full * moved(64, 64, k * 1.5, -k, seed=index)).astype(dtype) for k in (0, 1)]
    flows = rng.normal(0, 2, (2, 64, 64, 2)).astype(np.float32)
    seen = (rng.random((2, 64, 64)) < 0.7).astype(np.float32)
    flows[:, :4, :9], seen[:, :4, :9] = np.nan, 0
    flow = FlowField(flows[0], seen[0], flows[1], seen[1])
    return replace(translation_sample(index), cameras={"": CameraFrames((64, 64), tuple(images), (flow,))})
