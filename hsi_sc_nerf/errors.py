"""The exception for bad input."""


class InputError(Exception):
    """Something that the user gave cannot be used.

    The message is one sentence: which file, what is wrong with it, and what to do. The command line prints it without
    a traceback and exits with status 2.
    """
