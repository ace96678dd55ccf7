"""From a scene's description to the things that are rendered: the object, its support, the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, look_at
from hsi_sc_nerf.meshes.mesh import Mesh
from hsi_sc_nerf.simulate import own_mesh, plants, target
from hsi_sc_nerf.simulate.effects import of_stage
from hsi_sc_nerf.simulate.effects.stages import FramePlan, MotionEffect, effect_rng
from hsi_sc_nerf.simulate.mesh import SEGMENTS, VERTEX_SPACING_M, cylinder, sphere
from hsi_sc_nerf.simulate.render import Part, Renderer
from hsi_sc_nerf.simulate.scene import CameraSettings, Cylinder, MaizeEar, Object, OwnMesh, Scene, Sphere


def intrinsics(camera: CameraSettings) -> PinholeIntrinsics:
    """The pinhole camera of the scene: square image, principal point in its middle."""
    focal_px = camera.size_px / 2.0 / np.tan(np.deg2rad(camera.field_of_view_deg) / 2.0)
    centre = camera.size_px / 2.0
    return PinholeIntrinsics(camera.size_px, camera.size_px, focal_px, focal_px, centre, centre)


def first_camera(camera: CameraSettings) -> Float[np.ndarray, "4 4"]:
    """CameraSettings-to-world of the first frame: above the x axis, looking at the turntable's axis."""
    elevation = np.deg2rad(camera.elevation_deg)
    aim = np.array([0.0, 0.0, camera.aim_height_m])
    return look_at(aim + camera.distance_m * np.array([np.cos(elevation), 0.0, np.sin(elevation)]), aim)


def frame_plan(scene: Scene) -> FramePlan:
    """Which frames are taken, at which angles, from where: an even turn, changed by the scene's effects."""
    frames = scene.turntable.frames
    sign = 1.0 if scene.turntable.direction == "ccw" else -1.0
    plan = FramePlan(
        room_camera=first_camera(scene.camera),
        angles_deg=sign * np.arange(frames) * 360.0 / frames,
        elapsed=np.linspace(0.0, 1.0, frames) if frames > 1 else np.zeros(1),
        nominal_step_deg=360.0 / frames,
        direction=scene.turntable.direction,
    )
    for effect in of_stage(scene.effects, MotionEffect):
        plan = effect.replan(plan, effect_rng(scene.seed, effect))
    return plan


def object_part(scene: Scene) -> Part:
    """The object, standing on the container's lid.

    Raises:
        InputError: the object is a mesh whose files cannot be used.
    """
    part = _object_on_zero(scene.object, np.random.default_rng(scene.seed))
    return replace(part, mesh=part.mesh.moved(np.array([0.0, 0.0, scene.container.height_m])), is_object=True)


def _object_on_zero(thing: Object, rng: np.random.Generator) -> Part:
    """The object, standing on z = 0."""
    if isinstance(thing, Sphere):
        return _plain(sphere(thing.height_m), thing.material)
    if isinstance(thing, Cylinder):
        return _plain(cylinder(thing.diameter_m, thing.height_m, SEGMENTS, VERTEX_SPACING_M), thing.material)
    if isinstance(thing, OwnMesh):
        mesh, weights = own_mesh.load(thing)
        return Part(mesh, thing.materials, weights)
    if isinstance(thing, MaizeEar):
        shape = plants.maize(thing.height_m, rng)
        return Part(shape.mesh, plants.MAIZE_MATERIALS, plants.maize_weights(shape, thing, rng))
    shape = {"pear": plants.pear, "apple": plants.apple}[thing.shape](thing.height_m, rng)
    return Part(shape.mesh, plants.FRUIT_MATERIALS[thing.shape], plants.fruit_weights(shape, thing, rng))


def support_parts(scene: Scene, spacing_m: float | None = None) -> list[Part]:
    """Disc, container, and the markers on both; ``spacing_m`` as in `build_renderer`.

    Raises:
        InputError: the markers do not fit, or their dictionary does not exist.
    """
    parts = [
        _plain(target.disc_mesh(scene.turntable, spacing_m), "disc"),
        _plain(target.container_mesh(scene.container, spacing_m), "container_plastic"),
    ]
    on_container, on_disc = target.marker_frames(scene.markers, scene.container, scene.turntable)
    for number, frame in (on_container | on_disc).items():
        mesh, ink = target.marker_mesh(frame, number, scene.markers)
        parts.append(Part(mesh, ("paper", "marker_ink"), np.stack([~ink, ink], axis=-1).astype(float)))
    parts += [_plain(target.plaque_back(frame, scene.markers), "paper") for frame in on_container.values()]
    return parts


def build_renderer(
    scene: Scene,
    thing: Part,
    offset_m: Float[np.ndarray, "3"] | float = 0.0,
    extra_materials: Sequence[str] = (),
    spacing_m: float | None = None,
) -> Renderer:
    """The renderer of the whole scene around its object (from `object_part`), its support shifted by ``offset_m``.

    ``extra_materials`` get columns of their own, for what is seen where rays miss everything. With ``spacing_m`` the
    same surfaces have vertices at most about so far apart (metres), for light that is computed there.
    """
    support = support_parts(scene, spacing_m)
    parts = [thing, *(replace(part, mesh=part.mesh.moved(np.broadcast_to(offset_m, 3))) for part in support)]
    if spacing_m is not None:
        # The diagonal of a square of that side is left whole.
        parts = [part.refined(1.5 * spacing_m) for part in parts]
    return Renderer(parts, extra_materials=extra_materials)


def _plain(mesh: Mesh, material: str) -> Part:
    return Part(mesh, (material,), np.ones((len(mesh.vertices), 1)))
