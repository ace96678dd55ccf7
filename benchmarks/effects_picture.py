"""Contact sheet of pseudo-RGB images: one frame of a scene without effects and with each of several effects.

uv run python benchmarks/effects_picture.py --output docs/images/effects.png
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import tyro
from rich.progress import track

from hsi_sc_nerf import paper
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.simulate.scene import load_scene, override
from hsi_sc_nerf.spectra.pseudo_rgb import nearest_bands

SHOWN = (
    "chamber_shading",
    "inter_reflection",
    "translucency",
    "lamp",
    "gloss",
    "textured_background",
    "illumination_falloff",
    "axis_tilt",
    "lens_distortion",
    "optical_blur",
    "bad_pixels",
)


@dataclass(frozen=True)
class EffectsPicture:
    """Draw one frame under each effect."""

    output: Path
    """PNG to write."""
    scene: str = "apple"
    """Scene to draw."""
    effects: tuple[str, ...] = SHOWN
    """Effects to draw, each alone."""
    size: int = 256
    """Width and height of an image, pixels."""
    columns: int = 4
    """Images in a row."""

    def main(self) -> None:
        """Render and draw."""
        named = [(), *((effect,) for effect in self.effects)]
        rows = -(-len(named) // self.columns)
        figure, axes = plt.subplots(rows, self.columns, figsize=(2.2 * self.columns, 2.4 * rows))
        for ax in axes.ravel():
            ax.axis("off")
        for ax, effects in zip(axes.ravel(), track(named, "rendering"), strict=False):
            scene = override(load_scene(self.scene), frames=1, size_px=self.size, bands=61, effects=effects)
            simulation = Simulation(scene)
            frame, white = simulation.frame(0), simulation.white()
            bands = nearest_bands(simulation.wavelengths_nm, paper.PSEUDO_RGB_NM)
            signal = np.percentile(white.counts[..., bands], 95, axis=(0, 1)) - scene.sensor.dark_level
            ax.imshow(((frame.counts[..., bands] - float(scene.sensor.dark_level)) / signal).clip(0, 1))
            ax.set_title(effects[0] if effects else "no effects", fontsize=8)
        figure.tight_layout()
        figure.savefig(self.output, dpi=110)


if __name__ == "__main__":
    tyro.cli(EffectsPicture).main()
