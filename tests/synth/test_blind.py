"""The blind sheet: its numbers mean what they say, and the key knows which frame is which."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from synth.calibrate.blind import STATISTICS, statistics, write_sheet
from synth.errors import InputError


def _frame(noise: float, seed: int = 0) -> np.ndarray:
    """240 x 320: red rises by 30 from left to right, green falls by 24 from top to bottom, blue is 100; dark dots."""
    y, x = np.mgrid[0:240, 0:320]
    image = np.stack([90 + 30 * x / 319, 120 - 24 * y / 239, np.full(x.shape, 100.0)], axis=2)
    image[((x % 32) - 16) ** 2 + ((y % 32) - 16) ** 2 < 30] *= 0.5
    return image + noise * np.random.default_rng(seed).standard_normal(image.shape)


def test_statistics_of_a_known_frame() -> None:
    """Fails with thirds exchanged, with the linear ratio left encoded, and without the kernel's factor of 1/6."""
    found = dict(zip(STATISTICS, statistics(_frame(0.8)), strict=True))
    # Thirds are two thirds of the ramp apart; the median of pixels that are 9 % dots lies 0.1 standard deviations low.
    assert found["red, right less left"] == pytest.approx(20, abs=0.7)
    assert found["green, bottom less top"] == pytest.approx(-16, abs=0.7)
    assert found["blue, right less left"] == pytest.approx(0, abs=0.3)
    assert found["mean red"] == pytest.approx(105, abs=1)
    assert found["dots over coating"] == pytest.approx(0.5**2.2, abs=0.02)
    assert found["fine detail blue"] == pytest.approx(0.8, rel=0.03)  # some 60,000 pixels: 0.5 %


def test_sheet_key_and_table_are_written(tmp_path: Path) -> None:
    kinds: dict[str, list[Path]] = {"real": [], "synthetic": []}
    for kind, paths in kinds.items():
        for k in range(2):
            paths.append(tmp_path / f"{kind}{k}.png")
            cv2.imwrite(str(paths[-1]), np.clip(_frame(1.0, k), 0, 255).astype(np.uint8))
    out = tmp_path / "sheet"
    write_sheet(kinds["real"], kinds["synthetic"], out, 3)
    key = [line.split(": ")[1] for line in (out / "key.txt").read_text().splitlines()]
    assert sorted(key) == ["real", "real", "synthetic", "synthetic"]
    assert cv2.imread(str(out / "blind.png")) is not None
    assert (out / "statistics.md").read_text().count("\n") == 2 + len(STATISTICS)
    with pytest.raises(InputError, match="no such file"):
        write_sheet([tmp_path / "none.png"], kinds["synthetic"], out, 3)
