"""The findings of a session's processing: logged, collected in one file, and refused if red and not accepted."""

from __future__ import annotations

import logging
from collections.abc import Collection, Sequence
from dataclasses import asdict
from pathlib import Path

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import write_json
from hsi_sc_nerf.findings import INSPECTION_NAME, Finding, refuse_red
from hsi_sc_nerf.inspection.inspect import Inspection

_log = logging.getLogger(__name__)

CHECKS_PATH = Path("report") / INSPECTION_NAME
"""File in the dataset with the inspection's content and the findings of all later steps."""
MAY_BE_RED = (
    *("angles", "binning", "copies", "damaged", "dates", "exposure", "mirrored", "other-object", "paper", "scale"),
    *("turn", "upright", "veil", "white", "white-clipped", "dark", "light-lines", "clipped", "drift", "noise"),
    *("poses-angles", "poses-aspect", "poses-camera", "poses-direction", "poses-scale", "poses-uncertain"),
    *("frames-hull", "frames-light", "frames-slip"),
    *("masks-border", "masks-cut", "masks-empty", "masks-hull", "masks-static", "band-order"),
)
"""Checks whose findings may be red, in their order: of the session, the calibration, the poses and the masks."""


def require_checks(names: Collection[str]) -> None:
    """Refuse names of checks that do not exist.

    Raises:
        InputError: one of ``names`` is no check whose finding may be red.
    """
    unknown = [name for name in names if name not in MAY_BE_RED]
    if unknown:
        raise InputError(f"--accept {unknown[0]}: there is no such check; give one of {', '.join(MAY_BE_RED)}.")


class SessionChecks:
    """Collects the findings of one step after the other.

    Args:
        inspection: inspection of the session before anything was computed; its findings are the first.
        accepted: names of checks whose red findings the user accepts.
        output_dir: the dataset.

    Raises:
        InputError: a finding of the inspection is red and not accepted; nothing is written then.

    Example:
        >>> checks = SessionChecks(inspect_session(session), ["masks-static"], Path("apple_01-data"))
        >>> checks.add(check_calibration(session, calibration))
    """

    def __init__(self, inspection: Inspection, accepted: Collection[str], output_dir: Path) -> None:
        self._report = inspection.report()
        self._findings = list(inspection.findings)
        self._accepted = accepted
        self._path = output_dir / CHECKS_PATH
        self._warn(inspection.findings)
        refuse_red(inspection.findings, accepted)

    def add(self, findings: Sequence[Finding]) -> None:
        """Warn of what is amber or accepted, keep all, and stop at what is red.

        Raises:
            InputError: a finding is red and not accepted, or the file cannot be written.
        """
        self._warn(findings)
        self._findings += findings
        self.write()
        refuse_red(findings, self._accepted)

    def _warn(self, findings: Sequence[Finding]) -> None:
        for finding in findings:
            if finding.level == "amber":
                _log.warning("Warning (%s): %s", finding.name, finding.sentence)
            elif finding.level == "red" and finding.name in self._accepted:
                _log.warning("Accepted (%s): %s", finding.name, finding.sentence)

    def write(self) -> None:
        """Write all findings so far.

        Raises:
            InputError: the file cannot be written.
        """
        write_json(self._path, {**self._report, "findings": [asdict(finding) for finding in self._findings]})
