"""What all parts of a scene's schema share."""

from collections.abc import Callable
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

Fraction = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Vector2 = tuple[float, float]
Vector3 = tuple[float, float, float]
Color = tuple[Fraction, Fraction, Fraction]


class Part(BaseModel):
    """Base of every part of a scene: frozen, closed to unknown keys, finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def shape_or(default: str) -> Callable[[Any], Any]:
    """What tells the members of a union of shapes apart, where a table that names no shape has the default one."""

    def shape(value: Any) -> Any:
        return value.get("shape", default) if isinstance(value, dict) else getattr(value, "shape", default)

    return shape
