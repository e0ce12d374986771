"""Plain values as a configuration, or one line a problem: which field, what was given, what is allowed."""

import json
from collections.abc import Mapping
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from gelflow.errors import InputError

Config = TypeVar("Config", bound=BaseModel)

RETIRED: Mapping[str, tuple[Any, ...]] = {
    "finest_scale": (2,), "correlation_radius": (4,), "normalise_features": (True,), "lffm_region": (3,),
    "refine_iterations": (3,), "loss.lambda_ph": (1,), "loss.lambda_census": (0,),
    "loss.mask_outside": (True,), "loss.flow_normalisation": ("min_side",), "loss.ratio": ("product",),
    "loss.weight": ("anti_edge",), "loss.weight_floor": (0.1,), "compile": (False, True),
}  # fmt: skip
"""Settings of earlier versions, which weights and runs record, with the values that mean what every run does now; those
of a model by their names alone."""


def validated(kind: type[Config], values: Mapping[str, Any], source: str) -> Config:
    """Builds a `ModelConfig`, `LossConfig` or `TrainConfig` from plain values, nested as the configuration is.

    Types are strict: true and "1" are no numbers, 1 is no truth value. But 1e3 is a whole number, 1 a number with a
    decimal point, too, and a list serves as a tuple. `source` is what the values come from (a path, an option), for the
    message. InputError for fields that do not exist, have the wrong type or lie outside their range; one line per
    field.
    """
    try:
        return kind.model_validate_json(json.dumps(_whole(values), default=str), strict=True)
    except ValidationError as error:
        lines = []
        for item in error.errors():
            field = ".".join(str(part) for part in item["loc"])
            given = "" if item["type"] in ("value_error", "missing") else f" (given: {item['input']!r})"
            if item["type"] == "extra_forbidden":
                allowed = _fields_at(kind, item["loc"][:-1])
                lines.append(f"{field}: there is no such setting; allowed: {', '.join(allowed)}")
            else:
                lines.append(f"{field and f'{field}: '}{item['msg'].removeprefix('Value error, ')}{given}")
        raise InputError(f"{source}: " + "; ".join(lines)) from error


def _whole(value: Any, place: str = "") -> Any:
    """The value without `RETIRED`, and with floats such as 1e3 as whole numbers, which fields of either kind take."""
    if isinstance(value, Mapping):
        return {
            name: _whole(part, f"{place}{name}.")
            for name, part in value.items()
            if part not in RETIRED.get(f"{place}{name}".removeprefix("model."), ())
        }
    if isinstance(value, (list, tuple)):
        return [_whole(part) for part in value]
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _fields_at(kind: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    for name in location:
        annotation = kind.model_fields[str(name)].annotation
        parts = (annotation, *get_args(annotation))
        tables = [part for part in parts if isinstance(part, type) and issubclass(part, BaseModel)]
        if not tables:
            return []
        kind = tables[0]
    return list(kind.model_fields)
