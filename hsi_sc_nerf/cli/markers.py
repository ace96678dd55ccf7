"""``hsi-sc-nerf markers``: markers to print."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.markup import escape

from hsi_sc_nerf import paper as published
from hsi_sc_nerf.settings_file import between, check_options


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
        console = Console()
        console.print(f"{escape(str(self.output))}: {self.count} markers on {len(sheets)} sheets.", soft_wrap=True)
        console.print(
            f'Print at 100 %, measure the ruler, and give "marker_side_m": {self.marker_side_m:g} in session.json.',
            soft_wrap=True,
        )
