"""The entry of ``hsi-sc-nerf``: whatever goes wrong that a user can mend is one line and an exit status."""

import sys
from typing import Any

from hsi_sc_nerf import interruption

_GO_ON = ("ProcessCommand", "RunCommand", "BatchCommand")


def main() -> None:
    """Run the command of the command line.

    Invalid input exits with one sentence and status 2, and so does a file that the system refuses; Ctrl-C exits with
    130.
    """
    # All else is imported later: Ctrl-C may come in the seconds that this takes.
    interruption.end_at_once("Stopped.")
    try:
        command = _command()
        goes_on = "; the same command goes on where it stopped" if type(command).__name__ in _GO_ON else ""
        with interruption.one_line(lambda: f"Stopped{goes_on}."):
            command.main()
    except (Exception, SystemExit) as error:
        _tell_error(error)
        raise
    finally:
        interruption.ignore_when_done()


def _command() -> Any:
    """The command of the command line."""
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
        return replace(command, other_words=tuple(others))
    return tyro.cli(commands.command_line(needed), description=commands.__doc__)


def _tell_error(error: BaseException) -> None:
    """Print what a user can mend, and exit with 2; anything else is left to Python."""
    from rich.console import Console
    from rich.markup import escape

    from hsi_sc_nerf.errors import InputError

    if isinstance(error, SystemExit) and isinstance(error.code, str):  # as in nerfstudio's commands, which open runs
        error = InputError(error.code.removeprefix("hsi-sc-nerf: "))
    if isinstance(error, OSError) and error.filename is not None:
        error = InputError(f"{error.filename}: {error.strerror}; choose another path.")
    if isinstance(error, InputError):
        Console(stderr=True).print(f"[bold red]Error: [/bold red]{escape(str(error))}", soft_wrap=True)
        sys.exit(2)


if __name__ == "__main__":
    main()
