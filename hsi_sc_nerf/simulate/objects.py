"""The things that can be scanned: what a scene file says of its object, one dataclass a kind of shape."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeAlias

from hsi_sc_nerf.simulate.reading import between


@dataclass(frozen=True)
class Fruit:
    """A pear or an apple; lengths in metres, shares in [0, 1]."""

    shape: Literal["pear", "apple"]
    height_m: float = between(0.01, 0.5)
    """With the stem."""
    blush: float = between(0.0, 1.0, default=0.0)
    """Share of blush where it is strongest."""
    lenticel_diameter_m: float = between(0.0, 0.02, default=0.0)
    """Diameter of the pale dots on the skin; 0 leaves them out."""
    bruise_diameter_m: float = between(0.0, 0.1, default=0.0)
    """Diameter of the bruise; 0 leaves it out."""


@dataclass(frozen=True)
class MaizeEar:
    """A husked maize ear that stands on its shank."""

    shape: Literal["maize"]
    height_m: float = between(0.01, 0.5)
    coloured_kernels: float = between(0.0, 1.0, default=0.0)
    """Share of kernels that are purple, and again as many that are white."""


@dataclass(frozen=True)
class Sphere:
    """A sphere of one material, for checks: its area is pi d², its volume pi d³ / 6."""

    shape: Literal["sphere"]
    height_m: float = between(0.01, 0.5)
    """Its diameter d."""
    material: str = "matte_white"


@dataclass(frozen=True)
class Cylinder:
    """An upright cylinder of one material, for checks: its area is pi d (d / 2 + h), its volume pi d² h / 4."""

    shape: Literal["cylinder"]
    height_m: float = between(0.01, 0.5)
    diameter_m: float = between(0.01, 0.5)
    material: str = "matte_grey"


@dataclass(frozen=True)
class OwnMesh:
    """A closed triangle mesh from a file, and where the materials lie on it.

    Of several materials the shares come from ``weight_texture``, else from the file: PLY vertex properties
    ``weight_NAME``, one a material, else vertex colours whose red, green and blue are the shares of the first,
    second and third material.
    """

    shape: Literal["mesh"]
    mesh_file: Path
    """PLY, OBJ, glTF or GLB; a path relative to the scene file."""
    materials: tuple[str, ...]
    """Names of built-in materials, or of those that the scene file defines."""
    weight_texture: Path | None = None
    """An image laid on by the mesh's UVs; its channels are shares, in the order of ``materials`` (at most three)."""
    height_m: float | None = between(0.01, 0.5, default=None)
    """The mesh is scaled to be as tall as this; without it, lengths in the file are metres."""
    up_axis: Literal["by_format", "y", "z"] = "by_format"
    """The file's axis that points up; by format it is y in glTF and GLB, z in PLY and OBJ."""

    def in_folder(self, folder: Path) -> OwnMesh:
        """The same object with its paths taken relative to ``folder``."""
        texture = self.weight_texture
        return replace(
            self, mesh_file=folder / self.mesh_file, weight_texture=None if texture is None else folder / texture
        )


Object: TypeAlias = Fruit | MaizeEar | Sphere | Cylinder | OwnMesh
