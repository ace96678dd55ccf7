"""Hyperspectral 3D reconstruction of turntable captures."""

from __future__ import annotations

import sys
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.markup import escape

from hsi_sc_nerf.cli.benchmark import BenchmarkCommand
from hsi_sc_nerf.cli.clouds import CompareCommand, TraitsCommand
from hsi_sc_nerf.cli.light import MaterialCommand
from hsi_sc_nerf.cli.sessions import InspectCommand, MarkersCommand, ProcessCommand, SimulateCommand
from hsi_sc_nerf.cli.trained_runs import ExportCommand, RenderCommand, ReportCommand, SampleCommand
from hsi_sc_nerf.cli.workflows import DemoCommand, RunCommand
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.terminal import ignore_library_warnings

Commands = (
    Annotated[DemoCommand, tyro.conf.subcommand("demo")]
    | Annotated[SimulateCommand, tyro.conf.subcommand("simulate")]
    | Annotated[RunCommand, tyro.conf.subcommand("run")]
    | Annotated[MarkersCommand, tyro.conf.subcommand("markers")]
    | Annotated[InspectCommand, tyro.conf.subcommand("inspect")]
    | Annotated[ProcessCommand, tyro.conf.subcommand("process")]
    | Annotated[ExportCommand, tyro.conf.subcommand("export")]
    | Annotated[SampleCommand, tyro.conf.subcommand("sample")]
    | Annotated[MaterialCommand, tyro.conf.subcommand("material")]
    | Annotated[RenderCommand, tyro.conf.subcommand("render")]
    | Annotated[CompareCommand, tyro.conf.subcommand("compare")]
    | Annotated[TraitsCommand, tyro.conf.subcommand("traits")]
    | Annotated[ReportCommand, tyro.conf.subcommand("report")]
    | Annotated[BenchmarkCommand, tyro.conf.subcommand("benchmark")]
)


def main() -> None:
    """Run the command of the command line; invalid input exits with one sentence and status 2, Ctrl-C with 130."""
    ignore_library_warnings()
    command: Any = None
    try:
        # Reading the options can already raise InputError.
        command = tyro.cli(Commands, description=__doc__)
        command.main()
    except InputError as error:
        Console(stderr=True).print(f"[bold red]Error:[/bold red] {escape(str(error))}", soft_wrap=True)
        sys.exit(2)
    except KeyboardInterrupt:
        goes_on = isinstance(command, ProcessCommand | RunCommand)
        hint = "; the same command goes on where it stopped" if goes_on else ""
        Console(stderr=True).print(f"Stopped{hint}.", soft_wrap=True)
        sys.exit(130)


if __name__ == "__main__":
    main()
