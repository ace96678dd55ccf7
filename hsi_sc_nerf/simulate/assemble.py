"""From the description of a scene to what is rendered: the object, disc and container with markers, the cameras.

Each marker on the container is a flat plaque in front of the curved wall, and each marker on the disc lies flat in
z = 0, so the known corner positions are exact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, look_at
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.poses.marker_detection import dictionary_by_name, marker_pattern
from hsi_sc_nerf.simulate import own_mesh, plants
from hsi_sc_nerf.simulate.effect import effect_rng, find_effect, of_kind
from hsi_sc_nerf.simulate.effects.motion import FramePlan, MotionEffect, OffCentre
from hsi_sc_nerf.simulate.mesh import SEGMENTS, VERTEX_SPACING_M, cylinder, quads, sphere
from hsi_sc_nerf.simulate.render import Part, Renderer
from hsi_sc_nerf.simulate.scene import (
    CameraSettings,
    Cylinder,
    MaizeEar,
    MarkerSettings,
    Object,
    OwnMesh,
    Scene,
    Sphere,
    Tomato,
)

PLAQUE_STANDOFF_M = 0.0005
PLAQUE_THICKNESS_M = 0.0003
DISC_THICKNESS_M = 0.006
PRINT_HEIGHT_M = 0.0003
"""Distance of the disc below the markers that are printed on it."""
QUIET_ZONE_MODULES = 0.7
"""Width of the white paper around a marker in modules; disc and container are bright as well."""

# A marker's corners in its own plane (u right, v up), in OpenCV's order: upper left, then clockwise.
UNIT_CORNERS = np.array([(-0.5, 0.5), (0.5, 0.5), (0.5, -0.5), (-0.5, -0.5)])

MarkerLayout = dict[int, Float[np.ndarray, "4 3"]]
MarkerFrame = tuple[np.ndarray, np.ndarray, np.ndarray]  # centre, unit u, unit v


def intrinsics(camera: CameraSettings) -> PinholeIntrinsics:
    """Pinhole intrinsics of the scene's camera: square image, principal point in its centre."""
    focal_px = camera.size_px / 2.0 / np.tan(np.deg2rad(camera.field_of_view_deg) / 2.0)
    centre = camera.size_px / 2.0
    return PinholeIntrinsics(camera.size_px, camera.size_px, focal_px, focal_px, centre, centre)


def first_camera(camera: CameraSettings) -> Float[np.ndarray, "4 4"]:
    """Camera-to-world pose of the first frame: above the x axis, looking at the turntable's axis."""
    elevation = np.deg2rad(camera.elevation_deg)
    aim = np.array([0.0, 0.0, camera.aim_height_m])
    return look_at(aim + camera.distance_m * np.array([np.cos(elevation), 0.0, np.sin(elevation)]), aim)


def frame_plan(scene: Scene) -> FramePlan:
    """The frames of the scene: even steps of the turntable, changed by the motion effects."""
    frames = scene.turntable.frames
    plan = FramePlan(
        room_camera=first_camera(scene.camera),
        angles_deg=np.arange(frames) * 360.0 / frames,
        elapsed=np.linspace(0.0, 1.0, frames) if frames > 1 else np.zeros(1),
        nominal_step_deg=360.0 / frames,
        direction="ccw",
        tilts=np.tile(np.eye(3), (frames, 1, 1)),
    )
    for effect in of_kind(scene.effects, MotionEffect):
        plan = effect.replan(plan, effect_rng(scene.seed, effect))
    return plan


def object_part(scene: Scene) -> Part:
    """The object on the lid of the container.

    Raises:
        InputError: the object is a mesh whose files cannot be used.
    """
    part = _object_on_zero(scene.object, np.random.default_rng(scene.seed))
    mesh = part.mesh.moved(np.array([0.0, 0.0, scene.container.height_m])).moved(_offset_m(scene))
    return replace(part, mesh=mesh, is_object=True)


def _offset_m(scene: Scene) -> Float[np.ndarray, "3"]:
    """Shift of the disc and of what stands on it from the axis."""
    off_centre = find_effect(scene.effects, OffCentre)
    return off_centre.offset_m() if off_centre else np.zeros(3)


