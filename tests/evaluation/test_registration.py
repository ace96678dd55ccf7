import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.evaluation.registration import align_by_features, refine, robust_radius
from hsi_sc_nerf.evaluation.spatial import sample_surface
from hsi_sc_nerf.geometry.camera import Similarity


def surface(lumps: bool, count: int, seed: int) -> np.ndarray:
    """A ball of 40 mm, or one with lumps that no turn brings on to itself."""
    ball = trimesh.creation.icosphere(subdivisions=5)
    directions = np.asarray(ball.vertices)
    radius = np.full(len(directions), 0.04)
    if lumps:
        x, y, z = directions.T
        radius = 0.04 * (1 + 0.2 * z + 0.25 * x * y + 0.3 * np.exp(-8 * (1 - x)) + 0.2 * y**3 - 0.3 * x * z**2)
    return sample_surface(directions * radius[:, None], np.asarray(ball.faces), count, seed)


def spoilt(points: np.ndarray, sigma_m: float = 0.0003) -> np.ndarray:
    """With noise, a tenth of outliers, and an eighth of the surface missing."""
    rng = np.random.default_rng(7)
    kept = points[points[:, 2] > np.quantile(points[:, 2], 1 / 8)]
    kept = kept + rng.normal(0, sigma_m, kept.shape)
    outliers = rng.uniform(kept.min(0) - 0.02, kept.max(0) + 0.02, (len(kept) // 9, 3))
    return np.concatenate([kept, outliers])


def moved_by(scale: float, degrees: tuple[float, float, float], shift_m: tuple[float, float, float]) -> Similarity:
    return Similarity(scale, Rotation.from_euler("xyz", degrees, degrees=True).as_matrix(), np.array(shift_m))


def left_over_m(found: Similarity, moved: Similarity, points: np.ndarray) -> float:
    return float(np.linalg.norm(found.after(moved)(points) - points, axis=1).max())


REFERENCE, CLOUD = surface(True, 10_000, 0), surface(True, 4_000, 1)
FAR = ((100.0, -50.0, 160.0), (0.3, -0.2, 0.1))
NEAR = ((4.0, -3.0, 5.0), (0.002, -0.001, 0.003))


def test_similarities_compose_and_invert() -> None:
    first, second = moved_by(2.0, *FAR), moved_by(0.3, *NEAR)
    np.testing.assert_allclose(second.after(first)(CLOUD), second(first(CLOUD)), atol=1e-12)
    np.testing.assert_allclose(first.inverse()(first(CLOUD)), CLOUD, atol=1e-12)
    homogeneous = np.concatenate([CLOUD, np.ones((len(CLOUD), 1))], axis=1)
    np.testing.assert_allclose((homogeneous @ first.matrix().T)[:, :3], first(CLOUD), atol=1e-12)
    again = Similarity.from_matrix(first.matrix())
    np.testing.assert_allclose(again(CLOUD), first(CLOUD), atol=1e-12)
    assert moved_by(5, (0, 0, 30), (0, 0, 0)).turn_deg() == pytest.approx(30)


def test_a_robust_radius_is_the_balls_and_outliers_do_not_change_it() -> None:
    ball = surface(False, 5000, 0) + 3.0
    assert robust_radius(ball) == pytest.approx(0.04, rel=0.01)
    assert robust_radius(np.concatenate([ball, np.full((500, 3), 9.0)])) == pytest.approx(0.04, rel=0.1)


@pytest.mark.parametrize(("with_scale", "scale"), [(False, 1.0), (True, 1.05)])
def test_closest_points_undo_a_small_motion(with_scale: bool, scale: float) -> None:
    moved = moved_by(scale, *NEAR)
    found = refine(moved(CLOUD), REFERENCE, with_scale=with_scale)
    assert left_over_m(found.transform, moved, CLOUD) < 5e-5
    assert found.transform.scale == pytest.approx(1 / scale, rel=5e-4)
    worse = refine(moved(spoilt(CLOUD)), REFERENCE, with_scale=with_scale)
    assert left_over_m(worse.transform, moved, CLOUD) < 2e-4
    assert worse.transform.scale == pytest.approx(1 / scale, rel=2e-3)


def test_a_reference_with_a_missing_half_does_not_pull() -> None:
    moved = moved_by(1.0, *NEAR)
    found = refine(moved(CLOUD), REFERENCE[REFERENCE[:, 0] > 0])
    assert left_over_m(found.transform, moved, CLOUD) < 2e-4


@pytest.mark.slow
def test_features_align_from_anywhere_and_find_the_scale() -> None:
    scale = 0.37
    moved = moved_by(scale, *FAR)
    # A third of the other attitudes is enough to see that none of them is as good.
    found = align_by_features(moved(spoilt(CLOUD)), REFERENCE, True, lambda turns: turns[::3])
    assert found.rival is None
    assert left_over_m(found.transform, moved, CLOUD) < 2e-4
    assert found.transform.scale == pytest.approx(1 / scale, rel=2e-3)


@pytest.mark.slow
def test_features_do_not_say_how_a_ball_lies() -> None:
    ball = surface(False, 5000, 1)
    moved = moved_by(1.0, *FAR)
    found = align_by_features(moved(ball), surface(False, 10_000, 0))
    assert found.rival is not None
    assert found.rival.turn_deg > 10
    # Where it lies is known all the same.
    np.testing.assert_allclose(found.transform(moved(np.zeros((1, 3)))), 0, atol=1e-4)


@pytest.mark.slow
def test_a_box_fits_in_four_attitudes() -> None:
    box = trimesh.creation.box((0.03, 0.05, 0.08))
    near, far = (sample_surface(box.vertices, box.faces, count, seed) for count, seed in ((10_000, 0), (5000, 1)))
    found = align_by_features(moved_by(1.0, *FAR)(far), near)
    assert found.rival is not None
    assert found.rival.turn_deg == pytest.approx(180, abs=1)


def test_a_ball_without_scale_keeps_its_turn() -> None:
    ball = surface(False, 5000, 1)
    found = refine(ball + np.array([0.002, 0, 0]), surface(False, 20_000, 0))
    assert found.transform.turn_deg() < 1
    np.testing.assert_allclose(found.transform(np.array([[0.002, 0, 0]])), 0, atol=1e-4)
