"""One line for every new capture of a session that is being taken."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hsi_sc_nerf.calibration.detector import DIGITISER_LIMITS
from hsi_sc_nerf.capture.instrument import list_captures
from hsi_sc_nerf.capture.roles import white_name
from hsi_sc_nerf.capture.session import Capture, open_captures
from hsi_sc_nerf.capture.session_info import SESSION_INFO_NAME, SessionInfo, read_session_info
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.inspection.capture_checks import BLURRED, DARK_RED, SATURATED_RED, acquisition_day
from hsi_sc_nerf.inspection.quicklook import Quicklook, quicklook_of, white_counts
from hsi_sc_nerf.poses.marker_detection import detect_markers, find_dictionary

FEWEST_TO_COMPARE = 3
"""With fewer captures before it, sharpness and markers of a capture are not judged."""


class Watch:
    """Follows a session's folder while captures are added to it.

    Args:
        path: the session's folder; it may be empty.

    Attributes:
        captures: names of the captures that were reported.
        flagged: names of those with a fault.
        incomplete: why other captures cannot be read, by name.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.captures: set[str] = set()
        self.flagged: list[str] = []
        self.incomplete: dict[str, str] = {}
        self._quicklooks: list[Quicklook] = []
        self._markers: list[int] = []
        self._reported: set[str] = set()
        self._info = SessionInfo()
        self._first: Capture | None = None
        self._with_dark = False
        self._dictionary: str | None = None

    def new_lines(self) -> list[str]:
        """A line for each capture that is complete and was not before.

        A capture whose data file is shorter than its header states is still being written, and is read later. It is
        reported if a later capture is complete, and so is a ``session.json`` or folder that cannot be used.
        """
        waited_for, self.incomplete = self.incomplete, {}
        lines = []
        try:
            self._info = read_session_info(self.path / SESSION_INFO_NAME)
            found = list_captures(self.path).captures
            unseen = [files for files in found if files.name not in self.captures]
            opened = {c.name: c for c in open_captures(unseen, self._info, self.path, self.incomplete)}
        except (InputError, OSError) as error:
            self.incomplete = waited_for
            return self._once(str(error))
        white = white_name(self._info, [files.name for files in found]).lower()
        # A SPECIM IQ writes it beside the counts.
        self._with_dark = self._with_dark or any(capture.dark is not None for capture in opened.values())
        for files in (files for files in unseen if files.name in opened):
            if self._with_dark and opened[files.name].has_counts and opened[files.name].dark is None:
                self.incomplete[files.name] = "its dark cube is missing"
                continue
            self.captures.add(files.name)
            lines.append(self._line(opened[files.name], files.name.lower() == white))
        for name in self.incomplete if lines else ():
            if name in waited_for:
                lines += self._once(f"{name}: NOT COMPLETE, {self.incomplete[name]}")
        return lines

    def _once(self, line: str) -> list[str]:
        """The line, unless it was reported before."""
        reported = line in self._reported
        self._reported.add(line)
        return [] if reported else [line]

    def _line(self, capture: Capture, is_white: bool) -> str:
        quicklook = quicklook_of(capture, white_counts(capture))
        saturated = float(quicklook.at_top_fraction.mean()) if quicklook.top_counts in DIGITISER_LIMITS else 0.0
        dark = float(quicklook.dark_fraction.mean())
        parts = [f"saturated {100.0 * saturated:.1f} %", f"dark {100.0 * dark:.1f} %"]
        faults = []
        if saturated > SATURATED_RED:
            faults.append("overexposed")
        if dark > DARK_RED:
            faults.append("too dark")
        if self._first is not None:
            # A white may have other lines and samples.
            size, usual = (other.cube.shape[2 if is_white else 0 :] for other in (capture, self._first))
            if size != usual:
                faults.append(f"size {size} is not {usual}")
            if acquisition_day(capture) != acquisition_day(self._first):
                faults.append(f"taken on {acquisition_day(capture)}, not {acquisition_day(self._first)}")
        if not is_white:
            self._first = self._first or capture
            faults += self._compare(quicklook)
            parts += [f"sharpness {quicklook.sharpness_per_px:.3f}/px", f"markers {self._markers[-1]}"]
        if faults:
            self.flagged.append(capture.name)
        return f"{capture.name}: {', '.join(parts)}; {', '.join(faults).upper() if faults else 'ok'}"

    def _compare(self, quicklook: Quicklook) -> list[str]:
        """What is wrong with a frame beside those before it."""
        faults = []
        stated = self._info.marker_dictionary
        self._dictionary = stated or self._dictionary or find_dictionary([quicklook.gray])
        markers = 0 if self._dictionary is None else len(detect_markers(quicklook.gray, self._dictionary))
        if len(self._quicklooks) >= FEWEST_TO_COMPARE:
            if quicklook.sharpness_per_px < BLURRED * np.median([q.sharpness_per_px for q in self._quicklooks]):
                faults.append("less sharp than before")
            if markers == 0 and np.median(self._markers) >= 1.0:
                faults.append("no markers")
        if any(quicklook.digest == other.digest for other in self._quicklooks):
            faults.append("a copy of an earlier capture")
        self._quicklooks.append(quicklook)
        self._markers.append(markers)
        return faults
