"""Commands on sessions: ``simulate``, ``markers``, ``inspect``, ``process``."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console
from rich.markup import escape

from hsi_sc_nerf import paper as published
from hsi_sc_nerf.capture.session import open_session
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import require_writable, write_json
from hsi_sc_nerf.findings import INSPECTION_NAME
from hsi_sc_nerf.inspection.inspect import Inspection, draw_inspection, inspect_session, suggestion
from hsi_sc_nerf.inspection.watch import Watch
from hsi_sc_nerf.packed.dataset import is_packed, open_packed
from hsi_sc_nerf.processing.effects import show_effects
from hsi_sc_nerf.processing.process import ProcessConfig, process_session
from hsi_sc_nerf.settings_file import between, check_options
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.terminal import screen_table

POLL_S = 2.0
"""A folder that is watched is looked at so often."""


@dataclass(frozen=True)
class SimulateCommand:
    """Simulate a turntable session in the camera's file layout, with its truth beside the captures."""

    scene: tyro.conf.Positional[str]
    """pear, apple, maize, tomato, pepper, sphere, cylinder, or the path of a scene file (YAML)."""
    session: tyro.conf.Positional[Path]
    """Folder to write: new, empty, or an earlier simulated session, which is replaced."""
    frames: int | None = None
    """Frames in one full turn; the scene's by default."""
    size: int | None = None
    """Width and height of the images in pixels; the scene's by default."""
    bands: int | None = None
    """Number of spectral bands between 397 and 1003 nm; the scene's by default."""
    seed: int | None = None
    """Seed of all random numbers; another seed gives another fruit of the same kind."""
    effects: tuple[str, ...] | None = None
    """Effects in place of the scene's: names, or names with settings like '{read_noise: {electrons: 40}}'."""

    def main(self) -> None:
        """Run the command.

        Raises:
            InputError: the scene cannot be used or the session cannot be written.
        """
        # Deferred because Open3D takes seconds to import.
        from hsi_sc_nerf.simulate.session import simulate_session
        from hsi_sc_nerf.simulate.truth import load_truth

        scene = override(
            load_scene(self.scene),
            frames=self.frames,
            size_px=self.size,
            bands=self.bands,
            seed=self.seed,
            effects=self.effects,
        )
        written = simulate_session(scene, self.session)
        size_px, frames = scene.camera.size_px, len(load_truth(written).captures)
        Console(soft_wrap=True).print(
            f"{escape(str(written))}: {frames} frames of {size_px} x {size_px} pixels x {scene.sensor.bands} bands; "
            f"truth in {escape(str(written / 'truth'))}."
        )


@dataclass(frozen=True)
class MarkersCommand:
    """Write ArUco markers to print, each with its number and size, and a ruler of 100 mm to check the print.

    Print at 100 %, not fitted to the page, on matt paper, and measure the ruler.
    """

    output: Path = Path("markers.pdf")
    """The PDF file to write."""
    marker_side_m: float = between(0.005, 0.15, default=0.02)
    """Side of a marker's black square, metres, as in session.json."""
    marker_dictionary: str = "DICT_5X5_50"
    """OpenCV's name of the markers' dictionary, as in session.json."""
    count: int = between(1, 1000, default=published.CONTAINER_MARKERS + published.DISC_MARKERS)
    """Number of markers. They are numbered from 0; no number may be used twice on one turntable."""
    paper: Literal["a4", "letter"] = "a4"
    """Size of the sheets."""

    def main(self) -> None:
        """Run the command.

        Raises:
            InputError: there are no such markers, one does not fit on a sheet, or the file cannot be written.
        """
        check_options(self)
        from hsi_sc_nerf.poses.marker_sheet import marker_sheets, write_marker_sheets

        sheets = marker_sheets(self.marker_side_m, self.marker_dictionary, range(self.count), self.paper)
        write_marker_sheets(self.output, sheets)
        console = Console(soft_wrap=True)
        number = "1 sheet" if len(sheets) == 1 else f"{len(sheets)} sheets"
        console.print(f"{escape(str(self.output))}: {self.count} markers on {number}.")
        console.print(
            f'Print at 100 %, measure the ruler, and give "marker_side_m": {self.marker_side_m:g} in session.json.'
        )


