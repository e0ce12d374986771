"""The one exception that synth raises for something a user can put right."""


class InputError(ValueError):
    """A file, option or value that cannot be used.

    The message says what was given, where, what is allowed and what to do. The command line prints it without a
    traceback and exits with status 2.
    """


def printable(text: str) -> str:
    """The text with what a terminal would obey, or cannot show, written as an escape; lines stay lines."""
    return "".join(char if char.isprintable() or char == "\n" else ascii(char)[1:-1] for char in text)
