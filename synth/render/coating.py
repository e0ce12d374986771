"""How the contact face reflects: one coating, or a coating with matt marks on its camera's side.

The coating is Lambertian at roughness 1 and metallic 0, else Disney's principled model (Burley, SIGGRAPH 2012 course).
Marks above it are Lambertian. Where they cover a share m of the surface,

    f = (1 - m) · f_coating + m · f_mark,

which is exact for opaque marks without thickness: m is 0 or 1 but at their edges, where it is an average over area.
Light on a matt coating does not depend on the view and can be separated (`synth.render.separated_light`).
"""

from typing import Any

import numpy as np

from synth.arrays import Image
from synth.errors import InputError
from synth.render.variant import LLVM_HINT, Variant
from synth.scene import Coating, Render, Sensor


def reflection(mi: Any, coating: Coating, texture: Image, is_mono: bool) -> Any:
    """The face's reflection, the same from either side, as Mitsuba's BSDF.

    Of the coating its roughness and metallic count, and its reflectance where marks lie above it. The texture, (rows,
    columns, 3 or 4) float32, is from `pattern.albedo` and must not be changed afterwards. With `is_mono` colours are
    grey, and one channel is wanted.
    """
    colors = texture[:, :, :3].mean(axis=2, keepdims=True) if is_mono else texture[:, :, :3]
    if texture.shape[2] == 3:
        return mi.load_dict({"type": "twosided", "bsdf": coat(coating, _map(mi, colors))})
    bare = np.broadcast_to(np.array(coating.reflectance, dtype=np.float32), (2, 2, 3))[:, :, : colors.shape[2]]
    layers = {
        "type": "blendbsdf",
        "weight": _map(mi, texture[:, :, 3:]),
        "coating": coat(coating, _map(mi, bare)),
        "marks": {"type": "diffuse", "reflectance": _map(mi, colors)},
    }
    return mi.load_dict({"type": "twosided", "bsdf": layers})


def coat(coating: Coating, color: dict[str, Any]) -> dict[str, Any]:
    """Mitsuba's description of a coating alone, one-sided, with a colour or texture of reflectance."""
    if coating.is_matt:
        return {"type": "diffuse", "reflectance": color}
    shine = {"roughness": coating.roughness, "metallic": coating.metallic}
    return {"type": "principled", "base_color": color, **shine}


def _map(mi: Any, values: Image) -> dict[str, Any]:
    """A texture; on the CPU it shares the array's memory, where a bitmap would be copied three times."""
    import drjit as dr

    values = np.ascontiguousarray(values)
    given = {"data": mi.TensorXf(values)} if dr.is_jit_v(mi.Float) else {"bitmap": mi.Bitmap(values)}
    return {"type": "bitmap", **given, "raw": True, "wrap_mode": "clamp"}


def is_separated(render: Render, sensor: Sensor, variant: Variant) -> bool:
    """Whether light is separated or path traced: decided here alone. Scalar variants path-trace.

    InputError where separated light is asked for, and the coating shines, and for measured light without it.
    """
    coating = sensor.coating
    if sensor.measured_light is not None and not (render.light == "separated" and variant.is_vectorised):
        raise InputError(
            f'sensor.measured_light needs render.light = "separated" (given: "{render.light}") and a vectorised '
            f"variant (here: {variant.name}): {LLVM_HINT}"
        )
    if render.light != "separated":
        return False
    if not coating.is_matt:
        raise InputError(
            f'render.light = "separated" needs a matt coating (roughness = 1, metallic = 0), but this sensor\'s has '
            f"roughness = {coating.roughness:g} and metallic = {coating.metallic:g}: what shines depends on the view; "
            'set render.light to "path_traced"'
        )
    return variant.is_vectorised
