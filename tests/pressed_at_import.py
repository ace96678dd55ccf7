"""A process in which Ctrl-C comes just when a library is about to be loaded."""

import os
import subprocess
import sys

_PRESSES = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell has it ignored in the background
library, *sys.argv = sys.argv[1:]
class Presses:
    def find_spec(self, name, path=None, target=None):
        if name == library:
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Presses())
"""


def run(library, code, words):
    """The ended process, which ran ``code`` as a command that was called with ``words``."""
    return subprocess.run(
        [sys.executable, "-c", _PRESSES + code, library, *words],
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"TERM": "dumb"},
    )
