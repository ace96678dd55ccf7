"""How good poses without markers are, object by object, on simulated sessions with known truth, as a table.

    uv run python benchmarks/poses_by_object.py --page docs/poses.md

No marker is in the pictures, not even as texture. Printed are the largest errors over the posed frames of the
camera's rotation and place, after the similarity that suits the places best (features tell no scale), the error of
the focal length, the time, and what the report warns of. COLMAP is told nothing, so that it cannot fall back to known
angles.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from page import write_table
from pose_hard_cases import Case, grey_images, scene_of
from poses_speed import pose_errors
from rich.console import Console
from rich.table import Table

from hsi_sc_nerf.capture.session_info import SessionInfo
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.poses.pose_methods import find_poses
from hsi_sc_nerf.poses.report import pose_report
from hsi_sc_nerf.simulate.frames import Simulation

TABLE = "by object table"
COLUMNS = (
    "object",
    "method",
    "frames",
    "rotation, deg",
    "place, mm",
    "focal, %",
    "reprojection, px",
    "time, s",
    "warnings",
)
NO_MARKERS: dict[str, dict[str, float]] = {"markers": {"on_container": 0, "on_disc": 0}}
# Every session without markers has these; they tell nothing of the object.
SAID_ANYWAY = ("nothing gives the scale", "no marker lies on the disc")


@dataclass(frozen=True)
class PosesByObject:
    """Measure poses without markers, object by object."""

    objects: tuple[str, ...] = ("pear", "apple", "maize")
    """What stands on the turntable: scenes of the simulator."""
    methods: tuple[Literal["colmap", "angles"], ...] = ("colmap", "angles")
    """How poses are found."""
    frames: int = 60
    """Frames in the turn."""
    size: int = 512
    """Width and height of the images, pixels."""
    effects: tuple[str, ...] = ("textured_background",)
    """Of the simulator."""
    page: Path | None = None
    """Markdown page whose table is replaced."""

    def main(self) -> None:
        """Measure, print the table, write it into the page."""
        rows, console = [], Console(width=170)
        for name in self.objects:
            simulation = Simulation(scene_of(Case(self.effects, name, self.frames, changes=NO_MARKERS), self.size))
            images = grey_images(simulation)
            for method in self.methods:
                rows.append((name, method, *measured(method, images, simulation)))
                console.print(" | ".join(rows[-1]), highlight=False)
        shown = Table(*COLUMNS)
        for cells in rows:
            shown.add_row(*cells)
        console.print(shown)
        if self.page is not None:
            write_table(self.page, TABLE, COLUMNS, rows)


def measured(method: Literal["colmap", "angles"], images, simulation: Simulation) -> tuple[str, ...]:
    """The cells of a row behind its object and method."""
    plan = simulation.plan
    info = SessionInfo()
    if method == "angles":
        info = SessionInfo(nominal_step_deg=plan.nominal_step_deg, direction=plan.direction)
    started = time.perf_counter()
    try:
        poses = find_poses(images, simulation.captures, info, method, progress=False)
    except InputError as error:
        return "0", "", "", "", "", f"{time.perf_counter() - started:.0f}", f"refused: {error}"
    seconds = time.perf_counter() - started
    used = poses.used
    rotation_deg, place_mm = pose_errors(poses.camera_to_world[used], simulation.camera_to_world[used], False)
    warnings = [w for w in pose_report(poses)["warnings"] if not w.startswith(SAID_ANYWAY)]
    return (
        f"{used.sum()} of {len(used)}",
        f"{rotation_deg:.3f}",
        f"{place_mm:.2f}",
        f"{100.0 * (poses.intrinsics.fl_x / simulation.intrinsics.fl_x - 1.0):+.2f}",
        f"{poses.overall_error_px:.3f}",
        f"{seconds:.0f}",
        "; ".join(warnings),
    )


if __name__ == "__main__":
    tyro.cli(PosesByObject).main()
