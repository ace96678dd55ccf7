"""``hsi-sc-nerf process``: raw captures in, packed dataset out."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from hsi_sc_nerf.processing.process import ProcessConfig, process_session


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
