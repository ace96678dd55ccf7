"""Foreground masks of simulated sessions with hard backgrounds and objects, against the truth, as a table.

    uv run python benchmarks/mask_cases.py
    uv run python benchmarks/mask_cases.py --size-px 96 --scenes pear maize

A mask is wrong where its intersection over union (IoU) with the true object pixels is below 0.95; then the session
must be refused. How far the outline lies outside (inside: negative) of the object is the difference of the areas of
masks and object over the number of pixels along the outline.
"""

from __future__ import annotations

import re
import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import tyro
from jaxtyping import Bool, Float
from results_table import Benchmark, write_results
from rich.progress import track

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.morphology import beside
from hsi_sc_nerf.processing.process import ProcessConfig, process_session
from hsi_sc_nerf.simulate.effects.image import TexturedBackground
from hsi_sc_nerf.simulate.materials import Material, Plain, PlantTissue
from hsi_sc_nerf.simulate.scene import Scene, Sphere, load_scene, override
from hsi_sc_nerf.simulate.session import simulate_session
from hsi_sc_nerf.simulate.truth import COVERED, load_truth

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


@dataclass(frozen=True)
class Poster(TexturedBackground):
    """A white wall with a poster of leaves behind the object only: it differs from a plant only by standing still."""

    name: ClassVar[str] = "poster"
    materials: ClassVar[tuple[str, ...]] = ("husk",)

    def cover(
        self, size_px: int, materials: tuple[str, ...], rng: np.random.Generator
    ) -> Float[np.ndarray, "lines samples materials"]:
        """Fractions of ``materials`` in each pixel of the wall: husk in a rectangle, white elsewhere."""
        line, sample = np.mgrid[:size_px, :size_px] / size_px
        poster = (line > 0.05) & (line < 0.3) & (sample > 0.4) & (sample < 0.65)
        fractions = np.zeros((size_px, size_px, len(materials)))
        fractions[..., materials.index("husk")] = poster
        fractions[..., -1] = ~poster
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
    "pear in uneven light, textured wall": _scene("pear", "textured_background", *SHADE),
    "apple in uneven light, textured wall": _scene("apple", "textured_background", *SHADE),
    "maize, textured wall": _scene("maize", *WALL),
    "pear, patterned wall": _on(PatternedWall(), _scene("pear", *NOISE)),
    "apple, patterned wall": _on(PatternedWall(), _scene("apple", *NOISE)),
    "pear, poster of leaves behind it": _on(Poster(), _scene("pear", *NOISE)),
    "dark apple, dark lid": _scene("apple", *NOISE, own=DARK_FRUIT),
    "dark apple, dark lid, uneven light": _scene("apple", *SHADE, own=DARK_FRUIT),
    "white apple, white lid": _scene("apple", *NOISE, own=WHITE_FRUIT),
    "white apple, white lid, uneven light": _scene("apple", *SHADE, own=WHITE_FRUIT),
    "dark apple, dark lid, textured wall": _scene("apple", *WALL, own=DARK_FRUIT),
    "tomato before a lamp": _scene("tomato", "lamp", *SHADE),
    "glossy tomato before a lamp": _scene("tomato", "lamp", "gloss", *NOISE),
    "smooth green sphere, textured wall": replace(
        _scene("sphere", *WALL), object=Sphere("sphere", 0.08, "pear_skin")
    ),
}
MIXED = "pear, two frames of another pear"
SWAPPED = (5, 12)
LOWEST = 0.1
"""Part of the object's height in the image where it stands on the lid."""
COLUMNS = ["session", "size, px", "IoU, lowest", "IoU, median", "outline, px", "of the lowest tenth, px"]
COLUMNS += ["refused because of"]


@dataclass(frozen=True)
class MaskCases(Benchmark):
    """Measure foreground masks of simulated sessions."""

    scenes: tuple[str, ...] = (*SCENES, MIXED)
    """Sessions to measure; rows of the others are kept."""
    size_px: int = 128
    """Width and height of the frames, pixels."""

    def main(self) -> None:
        """Measure, print and write row by row."""
        with tempfile.TemporaryDirectory(prefix="mask-cases-") as folder:
            for number, name in enumerate(track(self.scenes, "masks")):
                session, data = Path(folder) / f"session_{number}", Path(folder) / f"data_{number}"
                scene = override(SCENES["pear" if name == MIXED else name], size_px=self.size_px)
                simulate_session(scene, session, progress=False)
                if name == MIXED:
                    _swap_frames(session, Path(folder) / "other", self.size_px)
                row = [name, str(self.size_px), *_cells(session, data, name == MIXED)]
                write_results("mask_cases", COLUMNS, [row], keys=2, folder=self.results)
                shutil.rmtree(session)
                shutil.rmtree(data, ignore_errors=True)


def _swap_frames(session: Path, other: Path, size_px: int) -> None:
    """Replace two captures by those of another pear at the same angles."""
    simulate_session(override(SCENES["pear"], seed=2, size_px=size_px), other, progress=False)
    for number in SWAPPED:
        name = f"pear_{number:03d}"
        shutil.rmtree(session / name)
        shutil.copytree(other / name, session / name)


def _cells(session: Path, data: Path, mixed: bool) -> list[str]:
    """Smallest and median IoU, offsets of the outline, and the names of the checks that refused the session."""
    # The check of the masks is measured, not the one of the raw captures.
    config = ProcessConfig(accept=("other-object",) if mixed else ())
    refused = ""
    try:
        process_session(session, data, config, progress=False)
    except InputError as error:
        refused = ", ".join(re.findall(r"--accept ([a-z-]+)", str(error))) or "no object"
    truth = load_truth(session)
    ious, areas = [], []
    for number, capture in enumerate(truth.captures):
        path = data / "masks" / f"{capture}.png"
        if path.is_file() and not (mixed and number in SWAPPED):
            mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) > 0
            coverage = truth.object_coverage(capture)
            covered = coverage > COVERED
            ious.append((mask & covered).sum() / (mask | covered).sum())
            areas.append([area_too_much(mask, coverage, part) for part in (1.0, LOWEST)])
    if not ious:
        return ["", "", "", "", refused]
    offsets = np.sum(areas, axis=0)
    return [
        *(f"{value:.3f}" for value in (min(ious), np.median(ious))),
        *(f"{too_much / length:+.2f}" for too_much, length in offsets),
        refused,
    ]


def area_too_much(
    mask: Bool[np.ndarray, "h w"], coverage: Float[np.ndarray, "h w"], part: float
) -> tuple[float, int]:
    """How much larger the mask is than the object in a lower part of its image, and the pixels along the outline."""
    covered = coverage > COVERED
    lines = np.flatnonzero(covered.any(axis=1))
    top = 0 if part == 1.0 else round(lines[-1] - part * (lines[-1] - lines[0]))
    return float((mask - coverage)[top:].sum()), int(beside(covered, 1)[top:].sum())


if __name__ == "__main__":
    tyro.cli(MaskCases).main()
