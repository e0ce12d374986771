"""What commands and calls say, above all when they refuse."""

from collections.abc import Callable
from typing import Any

import pytest

import gelflow.errors
import synth.errors


def said(capsys: pytest.CaptureFixture[str], main: Callable, *arguments: object, status: int = 0) -> str:
    """What a command prints: on stdout, or on stderr where it must end with another status than 0."""
    assert main([str(argument) for argument in arguments]) == status
    out, err = capsys.readouterr()
    return err if status else out


def complaint(capsys: pytest.CaptureFixture[str], main: Callable, *arguments: object) -> str:
    """The one thing that a command says which must end with status 2: on stderr, without a traceback."""
    assert main([str(argument) for argument in arguments]) == 2
    out, err = capsys.readouterr()
    program, _, words = err.rstrip().partition(": ")
    assert (out, program, "Traceback" in words) == ("", main.__module__.partition(".")[0], False)
    return words


def refused(message: str, call: Callable[..., object], *arguments: Any, **options: Any) -> str:
    """What the program's InputError says, which the call must raise and the regular expression must match."""
    with pytest.raises((synth.errors.InputError, gelflow.errors.InputError), match=message) as error:
        call(*arguments, **options)
    return str(error.value)
