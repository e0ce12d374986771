"""The weights that come with the package; `gelflow/weights/README.md` says what they were trained on, and how well."""

from importlib.resources import files
from pathlib import Path

SHIPPED = "best"


def weights_file(given: Path | None) -> Path:
    """The file of weights that is meant.

    Args:
        given: A file; "best", where there is no such file, and None: those that come with the package.
    """
    if given is None or (str(given) == SHIPPED and not given.is_file()):
        return Path(str(files("gelflow"))) / "weights" / f"{SHIPPED}.safetensors"
    return given