def _object_on_zero(settings: Object, rng: np.random.Generator) -> Part:
    """The object on z = 0."""
    if isinstance(settings, Sphere):
        return _plain(sphere(settings.height_m), settings.material)
    if isinstance(settings, Cylinder):
        return _plain(cylinder(settings.diameter_m, settings.height_m, SEGMENTS, VERTEX_SPACING_M), settings.material)
    if isinstance(settings, OwnMesh):
        mesh, weights = own_mesh.load(settings)
        return Part(mesh, settings.materials, weights)
    if isinstance(settings, MaizeEar):
        shape = plants.maize(settings.height_m, rng)
        return Part(shape.mesh, plants.MAIZE_MATERIALS, plants.maize_weights(shape, settings, rng))
    if isinstance(settings, Tomato):
        shape = plants.tomato(settings.height_m, rng)
        return Part(shape.mesh, plants.TOMATO_MATERIALS, plants.tomato_weights(shape, settings, rng))
    shape = {"pear": plants.pear, "apple": plants.apple}[settings.shape](settings.height_m, rng)
    return Part(shape.mesh, plants.FRUIT_MATERIALS[settings.shape], plants.fruit_weights(shape, settings, rng))


def support_parts(scene: Scene, spacing_m: float | None = None) -> list[Part]:
    """Disc and container with their markers; ``spacing_m`` as in `build_renderer`.

    Raises:
        InputError: the markers do not fit, or their dictionary does not exist.
    """
    disc = cylinder(scene.turntable.disc_diameter_m, DISC_THICKNESS_M, spacing_m=spacing_m)
    disc = disc.moved(np.array([0.0, 0.0, -DISC_THICKNESS_M - PRINT_HEIGHT_M]))
    container = cylinder(scene.container.diameter_m, scene.container.height_m, spacing_m=spacing_m)
    parts = [_plain(disc, "disc"), _plain(container, "container_plastic")]
    on_container, on_disc = marker_frames(scene)
    for number, frame in (on_container | on_disc).items():
        mesh, ink = marker_mesh(frame, number, scene.markers)
        parts.append(Part(mesh, ("paper", "marker_ink"), np.stack([~ink, ink], axis=-1).astype(float)))
    for centre, u, v in on_container.values():
        # The back of a plaque makes the paper opaque.
        behind = centre - PLAQUE_THICKNESS_M * np.cross(u, v), u, v
        corners = UNIT_CORNERS * paper_side_in_markers(scene.markers)
        parts.append(_plain(quads(_to_object_frame(corners, behind, scene.markers.side_m)[None]), "paper"))
    return [replace(part, mesh=part.mesh.moved(_offset_m(scene))) for part in parts]


def build_renderer(
    scene: Scene, scanned: Part, extra_materials: Sequence[str] = (), spacing_m: float | None = None
) -> Renderer:
    """The renderer of the whole scene.

    Args:
        extra_materials: materials of patterns on the chamber, which get columns of their own.
        spacing_m: approximate largest distance between vertices, metres, for light that is computed at vertices.
    """
    parts = [scanned, *support_parts(scene, spacing_m)]
    if spacing_m is not None:
        # The factor keeps the diagonals of squares of that side.
        parts = [part.refined(1.5 * spacing_m) for part in parts]
    return Renderer(parts, extra_materials=extra_materials)


def _plain(mesh: Mesh, material: str) -> Part:
    return Part(mesh, (material,), np.ones((len(mesh.vertices), 1)))


