"""`hsi-sc-nerf simulate SCENE SESSION`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session


def simulate(
    scene: tyro.conf.Positional[str],
    session: tyro.conf.Positional[Path],
    frames: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    size: Annotated[int | None, tyro.conf.arg(metavar="PX")] = None,
    bands: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    seed: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
) -> None:
    """Make a turntable capture of a virtual fruit, as the camera would leave it on disk, with its truth beside it.

    Args:
        scene: pear, apple or maize, or a scene file of your own (YAML; start from a copy of a shipped one).
        session: folder to write; new, empty, or an earlier simulated session, which is replaced.
        frames: images in one full turn, instead of the scene's.
        size: width and height of the images in pixels, instead of the scene's.
        bands: number of spectral bands between 397 and 1003 nm, instead of the scene's.
        seed: grows another fruit of the same kind, instead of the scene's.
    """
    chosen = override(load_scene(scene), frames=frames, size_px=size, bands=bands, seed=seed)
    written = simulate_session(chosen, session)
    Console().print(
        f"{written}: {chosen.turntable.frames} frames of {chosen.camera.size_px} x {chosen.camera.size_px} pixels x "
        f"{chosen.sensor.bands} bands; truth in {written / 'truth'}."
    )
