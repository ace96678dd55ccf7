"""``hsi-sc-nerf inspect``: is a session worth processing, and is a capture that was just taken worth keeping?"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.markup import escape

from hsi_sc_nerf.capture.session import open_session
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import write_json
from hsi_sc_nerf.inspection.inspect import INSPECTION_NAME, Inspection, draw_inspection, inspect_session, suggestion
from hsi_sc_nerf.inspection.watch import Watch
from hsi_sc_nerf.terminal import screen_table

POLL_S = 2.0
"""A folder that is watched is looked at so often."""


@dataclass(frozen=True)
class InspectCommand:
    """Check a session in seconds, before anything is computed from it.

    Prints a table of findings: green is as it should be, amber is worth a look, red would spoil the results. Exits
    with status 2 if something is red.
    """

    session: tyro.conf.Positional[Path]
    """Folder of the capture session."""
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
        if self.watch:
            self._watch(console)
            return
        session = open_session(self.session, exclude=self.exclude, skip_damaged=True)
        inspection = inspect_session(session)
        show_findings(console, inspection)
        if self.output_dir is not None:
            write_json(self.output_dir / INSPECTION_NAME, inspection.report())
            draw_inspection(inspection, self.output_dir / "inspection.png")
            console.print(f"{self.output_dir}: inspection.json and inspection.png are written.", highlight=False)
        red = [finding.sentence for finding in inspection.findings if finding.level == "red"]
        if red:
            raise InputError(" ".join(red))

    def _watch(self, console: Console) -> None:
        if not self.session.is_dir():
            raise InputError(f"{self.session}: there is no such folder to watch; check the path.")
        watch = Watch(self.session)
        console.print(f"Watching {self.session}; Ctrl-C ends.", highlight=False)
        try:
            while True:
                for line in watch.new_lines():
                    console.print(escape(line), highlight=False)
                time.sleep(POLL_S)
        except KeyboardInterrupt:
            flagged = f"look at {', '.join(watch.flagged)}" if watch.flagged else "nothing is wrong with them"
            console.print(f"{watch.captures} captures; {flagged}.", highlight=False)


def show_findings(console: Console, inspection: Inspection) -> None:
    """Print the table of findings, and a ``session.json`` to copy if the session has none."""
    colours = {"green": "green", "amber": "yellow", "red": "bold red"}
    rows = [
        [f"[{colours[f.level]}]{f.level}[/{colours[f.level]}]", f.name, escape(f.sentence)]
        for f in inspection.findings
    ]
    console.print(screen_table(["level", "check", "finding"], rows, title=str(inspection.session.path)))
    if not inspection.session.info_path.is_file():
        console.print(suggestion(inspection.session, inspection.session_json), highlight=False, markup=False)