def marker_frames(scene: Scene) -> tuple[dict[int, MarkerFrame], dict[int, MarkerFrame]]:
    """Centre, right and up vector of each marker on the container and on the disc, by marker number, object frame.

    The markers of the container have the first numbers.

    Raises:
        InputError: the markers do not fit on the container or on the disc.
    """
    markers, container = scene.markers, scene.container
    paper = markers.side_m * paper_side_in_markers(markers)
    apothem = container.diameter_m / 2.0 + PLAQUE_STANDOFF_M
    too_high = markers.on_container > 0 and paper > container.height_m
    if too_high or (markers.on_container > 2 and paper > 2.0 * apothem * np.tan(np.pi / markers.on_container)):
        raise InputError(
            f"{markers.on_container} markers of {markers.side_m:g} m do not fit around the container; "
            "make markers.side_m or markers.on_container smaller."
        )
    on_container: dict[int, MarkerFrame] = {}
    for number in range(markers.on_container):
        outwards, sideways = _directions(2.0 * np.pi * number / markers.on_container)
        centre = apothem * outwards + np.array([0.0, 0.0, container.height_m / 2.0])
        on_container[number] = (centre, sideways, np.array([0.0, 0.0, 1.0]))

    # The smallest radius at which the inner edges touch neither a plaque's corner nor each other.
    plaque_corner = np.hypot(apothem, paper / 2.0)
    neighbours = paper / 2.0 / np.tan(np.pi / max(markers.on_disc, 3))
    inner_edge = max(plaque_corner, neighbours) + 0.001
    if markers.on_disc and np.hypot(inner_edge + paper, paper / 2.0) > scene.turntable.disc_diameter_m / 2.0:
        raise InputError(
            f"{markers.on_disc} markers of {markers.side_m:g} m do not fit on the disc around the container; "
            "make markers.side_m smaller or turntable.disc_diameter_m larger."
        )
    on_disc: dict[int, MarkerFrame] = {}
    for number in range(markers.on_disc):
        outwards, sideways = _directions(2.0 * np.pi * (number + 0.5) / markers.on_disc)
        # Upright for a reader outside of the disc.
        on_disc[markers.on_container + number] = ((inner_edge + paper / 2.0) * outwards, sideways, -outwards)
    return on_container, on_disc


def _directions(azimuth: float) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Unit vectors away from the axis and counter-clockwise around it, at an azimuth in radians."""
    return np.array([np.cos(azimuth), np.sin(azimuth), 0.0]), np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])


def marker_layout(scene: Scene) -> MarkerLayout:
    """The four corners of each marker's black square in OpenCV's order, metres, object frame."""
    on_container, on_disc = marker_frames(scene)
    return {
        number: _to_object_frame(UNIT_CORNERS, frame, scene.markers.side_m) + _offset_m(scene)
        for number, frame in (on_container | on_disc).items()
    }


def marker_mesh(frame: MarkerFrame, number: int, markers: MarkerSettings) -> tuple[Mesh, np.ndarray]:
    """A marker and its white paper as flat squares, one for each module; and which vertices are ink."""
    pattern = marker_pattern(markers.dictionary, number)
    quiet = paper_side_in_markers(markers) / 2.0
    edges = np.concatenate([[-quiet], np.linspace(-0.5, 0.5, len(pattern) + 1), [quiet]])
    ink = np.pad(pattern == 0, 1)
    left, top = np.meshgrid(edges[:-1], -edges[:-1])
    right, bottom = np.meshgrid(edges[1:], -edges[1:])
    corners = [(left, bottom), (right, bottom), (right, top), (left, top)]
    in_plane = np.stack([np.stack(corner, axis=-1) for corner in corners], axis=2).reshape(-1, 4, 2)
    return quads(_to_object_frame(in_plane, frame, markers.side_m)), np.repeat(ink.ravel(), 4)


def paper_side_in_markers(markers: MarkerSettings) -> float:
    """Ratio of the side of a marker's paper to that of its black square.

    Raises:
        InputError: OpenCV has no such dictionary, or it has too few markers.
    """
    dictionary = dictionary_by_name(markers.dictionary)
    if len(dictionary.bytesList) < markers.on_container + markers.on_disc:
        raise InputError(
            f"{markers.dictionary} has only {len(dictionary.bytesList)} markers; use fewer or a larger dictionary."
        )
    return 1.0 + 2.0 * QUIET_ZONE_MODULES / (dictionary.markerSize + 2)


def _to_object_frame(in_plane: Float[np.ndarray, "*n 2"], frame: MarkerFrame, side_m: float) -> np.ndarray:
    centre, u, v = frame
    return centre + side_m * (in_plane[..., :1] * u + in_plane[..., 1:] * v)
