"""``hsi-sc-nerf simulate``: a turntable capture of a virtual fruit, with its truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.markup import escape

from hsi_sc_nerf.simulate.scene import load_scene, override


@dataclass(frozen=True)
class SimulateCommand:
    """Make a turntable capture of a virtual fruit, as the camera would leave it on disk, with its truth beside it."""

    scene: tyro.conf.Positional[str]
    """pear, apple, maize, pepper, sphere, cylinder, or a scene file of your own (YAML; start from a copy of a shipped
    one)."""
    session: tyro.conf.Positional[Path]
    """Folder to write; new, empty, or an earlier simulated session, which is replaced."""
    frames: int | None = None
    """Images in one full turn, instead of the scene's."""
    size: int | None = None
    """Width and height of the images in pixels, instead of the scene's."""
    bands: int | None = None
    """Number of spectral bands between 397 and 1003 nm, instead of the scene's."""
    seed: int | None = None
    """Grows another fruit of the same kind, instead of the scene's."""
    effects: tuple[str, ...] | None = None
    """Physical effects instead of the scene's: names, or with strengths '{read_noise: {electrons: 40}}'."""

    def main(self) -> None:
        """Run the command.

        Raises:
            InputError: the scene cannot be used or the session cannot be written.
        """
        # Open3D takes seconds to import; the other commands and --help do without it.
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
        Console().print(
            f"{escape(str(written))}: {frames} frames of {size_px} x {size_px} pixels x {scene.sensor.bands} bands; "
            f"truth in {escape(str(written / 'truth'))}."
        )
