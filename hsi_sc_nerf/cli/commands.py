"""Hyperspectral 3D reconstruction of turntable captures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import make_dataclass
from importlib import import_module
from typing import Annotated, Any, NamedTuple, Union

import tyro


class Command(NamedTuple):
    """Where a command is, and what the list of commands says of it."""

    module: str
    class_name: str
    summary: str


COMMANDS = {
    "demo": Command("workflows", "DemoCommand", "Simulate, reconstruct and judge a fruit: try this first."),
    "simulate": Command("sessions", "SimulateCommand", "Simulate a turntable session, with its truth."),
    "run": Command("workflows", "RunCommand", "Do all steps from a capture session to traits and a report."),
    "batch": Command("batch", "BatchCommand", "Do all steps on many sessions, here or on a cluster."),
    "markers": Command("sessions", "MarkersCommand", "Write ArUco markers to print."),
    "inspect": Command("sessions", "InspectCommand", "Check a session in seconds, before you process it."),
    "process": Command("sessions", "ProcessCommand", "Calibrate captures, estimate poses and masks, pack a dataset."),
    "export": Command("trained_runs", "ExportCommand", "Write the spectral point cloud of a trained run."),
    "sample": Command("trained_runs", "SampleCommand", "Add spectra of a trained run to the points of a PLY file."),
    "material": Command("light", "MaterialCommand", "Tell the material's reflectance apart from the light on it."),
    "render": Command("trained_runs", "RenderCommand", "Render views of a trained run as ENVI cubes and videos."),
    "compare": Command("clouds", "CompareCommand", "Compare a cloud or mesh with a reference: F-score, distances."),
    "traits": Command("clouds", "TraitsCommand", "Measure sizes, spectra, indices and classes on a cloud."),
    "change": Command("change", "ChangeCommand", "Find what changed on an object between days, beyond noise."),
    "report": Command("trained_runs", "ReportCommand", "Write one HTML file on a trained run."),
    "collect": Command("batch", "CollectCommand", "Write one table and one page of all objects of a batch."),
    "benchmark": Command("benchmark", "BenchmarkCommand", "Compare configurations by accuracy over training time."),
}
"""The commands, in the order in which the help lists them."""


def command_line(names: Sequence[str] = tuple(COMMANDS)) -> Any:
    """The type that tyro parses the command line with; of the commands, only these are imported.

    Importing all takes seconds. The others are listed, and have no options.
    """
    classes = {name: _imported(name) if name in names else _listed(name) for name in COMMANDS}
    return Union[tuple(Annotated[made, tyro.conf.subcommand(name)] for name, made in classes.items())]  # noqa: UP007


def named_commands(words: Sequence[str]) -> tuple[str, ...]:
    """The commands that a command line needs: the one that it begins with, or none."""
    return tuple(word for word in words[:1] if word in COMMANDS)


def _imported(name: str) -> type:
    entry = COMMANDS[name]
    return getattr(import_module(f"hsi_sc_nerf.cli.{entry.module}"), entry.class_name)


def _listed(name: str) -> type:
    return make_dataclass(COMMANDS[name].class_name, [], namespace={"__doc__": COMMANDS[name].summary})
