"""What a scene is, and reading it from a short YAML file.

A scene names the object, the camera, the turntable, the container with its markers, the sensor, and the
physical effects beyond a matte object under even light (none exist yet).
"""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

import yaml

from hsi_sc_nerf import paper
from hsi_sc_nerf.errors import InputError

SHIPPED_SCENES = ("pear", "apple", "maize")


def _between(low: float, high: float, **kwargs: Any) -> Any:
    """A dataclass field whose value must lie in [low, high]."""
    return field(metadata={"range": (low, high)}, **kwargs)


@dataclass(frozen=True)
class Object:
    """The thing that is scanned; lengths in metres, shares in [0, 1]."""

    shape: Literal["pear", "apple", "maize"]
    height_m: float = _between(0.01, 0.5)
    blush: float = _between(0.0, 1.0, default=0.0)
    """Share of blush where it is strongest (pear, apple)."""
    lenticel_diameter_m: float = _between(0.0, 0.02, default=0.0)
    """Diameter of the pale dots on the skin; 0 leaves them out (pear, apple)."""
    bruise_diameter_m: float = _between(0.0, 0.1, default=0.0)
    """Diameter of the bruise; 0 leaves it out (pear, apple)."""
    coloured_kernels: float = _between(0.0, 1.0, default=0.0)
    """Share of kernels that are purple, and again as many that are white (maize)."""


@dataclass(frozen=True)
class Camera:
    """A camera that stands still and looks at a point on the turntable's axis."""

    elevation_deg: float = _between(0.0, 85.0)
    distance_m: float = _between(0.05, 10.0)
    """From the camera to the point that it looks at."""
    aim_height_m: float = _between(-1.0, 1.0)
    """Height of that point above the disc."""
    field_of_view_deg: float = _between(1.0, 120.0, default=31.0)
    size_px: int = _between(8, 4096, default=128)
    supersampling: int = _between(1, 16, default=4)
    """Rays per pixel along each side."""


@dataclass(frozen=True)
class Turntable:
    """The disc and how it turns."""

    disc_diameter_m: float = _between(0.01, 2.0)
    frames: int = _between(1, 3600, default=36)
    """Frames in one full turn, evenly spaced."""
    direction: Literal["ccw", "cw"] = "ccw"
    """Seen from above."""


@dataclass(frozen=True)
class Container:
    """The cylinder that the object stands on."""

    diameter_m: float = _between(0.01, 1.0, default=paper.CONTAINER_DIAMETER_M)
    height_m: float = _between(0.005, 1.0, default=paper.CONTAINER_HEIGHT_M)


@dataclass(frozen=True)
class Markers:
    """The ArUco markers, all of one size: some around the container, some on the disc."""

    side_m: float = _between(0.002, 0.5)
    """Side of the black square."""
    dictionary: str = "DICT_5X5_50"
    on_container: int = _between(0, 50, default=paper.CONTAINER_MARKERS)
    on_disc: int = _between(0, 50, default=paper.DISC_MARKERS)


@dataclass(frozen=True)
class Sensor:
    """A perfect push-broom sensor: counts are linear in light, without noise."""

    bands: int = _between(3, 2048, default=paper.BANDS)
    bit_depth: int = _between(8, 16, default=12)
    lamp_temperature_k: float = _between(1500.0, 10000.0, default=3000.0)
    white_level: float = _between(0.05, 1.0, default=0.82)
    """Counts of the white tarp in its brightest band, as a share of the largest count."""
    dark_level: int = _between(0, 1000, default=120)
    """Counts without light."""


@dataclass(frozen=True)
class Scene:
    """All that a session is made from; the same scene with the same seed gives the same bytes."""

    name: str
    object: Object
    camera: Camera
    turntable: Turntable
    markers: Markers
    container: Container = Container()
    sensor: Sensor = Sensor()
    effects: tuple[Any, ...] = ()
    """Physical effects beyond a matte object under even light; none exist yet."""
    seed: int = _between(0, 2**31 - 1, default=0)


