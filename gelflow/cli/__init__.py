"""The command line: `python -m gelflow train|finetune|evaluate|compare|predict|live|export|pairs`.

Exit status: 0 done, 1 done in part, 2 wrong input, 130 interrupted. Nothing heavy is imported before a command runs.
"""

import os
import sys
import traceback
import warnings
from collections.abc import Sequence
from typing import Any

from cyclopts import App, CycloptsError

from gelflow import __version__
from gelflow.cli.prediction import export, live, predict
from gelflow.cli.recordings import pairs
from gelflow.cli.scoring import compare, evaluate
from gelflow.cli.training import finetune, train
from gelflow.errors import InputError, printable

app = App(
    name="gelflow",
    version=__version__,
    help="Learned optical flow for vision-based tactile sensors.\n\nWith --debug, a mistake shows its traceback.",
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)
for command in (train, finetune, evaluate, compare, predict, live, export, pairs):
    app.command(command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command and returns the exit status. A mistake is one line on stderr, or a traceback with --debug."""
    os.environ.setdefault("GOMP_SPINCOUNT", "1000")  # torch's threads that spin longer waste most of a busy machine
    tokens = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in tokens
    tokens = [token for token in tokens if token != "--debug"]
    warnings.showwarning = _say
    try:
        status = app(tokens, exit_on_error=False, print_error=False)
    except (InputError, CycloptsError, OSError, MemoryError, RecursionError, KeyboardInterrupt) as error:
        if debug:
            traceback.print_exc()
        print(f"gelflow: {printable(_one_line(error))}", file=sys.stderr)
        return 130 if isinstance(error, KeyboardInterrupt) else 2
    return status if isinstance(status, int) else 0


def _say(message: Warning | str, *_: Any, **__: Any) -> None:
    """Prints a warning of ours or of a library as one line."""
    print(f"gelflow: {message}", file=sys.stderr)


def _one_line(error: BaseException) -> str:
    if isinstance(error, MemoryError | RecursionError):
        return f"out of memory, or nested too deeply ({error}); give less at once"
    if isinstance(error, FileExistsError | NotADirectoryError):
        return f"{error.filename}: is a file or lies in one; a folder is needed"
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split()) or "interrupted; what is finished has been kept"
