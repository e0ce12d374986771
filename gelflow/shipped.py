"""The weights that come with the package; `gelflow/weights/README.md` says what they were trained on, and how well."""

from importlib.resources import files
from pathlib import Path

SHIPPED = ("best", "digit")


def weights_file(given: Path | None) -> Path:
    """The file of weights that is meant.

    Args:
        given: A file, or the name of shipped weights where there is no such file; None: the default, "best".
    """
    name = "best" if given is None else str(given)
    if name in SHIPPED and not Path(name).is_file():
        return Path(str(files("gelflow"))) / "weights" / f"{name}.safetensors"
    return Path(name)