def load_scene(name_or_path: str | Path) -> Scene:
    """Read a shipped scene by its name, or a scene file.

    Raises:
        InputError: no such scene or file; not YAML; an unknown or missing key; a value of the wrong type or out
            of range; an effect that does not exist.
    """
    if str(name_or_path) in SHIPPED_SCENES:
        text = resources.files(__package__).joinpath("scenes", f"{name_or_path}.yaml").read_text(encoding="utf-8")
    else:
        try:
            text = Path(name_or_path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(
                f"{name_or_path}: neither a shipped scene ({', '.join(SHIPPED_SCENES)}) nor a readable scene file; "
                "give one of these names or the path of a YAML file."
            ) from error
    return parse_scene(text, source=str(name_or_path), name=Path(name_or_path).stem)


def parse_scene(text: str, *, source: str, name: str) -> Scene:
    """Make a scene of YAML text; ``source`` names it in errors and ``name`` is used where the text has no name.

    Raises:
        InputError: see `load_scene`.
    """
    try:
        values = yaml.safe_load(text)
    except yaml.YAMLError as error:
        problem = " ".join(str(error).split())
        raise InputError(f"{source}: not valid YAML ({problem}); correct that line.") from error
    if isinstance(values, dict):
        values.setdefault("name", name)
    scene = _read_dataclass(Scene, values, source, "")
    _check_ranges(scene, source, "")
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", scene.name):
        raise InputError(
            f"{source}: name is {scene.name!r}, but must be of letters, digits, '_', '.' and '-', for captures are "
            "named after it."
        )
    if scene.effects:
        raise InputError(
            f"{source}: effect {scene.effects[0]!r} is unknown, for no effects exist yet; leave `effects` empty."
        )
    return scene


def override(
    scene: Scene,
    *,
    frames: int | None = None,
    size_px: int | None = None,
    bands: int | None = None,
    seed: int | None = None,
) -> Scene:
    """The scene with the given values in place of its own; ``None`` keeps the scene's.

    Raises:
        InputError: a value is out of range.
    """
    if frames is not None:
        scene = dataclasses.replace(scene, turntable=dataclasses.replace(scene.turntable, frames=frames))
    if size_px is not None:
        scene = dataclasses.replace(scene, camera=dataclasses.replace(scene.camera, size_px=size_px))
    if bands is not None:
        scene = dataclasses.replace(scene, sensor=dataclasses.replace(scene.sensor, bands=bands))
    if seed is not None:
        scene = dataclasses.replace(scene, seed=seed)
    _check_ranges(scene, scene.name, "")
    return scene


def _read_dataclass(cls: Any, values: Any, source: str, prefix: str) -> Any:
    """Fill the dataclass ``cls`` from a mapping, checking keys and types; ``prefix`` is the path down to here."""
    where = prefix.rstrip(".") or "the file"
    if not isinstance(values, dict):
        raise InputError(f"{source}: {where} must hold `key: value` lines, not {values!r}.")
    fields = {f.name: f for f in dataclasses.fields(cls)}
    for key in values:
        if key not in fields:
            raise InputError(f"{source}: {prefix}{key} is not a known key; known here are {', '.join(fields)}.")
    for key, f in fields.items():
        if key not in values and f.default is dataclasses.MISSING:
            raise InputError(f"{source}: {prefix}{key} is missing; add it.")
    hints = get_type_hints(cls)
    return cls(**{key: _read_value(hints[key], value, source, prefix + key) for key, value in values.items()})


def _read_value(expected: Any, value: Any, source: str, key: str) -> Any:
    """Check one value against its declared type; whole numbers pass for floats, YAML lists become tuples."""
    if dataclasses.is_dataclass(expected):
        return _read_dataclass(expected, value, source, key + ".")
    if get_origin(expected) is Literal:
        if value not in get_args(expected):
            raise InputError(f"{source}: {key} is {value!r}, but must be one of {', '.join(get_args(expected))}.")
        return value
    if get_origin(expected) is tuple:
        if not isinstance(value, list):
            raise InputError(f"{source}: {key} is {value!r}, but must be a list.")
        return tuple(value)
    kind, accepted = {float: ("a number", (int, float)), int: ("a whole number", (int,)), str: ("a text", (str,))}[
        expected
    ]
    if isinstance(value, bool) or not isinstance(value, accepted):
        raise InputError(f"{source}: {key} is {value!r}, but must be {kind}.")
    return expected(value)


def _check_ranges(values: Any, source: str, prefix: str) -> None:
    for f in dataclasses.fields(values):
        value = getattr(values, f.name)
        if dataclasses.is_dataclass(value):
            _check_ranges(value, source, f"{prefix}{f.name}.")
        elif "range" in f.metadata:
            low, high = f.metadata["range"]
            # Written so that NaN fails as well.
            if not low <= value <= high:
                raise InputError(
                    f"{source}: {prefix}{f.name} is {value:g}, but must lie between {low:g} and {high:g}."
                )
