"""Foreground masks of simulated sessions with hard backgrounds and objects, against the truth, as a table.

    uv run python benchmarks/mask_cases.py

A mask is wrong where its intersection over union (IoU) with the true object pixels is below 0.95. A wrong mask must
come with a red finding.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.simulate.effects.image import TexturedBackground
from hsi_sc_nerf.simulate.materials import Material, Plain, PlantTissue
from hsi_sc_nerf.simulate.scene import Scene, Sphere, load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session

NOISE = ("photon_noise", "read_noise")
SHADE = ("chamber_shading", "inter_reflection", *NOISE)
WALL = ("textured_background", *NOISE)
DARK_FRUIT: dict[str, Material] = {
    "apple_skin": PlantTissue(0.22, chlorophyll=0.6, anthocyanin=1.0, brown=0.5, water=0.08),
    "apple_blush": PlantTissue(0.20, chlorophyll=0.6, anthocyanin=1.3, brown=0.6, water=0.08),
    "container_plastic": Plain(0.06, slope_per_um=0.05),
}
WHITE_FRUIT: dict[str, Material] = {
    "apple_skin": PlantTissue(0.88, carotenoid=0.06, brown=0.03, water=0.04),
    "apple_blush": PlantTissue(0.86, carotenoid=0.08, brown=0.04, water=0.04),
    "container_plastic": Plain(0.90, slope_per_um=0.05, blue_loss=0.12),
}


@dataclass(frozen=True)
class PatternedWall(TexturedBackground):
    """A wall of equal tiles of two colours: it looks the same wherever a tile is looked at."""

    name: ClassVar[str] = "patterned_wall"
    tiles: int = 16

    def cover(
        self, size_px: int, materials: tuple[str, ...], rng: np.random.Generator
    ) -> Float[np.ndarray, "lines samples materials"]:
        """Fractions of ``materials`` in each pixel of the wall: a chessboard of wood and blue paint."""
        tile = np.arange(size_px) * self.tiles // size_px
        blue = (tile[:, None] + tile) % 2
        fractions = np.zeros((size_px, size_px, len(materials)))
        fractions[..., materials.index("plywood")] = 1 - blue
        fractions[..., materials.index("blue_paint")] = blue
        return fractions


def _scene(name: str, *effects: str, own: dict[str, Material] | None = None, seed: int | None = None) -> Scene:
    scene = override(load_scene(name), frames=24, size_px=128, bands=48, effects=effects, seed=seed)
    return replace(scene, materials=own or {})


def _on(wall: TexturedBackground, scene: Scene) -> Scene:
    return replace(scene, effects=(wall, *scene.effects))


SCENES: dict[str, Scene] = {
    "pear": _scene("pear", *NOISE),
    "apple in uneven light": _scene("apple", *SHADE),
    "maize": _scene("maize", *NOISE),
    "pear, textured wall": _scene("pear", *WALL),
    "apple in uneven light, textured wall": _scene("apple", "textured_background", *SHADE),
    "maize, textured wall": _scene("maize", *WALL),
    "pear, patterned wall": _on(PatternedWall(), _scene("pear", *NOISE)),
    "apple, patterned wall": _on(PatternedWall(), _scene("apple", *NOISE)),
    "dark apple, dark lid": _scene("apple", *NOISE, own=DARK_FRUIT),
    "dark apple, dark lid, uneven light": _scene("apple", *SHADE, own=DARK_FRUIT),
    "white apple, white lid": _scene("apple", *NOISE, own=WHITE_FRUIT),
    "white apple, white lid, uneven light": _scene("apple", *SHADE, own=WHITE_FRUIT),
    "dark apple, dark lid, textured wall": _scene("apple", *WALL, own=DARK_FRUIT),
    "smooth green sphere, textured wall": replace(
        _scene("sphere", *WALL), object=Sphere("sphere", 0.08, "pear_skin")
    ),
}
if __name__ == "__main__":
    for name, scene in SCENES.items():
        out = Path("/tmp/masks/sessions") / name.replace(" ", "_").replace(",", "")
        if not out.exists():
            simulate_session(scene, out, progress=False)
            print(name, flush=True)
    simulate_session(_scene("pear", *NOISE, seed=2), "/tmp/masks/sessions/other_pear", progress=False)
