"""Known lights of the benchmark of calibration: drawn by their number, and compared with what was found."""

import pytest
from render_scenes import needs_llvm

from benchmarks.calibrations import LIGHTS, differences, drawn
from synth.scene import Scene
from synth.scene.validation import validated


@needs_llvm
def test_lights_are_drawn_by_number_and_compared_in_any_order() -> None:
    known, start = drawn(0, 3)
    assert (known, start) == drawn(0, 3) != drawn(0, 4)
    sensor = validated(known, "known lights", Scene).sensor
    assert LIGHTS[0] <= len(sensor.lights) <= LIGHTS[1]
    found = [{"position_mm": light.position_mm, "power_per_channel": [light.power * part for part in light.color]}
             for light in reversed(sensor.lights)]  # fmt: skip
    assert differences(sensor, found) == {"azimuth_deg": 0, "elevation_deg": 0, "power": 0, "found": True}
    found[0]["power_per_channel"] = [1.2 * part for part in found[0]["power_per_channel"]]
    row = differences(sensor, found)
    assert row["power"] == pytest.approx(0.2)
    assert not row["found"]
    assert not differences(sensor, found[1:])["found"]  # a light is missing
