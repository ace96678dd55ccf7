"""Hyperspectral 3D reconstruction of turntable captures."""

from __future__ import annotations

from typing import Annotated

import tyro

from hsi_sc_nerf.cli.benchmark import BenchmarkCommand
from hsi_sc_nerf.cli.clouds import CompareCommand, TraitsCommand
from hsi_sc_nerf.cli.light import MaterialCommand
from hsi_sc_nerf.cli.sessions import InspectCommand, MarkersCommand, ProcessCommand, SimulateCommand
from hsi_sc_nerf.cli.trained_runs import ExportCommand, RenderCommand, ReportCommand, SampleCommand
from hsi_sc_nerf.cli.workflows import DemoCommand, RunCommand

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
