"""``hsi-sc-nerf simulate``: a simulated turntable session with its truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro
from rich.console import Console
from rich.markup import escape

from hsi_sc_nerf.simulate.scene import load_scene, override


@dataclass(frozen=True)
class SimulateCommand:
    """Simulate a turntable session in the camera's file layout, with its truth beside the captures."""

    scene: tyro.conf.Positional[str]
    """pear, apple, maize, pepper, sphere, cylinder, or the path of a scene file (YAML)."""
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
        Console().print(
            f"{escape(str(written))}: {frames} frames of {size_px} x {size_px} pixels x {scene.sensor.bands} bands; "
            f"truth in {escape(str(written / 'truth'))}."
        )
