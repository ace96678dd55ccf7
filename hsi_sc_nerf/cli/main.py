"""The entry of ``hsi-sc-nerf``: whatever goes wrong that a user can mend is one line and an exit status."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Annotated, Any, Union

from hsi_sc_nerf import interruption

_DESCRIPTION = "Hyperspectral 3D reconstruction of turntable captures."
_GO_ON = ("ProcessCommand", "RunCommand", "BatchCommand")


COMMANDS = {
    "demo": ("workflows", "DemoCommand", "Simulate, reconstruct and judge a fruit: try this first."),
    "simulate": ("sessions", "SimulateCommand", "Simulate a turntable session, with its truth."),
    "run": ("workflows", "RunCommand", "Do all steps from a capture session to traits and a report."),
    "batch": ("batch", "BatchCommand", "Do all steps on many sessions, here or on a cluster."),
    "markers": ("sessions", "MarkersCommand", "Write ArUco markers to print."),
    "inspect": ("sessions", "InspectCommand", "Check a session in seconds, before you process it."),
    "process": ("sessions", "ProcessCommand", "Calibrate captures, estimate poses and masks, pack a dataset."),
    "export": ("trained_runs", "ExportCommand", "Write the spectral point cloud of a trained run."),
    "sample": ("trained_runs", "SampleCommand", "Add spectra of a trained run to the points of a PLY file."),
    "material": ("light", "MaterialCommand", "Tell the material's reflectance apart from the light on it."),
    "render": ("trained_runs", "RenderCommand", "Render views of a trained run as ENVI cubes and videos."),
    "compare": ("clouds", "CompareCommand", "Compare a cloud or mesh with a reference: F-score, distances."),
    "traits": ("clouds", "TraitsCommand", "Measure sizes, spectra, indices and classes on a cloud."),
    "change": ("change", "ChangeCommand", "Find what changed on an object between days, beyond noise."),
    "report": ("trained_runs", "ReportCommand", "Write one HTML file on a trained run."),
    "collect": ("batch", "CollectCommand", "Write one table and one page of all objects of a batch."),
    "benchmark": ("benchmark", "BenchmarkCommand", "Compare configurations by accuracy over training time."),
}
"""Module and class of each command and what the help says of it, in its order."""


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

    from hsi_sc_nerf.terminal import ignore_library_warnings

    ignore_library_warnings()
    # Reading the options can already raise InputError.
    needed = named_commands(sys.argv[1:])
    if needed == ("batch",):
        # The words that it does not know are Snakemake's.
        command, others = tyro.cli(command_line(needed), return_unknown_args=True)
        return replace(command, other_words=tuple(others))
    return tyro.cli(command_line(needed), description=_DESCRIPTION)


def command_line(names: Sequence[str] = tuple(COMMANDS)) -> Any:
    """The type that tyro parses the command line with; of the commands, only these are imported.

    Importing all takes seconds. The others are listed, and have no options.
    """
    import tyro

    # Of the docstrings of options, which are indented, it would keep the line breaks of the source. The function is
    # tyro's own: a version without it keeps them.
    if (strings := getattr(tyro, "_strings", None)) is not None:
        strings.remove_single_line_breaks = _in_whole_lines
    classes = {name: _imported(name) if name in names else _listed(name) for name in COMMANDS}
    return Union[tuple(Annotated[made, tyro.conf.subcommand(name)] for name, made in classes.items())]  # noqa: UP007


def named_commands(words: Sequence[str]) -> tuple[str, ...]:
    """The commands that a command line needs: the one that it begins with, or none."""
    return tuple(word for word in words[:1] if word in COMMANDS)


def _in_whole_lines(helptext: str) -> str:
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in helptext.split("\n\n"))


def _imported(name: str) -> type:
    module, class_name, _ = COMMANDS[name]
    return getattr(import_module(f"hsi_sc_nerf.cli.{module}"), class_name)


def _listed(name: str) -> type:
    from dataclasses import make_dataclass

    _, class_name, summary = COMMANDS[name]
    return make_dataclass(class_name, [], namespace={"__doc__": summary})


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
