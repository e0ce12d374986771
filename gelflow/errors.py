"""The one exception that gelflow raises for something a user can put right."""


class InputError(ValueError):
    """A file, option or value that cannot be used.

    The message says what was given, where, what is allowed and what to do. The command line prints it without a
    traceback and exits with status 2.
    """


class NothingFoundError(InputError):
    """A method that follows single points found none in a pair; `evaluate` scores it as no motion there."""
