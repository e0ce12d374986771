"""Calls that synth and gelflow must refuse."""

from collections.abc import Callable
from typing import Any

import pytest

import gelflow.errors
import synth.errors


def refused(message: str, call: Callable[..., object], *arguments: Any, **options: Any) -> str:
    """What the program's InputError says, which the call must raise and the regular expression must match."""
    __tracebackhide__ = True
    with pytest.raises((synth.errors.InputError, gelflow.errors.InputError), match=message) as error:
        call(*arguments, **options)
    return str(error.value)
