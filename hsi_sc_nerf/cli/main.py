"""The entry of ``hsi-sc-nerf``: whatever goes wrong that a user can mend is one line and an exit status."""

# All else is imported in `_run`: Ctrl-C may come in the seconds that this takes.
import signal
import sys


class _Press:
    """Whether Ctrl-C was pressed: libraries under import turn `KeyboardInterrupt` into exceptions of their own."""

    seen = False

    def __call__(self, number: int, frame: object) -> None:
        self.seen = True
        raise KeyboardInterrupt


def main() -> None:
    """Run the command of the command line.

    Invalid input exits with one sentence and status 2, and so does a file that the system refuses; Ctrl-C exits with
    130.
    """
    press = _Press()
    commands_run: list[object] = []
    try:
        if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # it may be ignored, as by nohup
            signal.signal(signal.SIGINT, press)
        _run(commands_run)
        # All is written, and Python takes a moment to end.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    except BaseException as error:
        if press.seen or isinstance(error, KeyboardInterrupt):
            # Another Ctrl-C, while what was begun is ended and cleared away, would only print where it came.
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            kinds = {type(command).__name__ for command in commands_run}
            goes_on = not kinds.isdisjoint(("ProcessCommand", "RunCommand", "BatchCommand"))
            print(f"Stopped{'; the same command goes on where it stopped' if goes_on else ''}.", file=sys.stderr)
            sys.exit(130)
        _tell_error(error)
        raise


def _run(commands_run: list[object]) -> None:
    """Run the command, which is appended to ``commands_run`` once it is known."""
    from dataclasses import replace

    import tyro

    from hsi_sc_nerf.cli import commands
    from hsi_sc_nerf.terminal import ignore_library_warnings

    ignore_library_warnings()
    # Reading the options can already raise InputError.
    needed = commands.named_commands(sys.argv[1:])
    if needed == ("batch",):
        # The words that it does not know are Snakemake's.
        command, others = tyro.cli(commands.command_line(needed), return_unknown_args=True)
        command = replace(command, other_words=tuple(others))
    else:
        command = tyro.cli(commands.command_line(needed), description=commands.__doc__)
    commands_run.append(command)
    command.main()


def _tell_error(error: BaseException) -> None:
    """Print what a user can mend, and exit with 2; anything else is left to Python."""
    from rich.console import Console
    from rich.markup import escape

    from hsi_sc_nerf.errors import InputError

    if isinstance(error, OSError) and error.filename is not None:
        error = InputError(f"{error.filename}: {error.strerror}; choose another path.")
    if isinstance(error, InputError):
        Console(stderr=True).print(f"[bold red]Error: [/bold red]{escape(str(error))}", soft_wrap=True)
        sys.exit(2)


if __name__ == "__main__":
    main()
