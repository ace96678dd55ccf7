"""The description of a scene, and reading it from a short YAML file.

A scene describes the object, its materials, the camera, the turntable, the container with its markers, the sensor,
and the effects: departures from a matte object, even light and a perfect sensor.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any, Literal, TypeAlias

from hsi_sc_nerf import paper
from hsi_sc_nerf.errors import InputError, shown
from hsi_sc_nerf.settings_file import between, check_ranges, read_dataclass, read_yaml
from hsi_sc_nerf.simulate.effect import Effect
from hsi_sc_nerf.simulate.effects import detector, image, light, motion
from hsi_sc_nerf.simulate.effects.detector import SensorSettings
from hsi_sc_nerf.simulate.materials import MATERIALS, Material, read_materials

SHIPPED_SCENES = ("pear", "apple", "maize", "tomato", "pepper", "sphere", "cylinder")
EFFECTS: dict[str, type[Effect]] = {
    effect.name: effect for effect in (*motion.EFFECTS, *light.EFFECTS, *image.EFFECTS, *detector.EFFECTS)
}
"""All effects by name, in the order in which they act, whatever their order in the scene file."""


@dataclass(frozen=True)
class Fruit:
    """A pear or an apple."""

    shape: Literal["pear", "apple"]
    height_m: float = between(0.01, 0.5)
    """Height with the stem."""
    blush: float = between(0.0, 1.0, default=0.0)
    """Largest fraction of blush, in [0, 1]."""
    lenticel_diameter_m: float = between(0.0, 0.02, default=0.0)
    """Diameter of the lenticels (pale dots on the skin); 0 for none."""
    bruise_diameter_m: float = between(0.0, 0.1, default=0.0)
    """Diameter of the bruise; 0 for none."""


@dataclass(frozen=True)
class MaizeEar:
    """A husked maize ear that stands on its shank."""

    shape: Literal["maize"]
    height_m: float = between(0.01, 0.5)
    coloured_kernels: float = between(0.0, 1.0, default=0.0)
    """Fraction of purple kernels; the fraction of white kernels is the same."""


@dataclass(frozen=True)
class Tomato:
    """A ribbed tomato with a hollow where the stem was."""

    shape: Literal["tomato"]
    height_m: float = between(0.01, 0.5)
    green_shoulder: float = between(0.0, 1.0, default=0.0)
    """Largest fraction of green skin, which is around the hollow, in [0, 1]."""


@dataclass(frozen=True)
class Sphere:
    """A sphere of one material with the area pi d² and the volume pi d³ / 6."""

    shape: Literal["sphere"]
    height_m: float = between(0.01, 0.5)
    """Diameter d."""
    material: str = "matte_white"


@dataclass(frozen=True)
class Cylinder:
    """An upright cylinder of one material with the area pi d (d / 2 + h) and the volume pi d² h / 4."""

    shape: Literal["cylinder"]
    height_m: float = between(0.01, 0.5)
    diameter_m: float = between(0.01, 0.5)
    material: str = "matte_grey"


@dataclass(frozen=True)
class OwnMesh:
    """A closed triangle mesh from a file with one or more materials.

    The fractions of several materials come from PLY vertex properties ``weight_NAME``, one for each material, or
    from vertex colours (red, green and blue are the first, second and third material).
    """

    shape: Literal["mesh"]
    mesh_file: Path
    """PLY, OBJ, glTF or GLB; a path relative to the scene file."""
    materials: tuple[str, ...]
    """Names of built-in materials, or of those that the scene file defines."""
    height_m: float | None = between(0.01, 0.5, default=None)
    """Height to which the mesh is scaled; without it, lengths in the file are metres."""
    up_axis: Literal["by_format", "y", "z"] = "by_format"
    """Vertical axis of the file; ``by_format`` is y for glTF and GLB, z for PLY and OBJ."""


Object: TypeAlias = Fruit | MaizeEar | Tomato | Sphere | Cylinder | OwnMesh


@dataclass(frozen=True)
class CameraSettings:
    """A stationary camera that looks at a point on the turntable axis."""

    elevation_deg: float = between(0.0, 85.0)
    distance_m: float = between(0.05, 10.0)
    """Distance from the camera to that point."""
    aim_height_m: float = between(-1.0, 1.0)
    """Height of that point above the disc."""
    field_of_view_deg: float = between(1.0, 120.0, default=31.0)
    size_px: int = between(8, 4096, default=128)
    supersampling: int = between(1, 16, default=4)
    """Rays per pixel along each side."""


@dataclass(frozen=True)
class TurntableSettings:
    """The disc and its rotation."""

    disc_diameter_m: float = between(0.01, 2.0)
    frames: int = between(1, 3600, default=36)
    """Frames in one full turn, evenly spaced and counter-clockwise seen from above."""


@dataclass(frozen=True)
class ContainerSettings:
    """The cylinder on which the object stands."""

    diameter_m: float = between(0.01, 1.0, default=paper.CONTAINER_DIAMETER_M)
    height_m: float = between(0.005, 1.0, default=paper.CONTAINER_HEIGHT_M)


@dataclass(frozen=True)
class MarkerSettings:
    """ArUco markers of one size around the container and on the disc."""

    side_m: float = between(0.002, 0.5)
    """Side of the black square."""
    dictionary: str = "DICT_5X5_50"
    on_container: int = between(0, 50, default=paper.CONTAINER_MARKERS)
    on_disc: int = between(0, 50, default=paper.DISC_MARKERS)


@dataclass(frozen=True)
class Scene:
    """The description of a simulated session; the same scene and seed give the same bytes."""

    name: str
    object: Object
    camera: CameraSettings
    turntable: TurntableSettings
    markers: MarkerSettings
    materials: dict[str, Material] = field(default_factory=dict)
    """Materials of the scene; they replace built-in materials of the same name."""
    container: ContainerSettings = ContainerSettings()
    sensor: SensorSettings = field(default_factory=SensorSettings)
    effects: tuple[Any, ...] = ()
    """Effects from `EFFECTS`, in the order in which they act."""
    seed: int = between(0, 2**31 - 1, default=0)


def load_scene(name_or_path: str | Path) -> Scene:
    """Read a shipped scene by name, or a scene file.

    Args:
        name_or_path: one of `SHIPPED_SCENES`, or the path of a YAML file.

    Raises:
        InputError: no such scene or file; not YAML; an unknown or missing key; a value of the wrong type or out
            of range; an effect that does not exist.

    Example:
        >>> scene = override(load_scene("pear"), frames=60, effects=["photon_noise", "{lamp: {fraction: 0.3}}"])
        >>> scene.turntable.frames
        60
    """
    if str(name_or_path) in SHIPPED_SCENES:
        with resources.as_file(resources.files(__package__).joinpath("scenes")) as folder:
            text = (folder / f"{name_or_path}.yaml").read_text(encoding="utf-8")
    else:
        folder = Path(name_or_path).parent
        try:
            text = Path(name_or_path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(
                f"{name_or_path}: neither a shipped scene ({', '.join(SHIPPED_SCENES)}) nor a readable scene file; "
                "give one of these names or the path of a YAML file."
            ) from error
    return parse_scene(text, source=str(name_or_path), name=Path(name_or_path).stem, folder=folder)


def parse_scene(text: str, *, source: str, name: str, folder: Path = Path()) -> Scene:
    """Parse the YAML text of a scene.

    Args:
        folder: folder to which paths in the text are relative.

    Raises:
        InputError: see `load_scene`.
    """
    values = read_yaml(text, source)
    if isinstance(values, dict):
        values.setdefault("name", name)
        values["materials"] = read_materials(values.get("materials", {}), source, folder)
    scene = read_dataclass(Scene, values, source, "")
    scene = replace(scene, effects=read_effects(scene.effects, source))
    check_ranges(scene, source, "")
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", scene.name):
        raise InputError(
            f"{source}: name is {scene.name!r}, but must consist of letters, digits, '_', '.' and '-', because it "
            "names the captures."
        )
    _check_materials(scene, source)
    if isinstance(scene.object, OwnMesh):
        scene = replace(scene, object=replace(scene.object, mesh_file=folder / scene.object.mesh_file))
    return scene


def _check_materials(scene: Scene, source: str) -> None:
    """Check that every named material exists and every defined material is used."""
    named: tuple[str, ...] = ()
    if isinstance(scene.object, OwnMesh):
        named = scene.object.materials
        if len(named) == 0 or len({*named}) < len(named):
            raise InputError(f"{source}: object.materials is {list(named)}, but must name one or more, each once.")
    elif isinstance(scene.object, Sphere | Cylinder):
        named = (scene.object.material,)
    for name in named:
        if name not in MATERIALS and name not in scene.materials:
            raise InputError(
                f"{source}: material {name!r} is not defined; define it under `materials:` or take one of "
                f"{', '.join(MATERIALS)}."
            )
    for name in scene.materials:
        if name not in MATERIALS and name not in named:
            raise InputError(
                f"{source}: nothing is made of the material {name!r}; name it in the object's materials, or give it "
                f"the name of the built-in material that it replaces ({', '.join(MATERIALS)})."
            )


def override(
    scene: Scene,
    *,
    frames: int | None = None,
    size_px: int | None = None,
    bands: int | None = None,
    seed: int | None = None,
    effects: Sequence[str] | None = None,
) -> Scene:
    """Replace values of a scene; ``None`` keeps a value.

    Args:
        effects: effects as YAML texts: ``photon_noise`` or ``{read_noise: {electrons: 40}}``.

    Raises:
        InputError: a value is out of range.
    """
    changes = {"frames": ("turntable", frames), "size_px": ("camera", size_px), "bands": ("sensor", bands)}
    for name, (group, value) in changes.items():
        if value is not None:
            scene = replace(scene, **{group: replace(getattr(scene, group), **{name: value})})
    if seed is not None:
        scene = replace(scene, seed=seed)
    if effects is not None:
        scene = replace(scene, effects=read_effects([read_yaml(text, "--effects") for text in effects], "--effects"))
    check_ranges(scene, scene.name, "")
    return scene


def read_effects(values: Sequence[Any], source: str) -> tuple[Effect, ...]:
    """Effects of a scene file's list, in the order in which they act.

    Args:
        values: names, or names with settings such as ``{"read_noise": {"electrons": 40}}``.

    Raises:
        InputError: an unknown or repeated effect; an unknown, missing, mistyped or out-of-range setting.

    Example:
        >>> read_effects(["photon_noise", {"lamp": {"fraction": 0.3}}], "scene.yaml")
        (Lamp(fraction=0.3, azimuth_deg=-35.0, elevation_deg=30.0), PhotonNoise())
    """
    found: dict[str, Effect] = {}
    settings: dict[str, Any]
    for value in values:
        if isinstance(value, str):
            name, settings = value, {}
        elif isinstance(value, dict) and len(value) == 1:
            ((name, settings),) = value.items()
        else:
            raise InputError(f"{source}: effect {shown(value)} is neither a name nor `name: {{setting: value}}`.")
        if name not in EFFECTS:
            raise InputError(f"{source}: effect {name!r} is unknown; known are {', '.join(EFFECTS)}.")
        if name in found:
            raise InputError(f"{source}: effect {name} is named twice; name it once.")
        settings = {} if settings is None else settings
        found[name] = read_dataclass(EFFECTS[name], settings, source, f"effects.{name}.")
        check_ranges(found[name], source, f"effects.{name}.")
    return tuple(found[name] for name in EFFECTS if name in found)
