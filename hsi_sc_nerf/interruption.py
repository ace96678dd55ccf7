"""Ctrl-C in a command: one line and exit status 130, whatever is being done and whatever a library makes of it.

Until a command begins its work it ends at once. While it works, KeyboardInterrupt is raised, so that what was begun
is cleared away, but not while a library is loaded: libraries turn it into errors of their own, and compiled ones
abort.
"""

# Little is imported: Ctrl-C may come meanwhile.
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

_NERFSTUDIO_COMMANDS = {
    "ns-eval": "eval",
    "ns-export": "exporter",
    "ns-render": "render",
    "ns-train": "train",
    "ns-viewer": "viewer.run_viewer",
}
"""And their scripts, which import this package while they are imported."""
_SCRIPTS = "nerfstudio.scripts."
_OWN_METHODS = "hsi-sc-nerf"
_STOPPED = "hsi-sc-nerf: stopped."
_AGAIN_S = 0.05


def end_at_once(line: str) -> None:
    """From now on Ctrl-C prints ``line`` and ends the process; it stays ignored where it is, as by nohup."""
    if _is_main_thread() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _EndAtOnce(line))


def end_nerfstudio_command_at_once() -> None:
    """`end_at_once`, if this process is one of nerfstudio's commands that may be about a run of this package."""
    name = os.path.splitext(os.path.basename(sys.argv[0]))[0]
    if name == "-c":  # as `benchmark.steps.typed_command` calls them
        name = next((name for name, script in _NERFSTUDIO_COMMANDS.items() if _SCRIPTS + script in sys.modules), "")
    other_method = name == "ns-train" and not "".join(sys.argv[1:2]).startswith(_OWN_METHODS)
    if name in _NERFSTUDIO_COMMANDS and not other_method:
        end_at_once(_STOPPED)


def leave_alone() -> None:
    """Undo `end_at_once`: from now on Ctrl-C does what Python has it do."""
    if _is_command():
        signal.signal(signal.SIGINT, signal.default_int_handler)


def ignore_when_done() -> None:
    """In a command: ignore Ctrl-C, for all is written and Python takes a moment to end."""
    if _is_command():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def one_line(line: Callable[[], str] = lambda: _STOPPED) -> Iterator[None]:
    """Ctrl-C in the block unwinds it, prints ``line()`` and exits with 130; in such a block, the outer one does.

    Raises:
        SystemExit: Ctrl-C was pressed.
    """
    press = _Press()
    before = signal.getsignal(signal.SIGINT)
    if isinstance(before, _Press):
        yield
        return
    taken = _is_main_thread() and (_is_command() or before is signal.default_int_handler)
    ignored_errors = sys.unraisablehook
    if taken:
        signal.signal(signal.SIGINT, press)
        sys.unraisablehook = lambda ignored: press.raise_again(ignored, ignored_errors)
    try:
        yield
    except BaseException as error:
        if not (press.seen or isinstance(error, KeyboardInterrupt)):
            raise
        if isinstance(before, _EndAtOnce):
            # Another Ctrl-C, while what was begun is ended and cleared away, would only print where it came.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        print(line(), file=sys.stderr)
        raise SystemExit(130) from None
    finally:
        if taken:
            sys.unraisablehook = ignored_errors
            if signal.getsignal(signal.SIGINT) is press:
                signal.signal(signal.SIGINT, before)


class _EndAtOnce:
    def __init__(self, line: str) -> None:
        self._line = line

    def __call__(self, number: int, frame: FrameType | None) -> None:
        os.write(2, f"{self._line}\n".encode())  # a print may be what was interrupted
        os._exit(130)


class _Press:
    """Raises KeyboardInterrupt, and remembers it: libraries turn it into exceptions of their own."""

    seen = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        self.seen = True
        if _is_loading(frame):
            self._again()
        else:
            raise KeyboardInterrupt

    def raise_again(self, ignored: Any, otherwise: Callable[[Any], object]) -> None:
        """What Python calls where an exception cannot be raised, as in a destructor: it would be lost there."""
        if self.seen and ignored.exc_type is KeyboardInterrupt:
            self._again()
        else:
            otherwise(ignored)

    def _again(self) -> None:
        later = threading.Timer(_AGAIN_S, _press_again)
        later.daemon = True
        later.start()


def _press_again() -> None:
    main = threading.main_thread().ident
    if sys.platform == "win32" or main is None:
        signal.raise_signal(signal.SIGINT)
    else:
        signal.pthread_kill(main, signal.SIGINT)  # the thread that may be waiting for something


def _is_loading(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


def _is_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _is_command() -> bool:
    return isinstance(signal.getsignal(signal.SIGINT), _EndAtOnce)
