"""Images whose motion is known exactly: a sum of plane waves is evaluated at moved positions, nothing is resampled."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from gelflow.files.exr import write_flow

REAL = Path(__file__).resolve().parents[2].parent / "shared" / "real" / "gelsight_mini"
"""Recordings that lie beside the repository on some machines."""


def texture(x: NDArray[np.float64], y: NDArray[np.float64], seed: int = 0) -> NDArray[np.float32]:
    """Colour (..., 3) in [0, 1] at positions in px: 24 waves of 8 to 24 px with random direction, phase and colour."""
    generator, value = np.random.default_rng(seed), np.zeros((*x.shape, 3))
    for _ in range(24):
        number, angle = 2 * np.pi / generator.uniform(8, 24), generator.uniform(0, np.pi)
        wave = np.sin(number * (np.cos(angle) * x + np.sin(angle) * y) + generator.uniform(0, 2 * np.pi))
        value += wave[..., None] * generator.uniform(0.5, 1.0, 3)
    return np.clip(0.5 + value / 24, 0, 1).astype(np.float32)


def grid(height: int, width: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return x, y


def moved(height: int, width: int, u: float, v: float, seed: int = 0) -> NDArray[np.float32]:
    """The texture after it has moved by (u, v) px; with (0, 0) it is image 1, so that I1(x) = I2(x + (u, v))."""
    x, y = grid(height, width)
    return texture(x - u, y - v, seed)


def as_bytes(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.rint(image * 255).astype(np.uint8)


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def save(path: Path, image: NDArray[np.float32]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), as_bytes(image)[..., ::-1])


def write_video(path: Path, frames: list[NDArray[np.uint8]], rate: float = 25.0) -> None:
    height, width = frames[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), rate, (width, height))
    assert writer.isOpened()
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()


def write_folder(folder: Path, shifts: dict[str, tuple[float, float]], size: tuple[int, int] = (64, 80)) -> Path:
    for name, (u, v) in shifts.items():
        save(folder / f"{name}_1.png", moved(*size, 0, 0))
        save(folder / f"{name}_2.png", moved(*size, u, v))
    return folder


def write_synthetic(folder: Path, shifts: list[tuple[float, float]], size: tuple[int, int] = (64, 80)) -> Path:
    """A data set as synth lays it out, with a strip without gel (NaN) and a strip that is not visible."""
    for index, shift in enumerate(shifts):
        sample = folder / "samples" / f"{index:06d}"
        save(sample / "image1.png", moved(*size, 0, 0))
        save(sample / "image2.png", moved(*size, *shift))
        flow, visible = np.full((*size, 2), shift, np.float32), np.ones(size, bool)
        flow[:, :8], visible[:, :8], visible[:, -8:] = np.nan, False, False
        write_flow(sample / "flow.exr", flow, visible)
    (folder / "dataset.json").write_text(json.dumps({"schema_version": 1, "n": len(shifts)}))
    lines = [json.dumps({"index": index, "frames": [0, 1]}) + "\n" for index in range(len(shifts))]
    (folder / "manifest.jsonl").write_text("".join(lines))
    return folder