@dataclass(frozen=True)
class InspectCommand:
    """Check a session in seconds, before anything is computed from it.

    Prints a table of findings: green is as it should be, amber is worth a look, red would spoil the results. Exits
    with status 2 if something is red. Of a processed dataset, prints the effects that the session has.
    """

    session: tyro.conf.Positional[Path]
    """Folder of the capture session, or of a dataset that `process` made of it."""
    output_dir: Path | None = None
    """Folder to write inspection.json and inspection.png to."""
    exclude: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Name of a capture to leave out; may be given several times."""
    watch: bool = False
    """Print a line for every new capture until Ctrl-C."""

    def main(self) -> None:
        """Run the command.

        Raises:
            InputError: the session cannot be used, or a finding is red.
        """
        console = Console()
        if (self.watch or is_packed(self.session)) and (self.output_dir is not None or self.exclude):
            raise InputError("--output-dir and --exclude are for a session without --watch; leave them out.")
        if self.watch:
            self._watch(console)
            return
        if is_packed(self.session):
            dataset = open_packed(self.session)
            if not dataset.effects:
                raise InputError(
                    f"{self.session}: was processed by an older version, which did not look for effects; process the "
                    "session again."
                )
            show_effects(console, dataset.effects)
            picture = f"{dataset.root / 'report' / 'effects.png'} shows the evidence over the thresholds."
            console.print(picture, highlight=False, markup=False, soft_wrap=True)
            return
        if self.output_dir is not None:
            require_writable(self.output_dir)
        session = open_session(self.session, exclude=self.exclude, skip_damaged=True)
        inspection = inspect_session(session)
        show_findings(console, inspection)
        if self.output_dir is not None:
            write_json(self.output_dir / INSPECTION_NAME, inspection.report())
            draw_inspection(inspection, self.output_dir / "inspection.png")
            written = f"{self.output_dir}: inspection.json and inspection.png are written."
            console.print(written, highlight=False, markup=False, soft_wrap=True)
        red = [finding.sentence for finding in inspection.findings if finding.level == "red"]
        if red:
            raise InputError(" ".join(red))

    def _watch(self, console: Console) -> None:
        if not self.session.is_dir():
            raise InputError(f"{self.session}: there is no such folder to watch; check the path.")
        watch = Watch(self.session)
        console.print(f"Watching {self.session}; Ctrl-C ends.", highlight=False, markup=False, soft_wrap=True)
        try:
            while True:
                for line in watch.new_lines():
                    console.print(line, highlight=False, markup=False, soft_wrap=True)
                time.sleep(POLL_S)
        except KeyboardInterrupt:
            flagged = f"look at {', '.join(watch.flagged)}" if watch.flagged else "nothing is wrong with them"
            waiting = f"; not complete: {', '.join(watch.incomplete)}" if watch.incomplete else ""
            told = f"{len(watch.captures)} captures; {flagged}{waiting}."
            console.print(told, highlight=False, markup=False, soft_wrap=True)


def show_findings(console: Console, inspection: Inspection) -> None:
    """Print the table of findings, and a ``session.json`` to copy if the session has none."""
    colours = {"green": "green", "amber": "yellow", "red": "bold red"}
    rows = [
        [f"[{colours[f.level]}]{f.level}[/{colours[f.level]}]", f.name, escape(f.sentence)]
        for f in inspection.findings
    ]
    console.print(screen_table(["level", "check", "finding"], rows, title=escape(str(inspection.session.path))))
    if not inspection.session.info_path.is_file():
        content = suggestion(inspection.session, inspection.session_json)
        console.print(content, highlight=False, markup=False, soft_wrap=True)  # a broken line would be no JSON


@dataclass(frozen=True)
class ProcessCommand:
    """Calibrate the captures of a turntable session, estimate poses and masks, and pack the frames for training.

    An interrupted run continues where it stopped. Results of the same session and settings are reused.
    """

    session: tyro.conf.Positional[Path]
    """Folder of the capture session."""
    output_dir: Path
    """Folder to write the dataset to."""
    config: Annotated[ProcessConfig, tyro.conf.arg(name="")] = field(default_factory=ProcessConfig)
    """Settings; the defaults are the paper's where it prints them."""

    def main(self) -> None:
        """Run the command.

        Raises:
            InputError: the session cannot be used or the dataset cannot be written.
        """
        process_session(self.session, self.output_dir, self.config)
