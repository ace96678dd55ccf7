import numpy as np
import pytest
import torch

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, look_at, pixel_rays, project, turntable_camera_to_world
from hsi_sc_nerf.surface.depth_renders import DepthRenders
from hsi_sc_nerf.surface.regions import visual_hull_region
from hsi_sc_nerf.surface.surface_depth import MIN_COSINE

LENS = PinholeIntrinsics(64, 48, 80.0, 79.0, 33.0, 25.0)
POSES = np.stack([turntable_camera_to_world(look_at(np.array([4.0, 0, 0.5]), np.zeros(3)), a) for a in (0, 90, 180)])
SECOND_BALL = np.array([1.6, 0.0, 0.0])


def distance_to_balls(pose: np.ndarray, cell_px: int, balls: list[tuple[np.ndarray, float]]) -> np.ndarray:
    """Depth map of balls, by centre and radius."""
    columns, rows = np.meshgrid(np.arange(-(-LENS.w // cell_px)), np.arange(-(-LENS.h // cell_px)))
    origin, directions = pixel_rays(LENS, pose, (np.stack([columns, rows], axis=-1) + 0.5) * cell_px)
    depth = np.full(rows.shape, np.inf)
    for centre, radius in balls:
        along = (directions * (centre - origin)).sum(axis=-1)
        inside = along**2 - ((centre - origin) ** 2).sum() + radius**2
        depth = np.fmin(depth, np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), np.inf))
    return depth


def ball_renders(device: str, balls: list[tuple[np.ndarray, float]], cell_px: int = 1) -> DepthRenders:
    depths = np.stack([distance_to_balls(pose, cell_px, balls) for pose in POSES])
    return DepthRenders(
        camera_to_world=torch.from_numpy(POSES).float().to(device),
        intrinsics=LENS,
        distortion=(0.0, 0.0, 0.0, 0.0),
        depths=torch.from_numpy(depths).float().to(device),
        cell_px=cell_px,
        masks=torch.ones(len(POSES), LENS.h, LENS.w, dtype=torch.bool, device=device),
        points=np.zeros((0, 3)),
    )


def on_unit_ball(count: int, device: str) -> torch.Tensor:
    points = np.random.default_rng(0).normal(size=(count, 3))
    return torch.from_numpy(points / np.linalg.norm(points, axis=1, keepdims=True)).float().to(device)


def visible(renders: DepthRenders, points: torch.Tensor) -> np.ndarray:
    """Which points of the unit ball each frame sees."""
    return torch.stack([view.visible for view in renders.views(points, points)]).cpu().numpy()


def cosines(points: torch.Tensor) -> np.ndarray:
    to_cameras = POSES[:, None, :3, 3] - points.cpu().numpy()
    return (to_cameras * points.cpu().numpy()).sum(axis=-1) / np.linalg.norm(to_cameras, axis=-1)


@pytest.mark.parametrize("cell_px", [1, 3])
def test_a_ball_is_seen_where_it_faces_the_camera(device: str, cell_px: int) -> None:
    points = on_unit_ball(2000, device)
    renders = ball_renders(device, [(np.zeros(3), 1.0)], cell_px)
    seen = visible(renders, points)
    np.testing.assert_array_equal(seen, cosines(points) > MIN_COSINE)
    assert 0.2 < seen.mean() < 0.6


def test_what_stands_before_it_hides_it(device: str) -> None:
    points = on_unit_ball(2000, device)
    renders = ball_renders(device, [(np.zeros(3), 1.0), (SECOND_BALL, 0.3)])
    seen = visible(renders, points)
    eye = POSES[0, :3, 3]
    to_points = points.cpu().numpy() - eye
    directions = to_points / np.linalg.norm(to_points, axis=1, keepdims=True)
    along = directions @ (SECOND_BALL - eye)
    missed_by = np.linalg.norm(SECOND_BALL - eye - along[:, None] * directions, axis=1)
    certain = np.abs(missed_by - 0.3) > 0.06  # a pixel
    expected = (cosines(points)[0] > MIN_COSINE) & (missed_by > 0.3)
    np.testing.assert_array_equal(seen[0][certain], expected[certain])
    assert ((cosines(points)[0] > MIN_COSINE) & ~expected).sum() > 20
    np.testing.assert_array_equal(seen[1], cosines(points)[1] > MIN_COSINE)


def test_image_coordinates_are_the_projection_and_nothing_outside_is_seen(device: str) -> None:
    points = 3.0 * on_unit_ball(500, device)
    renders = ball_renders(device, [])
    for pose, view in zip(POSES, renders.views(points, points / 3.0), strict=True):
        xy_px, depth = project(points.cpu().numpy().astype(float), pose, LENS)
        front = depth > 0.1
        np.testing.assert_allclose(view.xy_px.cpu().numpy()[front], xy_px[front], rtol=1e-4, atol=1e-2)
        inside = front & (xy_px > 0).all(axis=1) & (xy_px < (LENS.w, LENS.h)).all(axis=1)
        assert not view.visible.cpu().numpy()[~inside].any()
        assert 0 < inside.sum() < front.sum()


def test_nothing_is_seen_outside_the_mask(device: str) -> None:
    renders = ball_renders(device, [(np.zeros(3), 1.0)])
    renders.masks[:, :, : LENS.w // 2] = False
    points = on_unit_ball(1000, device)
    for view in renders.views(points, points):
        assert view.visible.any()
        assert (view.xy_px[view.visible][:, 0] >= LENS.w // 2).all()


def test_the_most_frontal_frame_is_selected(device: str) -> None:
    points = on_unit_ball(1000, device)
    frames, xy_px, frontal_cosines = ball_renders(device, [(np.zeros(3), 1.0)]).most_frontal(points, points)
    expected = np.where(cosines(points).max(axis=0) > MIN_COSINE, cosines(points).argmax(axis=0), -1)
    np.testing.assert_array_equal(frames.cpu().numpy(), expected)
    largest = cosines(points).max(axis=0).clip(MIN_COSINE)
    np.testing.assert_allclose(frontal_cosines.cpu().numpy(), largest, atol=1e-5)
    for frame, pose in enumerate(POSES):
        mine = expected == frame
        projected, _ = project(points.cpu().numpy()[mine].astype(float), pose, LENS)
        np.testing.assert_allclose(xy_px.cpu().numpy()[mine], projected, atol=1e-2)


def test_points_that_most_frames_see_beside_the_mask_are_not_the_objects(device: str) -> None:
    points = on_unit_ball(4000, device)
    renders = ball_renders(device, [(np.zeros(3), 1.0)])
    seen = visible(renders, points)
    renders.masks[1] = False
    beside = torch.stack([view.beside_mask for view in renders.views(points, points)]).cpu().numpy()
    np.testing.assert_array_equal(beside, seen & (np.arange(3) == 1)[:, None])
    frames = renders.most_frontal(points, points)[0].cpu().numpy()
    alone, shared = seen[1] & ~seen[0] & ~seen[2], seen[1] & (seen[0] ^ seen[2])
    assert alone.any()
    assert shared.any()
    assert (frames[alone] == -1).all()
    # As many see it on the mask as beside it: it is kept, and seen where it is on the mask.
    assert np.isin(frames[shared], (0, 2)).all()
    renders.masks[0] = False
    frames = renders.most_frontal(points, points)[0].cpu().numpy()
    assert (frames[seen[0] & seen[1]] == -1).all()


def test_beside_the_mask_only_the_space_before_the_support_is_known(device: str) -> None:
    """A ball on another one, which is what it stands on: the depth of the second says nothing of the first."""
    renders = ball_renders(device, [(np.zeros(3), 1.0), (SECOND_BALL, 0.3)])
    eye = torch.from_numpy(POSES[0, :3, 3]).float().to(device)
    towards = torch.nn.functional.normalize(torch.from_numpy(SECOND_BALL).float().to(device) - eye, dim=0)
    support = float(np.linalg.norm(SECOND_BALL - POSES[0, :3, 3]) - 0.3)
    points = eye + towards * torch.tensor([[support - 0.1], [support + 0.1]], device=device)
    assert torch.isfinite(renders.depth_at(0, points)[1]).all()
    renders.masks[0] = False
    distances, depths = renders.depth_at(0, points)
    np.testing.assert_allclose(distances.cpu(), [support - 0.1, support + 0.1], rtol=1e-4)
    np.testing.assert_allclose(depths.cpu(), [support, np.nan], atol=0.02)


def test_points_beside_the_object_in_some_frames_are_outside_the_visual_hull(device: str) -> None:
    renders = ball_renders(device, [(np.zeros(3), 1.0)])
    renders.masks[:] = torch.isfinite(renders.depths)
    hull = visual_hull_region(renders)
    points = on_unit_ball(500, device).cpu().numpy()
    assert hull.contains(points, points).all()
    assert hull.contains(0.3 * points, points).all()
    # Before and behind the ball in the first and the last frame, beside it in the one between them.
    beside = np.array([1.35, 0.0, 0.0]) + 0.05 * points
    assert not hull.contains(beside, points).any()
