"""A run whose model is known in closed form: an opaque ball before cameras that look at it from around.

The scene is the object frame in units of 0.1 m, shifted by ``CENTRE_M``. The ball has a radius of 0.5 units and emits
the spectrum of its height; the cameras, as measured, are wrong by a shift that the model's refinement takes back.
"""

from types import SimpleNamespace

import numpy as np
import torch
from capture_factory import packed_frame
from nerfstudio.cameras.cameras import Cameras, CameraType

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, look_at, pixel_rays, turntable_camera_to_world
from hsi_sc_nerf.packed.cube import pack, write_packed_cube
from hsi_sc_nerf.packed.pixels import PixelReader, PixelSampler

RADIUS = 0.5
SCALE = 10.0
CENTRE_M = np.array([0.01, -0.02, 0.06])
WAVELENGTHS_NM = np.array([450.0, 550.0, 600.0, 670.0, 800.0])
SIZE_PX, FRAMES = 48, 10
LENS = PinholeIntrinsics(SIZE_PX, SIZE_PX, 90.0, 90.0, SIZE_PX / 2, SIZE_PX / 2)
SHIFT = torch.tensor([0.02, -0.01, 0.015])
FIRST_POSE = look_at(np.array([2.5, 0.0, 1.2]), np.zeros(3))
POSES = np.stack([turntable_camera_to_world(FIRST_POSE, 360.0 * i / FRAMES) for i in range(FRAMES)])


def true_spectra(points: np.ndarray) -> np.ndarray:
    """Reflectance at points of the scene: rises with height, each band with its own slope."""
    return 0.4 + 0.5 * points[..., 2:] * np.linspace(-0.5, 0.5, len(WAVELENGTHS_NM))


def hit_distance(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance to the ball along unit directions; infinite beside it."""
    along = -(origins * directions).sum(axis=-1)
    inside = along**2 - (origins**2).sum(axis=-1) + RADIUS**2
    return np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0.0)), np.inf)


class BallModel:
    """What `SpectralModel` is asked for by an export."""

    device = torch.device("cpu")
    wavelengths_nm = WAVELENGTHS_NM
    rgb_bands = (3, 1, 0)
    config = SimpleNamespace(eval_num_rays_per_chunk=4096)
    camera_optimizer = SimpleNamespace(corrected=lambda frames, poses: _shifted(poses))
    field = SimpleNamespace(
        density_fn=lambda p: 2000.0 * (p.norm(dim=-1, keepdim=True) < RADIUS).float(),
        density_gradient=lambda p: -p,
        rise_length=0.0,
    )

    background: object | None = object()
    occupancy = None

    def background_spectrum(self, rays):
        """A chamber of one grey."""
        return torch.full((len(rays), len(WAVELENGTHS_NM)), 0.1)

    def depth_and_opacity(self, rays):
        """Of the rendered rays."""
        outputs = self(rays)
        return outputs["depth"], outputs["accumulation"]

    def __call__(self, rays):
        rays.origins = rays.origins + SHIFT
        origins, directions = rays.origins.numpy().astype(float), rays.directions.numpy().astype(float)
        distance = hit_distance(origins, directions)
        hit = np.isfinite(distance)
        points = origins + directions * np.where(hit, distance, 0.0)[:, None]
        opacity = 0.9 * hit[:, None]
        spectral = opacity * true_spectra(points) + (1.0 - opacity) * 0.1
        outputs = {
            "accumulation": opacity,
            # As wrong as a median depth is.
            "depth": np.where(hit, distance + 0.01, 3.0)[:, None],
            "spectral": spectral,
            "rgb": spectral[:, [3, 1, 0]],
            "pred_normals": (points / RADIUS + 1.0) / 2.0,
        }
        return {name: torch.from_numpy(values).float() for name, values in outputs.items()}


def _shifted(poses: torch.Tensor) -> torch.Tensor:
    moved = poses.clone()
    moved[:, :3, 3] += SHIFT
    return moved


def ball_cameras() -> Cameras:
    """The cameras as measured: not where they really were."""
    poses = torch.from_numpy(POSES[:, :3]).float()
    poses[:, :, 3] -= SHIFT
    return Cameras(
        camera_to_worlds=poses,
        fx=LENS.fl_x,
        fy=LENS.fl_y,
        cx=LENS.cx,
        cy=LENS.cy,
        width=SIZE_PX,
        height=SIZE_PX,
        camera_type=CameraType.PERSPECTIVE,
        metadata={"frame_index": torch.arange(FRAMES)[:, None].float()},
    )


def known_run(folder) -> SimpleNamespace:
    """A stand-in for `TrainedRun`, with cubes of what the cameras see."""
    grid = np.stack(np.meshgrid(np.arange(SIZE_PX), np.arange(SIZE_PX)), axis=-1) + 0.5
    frames, masks = [], []
    for index, pose in enumerate(POSES):
        origin, directions = pixel_rays(LENS, pose, grid)
        distance = hit_distance(np.broadcast_to(origin, directions.shape), directions)
        masks.append(np.isfinite(distance))
        points = origin + directions * np.where(masks[-1], distance, 0.0)[..., None]
        cube = np.where(masks[-1][..., None], true_spectra(points), 0.1)
        frames.append(packed_frame(folder, f"ball_{index:03d}"))
        write_packed_cube(frames[-1].cube_path, pack(cube), WAVELENGTHS_NM)
    reader = PixelReader([frame.cube() for frame in frames])
    sampler = PixelSampler(reader, np.stack(masks), 1, seed=0, has_flagged=False)
    half_m = RADIUS / SCALE + 0.005
    box_m = CENTRE_M + np.array([[-half_m] * 3, [half_m] * 3])
    return SimpleNamespace(
        model=BallModel(),
        dataset=SimpleNamespace(
            object_box_m=box_m,
            metric=True,
            scene_box_m=box_m + np.array([[-0.03], [0.03]]),
            flagged_values=0,
            intrinsics=LENS,
            distortion=np.zeros(4),
            container=None,
        ),
        manager=SimpleNamespace(
            train_pixel_sampler=sampler, train_dataset=SimpleNamespace(cameras=ball_cameras(), frames=frames)
        ),
        to_scene=lambda points_m: (points_m - CENTRE_M) * SCALE,
        to_metres=lambda points: points / SCALE + CENTRE_M,
    )
