"""From the description of a scene to what is rendered: the object, its support, and the camera of each frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, look_at
from hsi_sc_nerf.geometry.mesh import Mesh
from hsi_sc_nerf.simulate import own_mesh, plants, target
from hsi_sc_nerf.simulate.effect import effect_rng, of_kind
from hsi_sc_nerf.simulate.effects.motion import FramePlan, MotionEffect
from hsi_sc_nerf.simulate.mesh import SEGMENTS, VERTEX_SPACING_M, cylinder, sphere
from hsi_sc_nerf.simulate.render import Part, Renderer
from hsi_sc_nerf.simulate.scene import CameraSettings, Cylinder, MaizeEar, Object, OwnMesh, Scene, Sphere


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
    sign = 1.0 if scene.turntable.direction == "ccw" else -1.0
    plan = FramePlan(
        room_camera=first_camera(scene.camera),
        angles_deg=sign * np.arange(frames) * 360.0 / frames,
        elapsed=np.linspace(0.0, 1.0, frames) if frames > 1 else np.zeros(1),
        nominal_step_deg=360.0 / frames,
        direction=scene.turntable.direction,
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
    return replace(part, mesh=part.mesh.moved(np.array([0.0, 0.0, scene.container.height_m])), is_object=True)


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
    shape = {"pear": plants.pear, "apple": plants.apple}[settings.shape](settings.height_m, rng)
    return Part(shape.mesh, plants.FRUIT_MATERIALS[settings.shape], plants.fruit_weights(shape, settings, rng))


def support_parts(scene: Scene, spacing_m: float | None = None) -> list[Part]:
    """Disc and container with their markers; ``spacing_m`` as in `build_renderer`.

    Raises:
        InputError: the markers do not fit, or their dictionary does not exist.
    """
    disc = cylinder(scene.turntable.disc_diameter_m, target.DISC_THICKNESS_M, spacing_m=spacing_m)
    disc = disc.moved(np.array([0.0, 0.0, -target.DISC_THICKNESS_M - target.PRINT_HEIGHT_M]))
    container = cylinder(scene.container.diameter_m, scene.container.height_m, spacing_m=spacing_m)
    parts = [_plain(disc, "disc"), _plain(container, "container_plastic")]
    on_container, on_disc = target.marker_frames(scene.markers, scene.container, scene.turntable)
    for number, frame in (on_container | on_disc).items():
        mesh, ink = target.marker_mesh(frame, number, scene.markers)
        parts.append(Part(mesh, ("paper", "marker_ink"), np.stack([~ink, ink], axis=-1).astype(float)))
    parts += [_plain(target.plaque_back(frame, scene.markers), "paper") for frame in on_container.values()]
    return parts


def build_renderer(
    scene: Scene,
    scanned: Part,
    offset_m: Float[np.ndarray, "3"] | float = 0.0,
    extra_materials: Sequence[str] = (),
    spacing_m: float | None = None,
) -> Renderer:
    """The renderer of the whole scene.

    Args:
        scene: the scene.
        scanned: its object, from `object_part`.
        offset_m: shift of disc, container and markers, metres.
        extra_materials: materials of patterns on the chamber, which get columns of their own.
        spacing_m: approximate largest distance between vertices, metres, for light that is computed at vertices.
    """
    support = support_parts(scene, spacing_m)
    parts = [scanned, *(replace(part, mesh=part.mesh.moved(np.broadcast_to(offset_m, 3))) for part in support)]
    if spacing_m is not None:
        # The factor keeps the diagonals of squares of that side.
        parts = [part.refined(1.5 * spacing_m) for part in parts]
    return Renderer(parts, extra_materials=extra_materials)


def _plain(mesh: Mesh, material: str) -> Part:
    return Part(mesh, (material,), np.ones((len(mesh.vertices), 1)))
