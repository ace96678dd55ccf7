"""The entry of ``hsi-sc-nerf``: whatever goes wrong that a user can mend is one line and an exit status."""

from __future__ import annotations

import signal
import sys
from dataclasses import replace
from typing import Any

from hsi_sc_nerf.errors import InputError


def main() -> None:
    """Run the command of the command line.

    Invalid input exits with one sentence and status 2, and so does a file that the system refuses; Ctrl-C exits with
    130.
    """
    command: Any = None
    try:
        # Imported here, because Ctrl-C may come in the seconds that this takes.
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
        command.main()
    except InputError as error:
        _tell("Error: ", str(error))
        sys.exit(2)
    except OSError as error:
        if error.filename is None:
            raise
        _tell("Error: ", str(InputError(f"{error.filename}: {error.strerror}; choose another path.")))
        sys.exit(2)
    except KeyboardInterrupt:
        # Another Ctrl-C, while what was begun is ended and cleared away, would only print where it came.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        goes_on = type(command).__name__ in ("ProcessCommand", "RunCommand", "BatchCommand")
        _tell("", f"Stopped{'; the same command goes on where it stopped' if goes_on else ''}.")
        sys.exit(130)


def _tell(title: str, sentence: str) -> None:
    from rich.console import Console
    from rich.markup import escape

    Console(stderr=True).print(f"[bold red]{title}[/bold red]{escape(sentence)}", soft_wrap=True)


if __name__ == "__main__":
    main()
