"""The one exception that bad input raises."""


class InputError(Exception):
    """Something that the user gave cannot be used.

    The message is one sentence for the user: which file, what is wrong with it, and what to do. Command lines
    print it without a traceback and exit with status 2.
    """
