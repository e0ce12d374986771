"""Pictures of one press at many settings: their errors and the time of a frame."""

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from multiprocessing import get_context
from statistics import median

from synth.arrays import Image
from synth.bench.render_error import Errors, Reference, errors
from synth.bench.render_subject import View
from synth.errors import InputError
from synth.render.renderer import full_grid
from synth.render.variant import (
    Device,
    Variant,
    choose_variant,
    cpu_variant,
    cuda_trouble,
    llvm_candidates,
    llvm_version,
)
from synth.scene import Render, Sensor

SAMPLES = (1, 4, 16, 36, 64, 144, 256, 576, 1024)
"""Asked for; those above a sixth of the reference's are left out."""
DEPTHS = (2, 3, 4, 6)
DEEPEST = 8
"""Of the reference, unless the scene's own paths are longer."""
DEPTH_SAMPLES, FEW_SAMPLES = 144, (1, 36)
"""At which path depths are compared; and for pictures without a window and variants that are not the fastest."""
REPEATS = 3
_FEWER = 6
"""So many times fewer samples than the reference has, at least."""

Say = Callable[[str], None]


@dataclass(frozen=True)
class Setting:
    """Of a picture.

    Attributes:
        variant: of Mitsuba.
        window: False: refractive index 1, which is another picture.
        max_depth: longest path.
        samples: per pixel, as they are really taken.
    """

    variant: Variant
    window: bool
    max_depth: int
    samples: int


@dataclass(frozen=True)
class Cell:
    """What a setting gave.

    Attributes:
        setting: of it.
        seconds: of a frame, median.
        processor_s: of a frame, median over the repeats: processor time of all threads of this process.
        errors: against the reference; without window the difference from it.
    """

    setting: Setting
    seconds: float
    processor_s: float
    errors: Errors

    @property
    def cost(self) -> float:
        """What settings are compared by, s: processor time, which other work changes less; on CUDA wall time."""
        return self.seconds if self.setting.variant.name.startswith("cuda") else self.processor_s

    @property
    def is_error(self) -> bool:
        """Whether the picture is of what the reference shows."""
        return self.setting.window


@dataclass(frozen=True)
class StartUp:
    """Seconds of a fresh process: importing Mitsuba, building the scene, the first frame beyond a later one."""

    variant: str
    load: float
    build: float
    first: float


def variants(device: Device, grey: bool) -> tuple[list[Variant], list[str]]:
    """Those that work here, fastest first, and why others do not.

    Args:
        device: "cpu": no CUDA; "cuda": nothing but.
        grey: the scene is; mono and colour are then compared.

    Raises:
        InputError: CUDA was asked for and does not work.
    """
    found, absent = [choose_variant(device, grey)], []
    if grey:
        found.append(choose_variant(device, False))
    trouble = "left out by --device cpu" if device == "cpu" else cuda_trouble("cuda_ad_rgb")
    if trouble is not None:
        absent.append(f"cuda_ad_rgb: {trouble}.")
    if device != "cuda":
        found.append(cpu_variant(llvm_candidates(), llvm_version, "rgb"))
        found.append(cpu_variant((), llvm_version, "rgb"))
    if not any(variant.name.startswith("llvm") for variant in found) and device != "cuda":
        absent.append(f"llvm_ad_rgb: {found[-2].reason}.")
    return list({variant.name: variant for variant in found}.values()), absent


def settings(every: Sequence[Variant], sensor: Sensor, own_depth: int, reference: int) -> list[Setting]:
    """All pictures: samples at the scene's depth and the deepest, depths, then window off and other variants."""
    lights = sum(light.power > 0 for light in sensor.lights)
    most = max(reference // _FEWER, full_grid(1, lights))

    def grids(wanted: Sequence[int]) -> list[int]:
        return [n for n in dict.fromkeys(full_grid(asked, lights) for asked in wanted) if n <= most]

    fastest, ladder, few = every[0], grids(SAMPLES), grids(FEW_SAMPLES)
    found = [Setting(fastest, True, depth, n) for depth in (own_depth, max(DEEPEST, own_depth)) for n in ladder]
    found += [Setting(fastest, True, depth, n) for depth in DEPTHS for n in grids([DEPTH_SAMPLES])]
    found += [Setting(variant, True, own_depth, n) for variant in every[1:] for n in few]
    found += [Setting(variant, False, own_depth, n) for variant in every for n in few]
    return list(dict.fromkeys(found))


def rendered(view: View, setting: Setting, seeds: Sequence[int]) -> tuple[list[Image], list[float], list[float]]:
    """The pressed gel with each of the seeds, and what each frame took in s of wall time and of processor time.

    Raises:
        InputError: a light in the view, or a lens that the variant cannot render.
    """
    render = Render(samples_per_pixel=setting.samples, max_depth=setting.max_depth)
    renderer = view.renderer(setting.variant, render, setting.window)
    pictures, seconds, processor = [], [], []
    for seed in seeds:
        started, worked = time.perf_counter(), time.process_time()
        pictures.append(renderer.radiance(view.pressed, seed))
        seconds.append(time.perf_counter() - started)
        processor.append(time.process_time() - worked)
    return pictures, seconds, processor


def reference(view: View, variant: Variant, samples: int, own_depth: int = 2, say: Say = lambda _: None) -> Reference:
    """The picture with the deepest paths, in two halves with seeds that no other picture has."""
    depth = max(DEEPEST, own_depth)
    lights = sum(light.power > 0 for light in view.sensor.lights)
    half = full_grid((samples + 1) // 2, lights)
    (first, second), seconds, _ = rendered(view, Setting(variant, True, depth, half), (1, 2))
    say(f"reference: 2 x {half} samples a pixel, path depth {depth}: {sum(seconds):.1f} s")
    return Reference((first, second), 2 * half)


def measure(
    view: View, wanted: Sequence[Setting], truth: Reference, absent: list[str], say: Say = lambda _: None
) -> Iterator[Cell]:
    """One setting after the other.

    Args:
        view: what is rendered.
        wanted: settings.
        truth: the reference.
        absent: gets a line for each setting that this scene forbids.
        say: told what was done.
    """
    for number, setting in enumerate(wanted, 1):
        what = f"{setting.variant.name}, {'window' if setting.window else 'no window'}, depth {setting.max_depth}"
        what += f", {setting.samples} samples a pixel"
        try:
            # Seeds of its own for every setting: two with the same number of samples would start with the same rays.
            pictures, seconds, processor = rendered(view, setting, [1000 * number + k for k in range(REPEATS)])
        except InputError as error:
            absent.append(f"{what}: {error}")
            continue
        cell = Cell(setting, median(seconds), median(processor), errors(pictures, truth, view.sensor.camera))
        say(f"{what}: {cell.seconds:.3f} s, {cell.errors.rmse:.3f} levels ({number} of {len(wanted)})")
        yield cell


def start_up(view: View, variant: Variant, render: Render) -> StartUp:
    """Of a fresh process; compiled kernels come from Dr.Jit's cache on the disk where it has them.

    Raises:
        InputError: a lens that the variant cannot render.
    """
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(_start, view, variant, render).result()


def _start(view: View, variant: Variant, render: Render) -> StartUp:
    times = [time.perf_counter()]
    variant.load()
    times.append(time.perf_counter())
    renderer = view.renderer(variant, render)
    times.append(time.perf_counter())
    for seed in range(3):
        renderer.radiance(view.pressed, seed)
        times.append(time.perf_counter())
    load, build, first, *later = (after - before for before, after in pairwise(times))
    return StartUp(variant.name, load, build, first - min(later))
