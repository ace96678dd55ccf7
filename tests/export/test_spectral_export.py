"""The surface of a ball that a model knows exactly: found, spread over evenly, seen by the right frames."""

import cv2
import numpy as np
import pytest
import torch
from known_ball import FRAMES, LENS, POSES, RADIUS, SIZE_PX, WAVELENGTHS_NM, BallModel, known_run, true_spectra

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.spatial import sample_surface
from hsi_sc_nerf.export import formats, spectral_export
from hsi_sc_nerf.export.cloud import read_spectral_ply
from hsi_sc_nerf.export.options import CloudOptions
from hsi_sc_nerf.export.spectral_export import export_cloud
from hsi_sc_nerf.geometry.camera import project
from hsi_sc_nerf.surface import surface_points as sampling
from hsi_sc_nerf.surface.depth_renders import render_depth_maps
from hsi_sc_nerf.surface.surface_depth import MIN_COSINE, SEARCH_DEPTH, SEARCH_STEPS, camera_rays, render_object
from hsi_sc_nerf.surface.surface_points import sample_surface_points

POINTS = 4000
STEP = 2 * SEARCH_DEPTH / SEARCH_STEPS  # of the search for the surface, whose hits are in the middle of a step


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return known_run(tmp_path_factory.mktemp("ball"))


@pytest.fixture(scope="module")
def cloud(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("cloud")
    return read_spectral_ply(export_cloud(run, folder, CloudOptions(num_points=POINTS, remove_outliers=False)))


def surface_points(run, count: int, **options):
    manager = run.manager
    cameras, masks = manager.train_dataset.cameras, manager.train_pixel_sampler.masks
    renders = render_depth_maps(run.model, cameras, masks, 4096, **options)
    return sample_surface_points(run.model, renders, count, 4096, np.array([[-0.6] * 3, [0.6] * 3]))


def frontal_cosine(points: np.ndarray) -> np.ndarray:
    """Of each point of the ball and the camera that sees it most from the front."""
    to_cameras = POSES[:, None, :3, 3] - points
    cosines = (to_cameras * points / RADIUS).sum(axis=-1) / np.linalg.norm(to_cameras, axis=-1)
    return cosines.max(axis=0)


def equal_area_patches(points: np.ndarray, rings: int = 10, sectors: int = 12) -> np.ndarray:
    """Number of points in patches of equal area of a sphere (Archimedes: equal steps of height and of angle)."""
    heights = np.clip(((points[:, 2] / RADIUS + 1) / 2 * rings).astype(int), 0, rings - 1)
    angles = ((np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5) * sectors).astype(int) % sectors
    return np.bincount(heights * sectors + angles, minlength=rings * sectors).reshape(rings, sectors)


@pytest.mark.slow
def test_points_lie_on_the_surface_and_at_their_image_coordinates(run):
    found = surface_points(run, POINTS)
    assert len(found) == POINTS
    np.testing.assert_allclose(np.linalg.norm(found.points, axis=1), RADIUS, atol=STEP)
    facing = (found.mesh_normals * found.points).sum(axis=1) / RADIUS
    assert facing.mean() > 0.98
    assert np.quantile(facing, 0.01) > 0.9  # the mesh is of 33 voxels, and rougher where it ends
    for frame in range(FRAMES):
        mine = found.frames == frame
        xy_px, _ = project(found.points[mine], POSES[frame], LENS)
        np.testing.assert_allclose(found.xy_px[mine], xy_px, atol=0.1)


def test_without_a_background_nothing_is_removed_from_a_spectrum(run, monkeypatch):
    cameras = run.manager.train_dataset.cameras

    def centre_ray():
        return camera_rays(cameras, np.array([0]), np.full((1, 2), SIZE_PX / 2.0), "cpu")

    outputs, spectra = render_object(run.model, centre_ray())
    torch.testing.assert_close(outputs["spectral"], 0.9 * spectra + 0.1 * 0.1)
    monkeypatch.setattr(run.model, "background", None)
    outputs, spectra = render_object(run.model, centre_ray())
    torch.testing.assert_close(spectra, outputs["spectral"])


def test_points_are_spread_evenly_over_what_is_seen(cloud, run):
    points = run.to_scene(cloud.points)
    counts = equal_area_patches(points)
    # Rings 3 to 8 are seen from the front from everywhere; the lowest are not seen at all.
    assert counts[0].sum() == 0
    middle = counts[3:9]
    # Points thrown at the ball by chance give 0.15, rays through random pixels 0.32.
    assert middle.std() / middle.mean() < 0.12
    assert frontal_cosine(points).min() > MIN_COSINE - 0.12  # the mesh is of 33 voxels


def test_the_cloud_has_the_true_spectra_and_columns(cloud, run):
    points = run.to_scene(cloud.points)
    np.testing.assert_array_equal(cloud.wavelengths_nm, WAVELENGTHS_NM)
    np.testing.assert_allclose(cloud.spectra, true_spectra(points), atol=2e-3)
    np.testing.assert_allclose(cloud.extra["opacity"], 0.9, atol=1e-6)
    np.testing.assert_allclose(cloud.colours, true_spectra(points)[:, [3, 1, 0]] * 255, atol=1.5)
    assert list(cloud.extra) == ["opacity", "incidence_deg", "views", "spectral_std", "saturated"]
    to_cameras = POSES[:, None, :3, 3] - points
    outward = points / np.linalg.norm(points, axis=1, keepdims=True)
    cosines = (to_cameras * outward).sum(axis=-1) / np.linalg.norm(to_cameras, axis=-1)
    # Where several frames see a point, it is that which sees it most from the front.
    expected_deg = np.rad2deg(np.arccos(cosines.max(axis=0)))
    assert np.abs(cloud.extra["incidence_deg"] - expected_deg).max() < 15.0
    assert np.abs(cloud.extra["incidence_deg"] - expected_deg).mean() < 3.0
    # The mesh's normals and the masks' edges are as coarse as the pixels.
    clear = (np.abs(cosines - MIN_COSINE) > 0.2).all(axis=0)
    differs = cloud.extra["views"][clear] != (cosines > MIN_COSINE).sum(axis=0)[clear]
    assert clear.sum() > 50
    assert differs.mean() < 0.05
    # A pixel covers 0.03 units from the front, over which the reflectance differs by at most 0.0075.
    assert np.nanmean(cloud.extra["spectral_std"]) < 0.0075 / 2
    assert np.nanmax(cloud.extra["spectral_std"]) < 0.015
    assert not cloud.extra["saturated"].any()
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1.0, atol=1e-6)
    off_deg = np.rad2deg(np.arccos(np.clip((cloud.normals * outward).sum(axis=1), -1.0, 1.0)))
    assert off_deg.mean() < 1.5  # the mesh is of 33 voxels
    assert off_deg.max() < 5.0


def test_a_box_keeps_what_lies_in_it_and_the_number_of_points(run, tmp_path):
    box = (-1.0, -1.0, 0.07, 1.0, 1.0, 1.0)
    options = CloudOptions(num_points=500, remove_outliers=False, roi_box=box, bands=("600-700",))
    cloud = read_spectral_ply(export_cloud(run, tmp_path, options))
    assert cloud.spectra.shape == (500, 2)
    assert cloud.points[:, 2].min() > 0.07
    with pytest.raises(InputError, match="no point of the object lies in"):
        export_cloud(run, tmp_path / "none", CloudOptions(num_points=500, roi_box=(1, 1, 1, 2, 2, 2)))
    assert not (tmp_path / "none").exists()


@pytest.fixture
def tried(monkeypatch):
    """Number of candidates of each batch."""
    counts = []

    def counted(vertices, triangles, count, seed):
        counts.append(count)
        return sample_surface(vertices, triangles, count, seed)

    monkeypatch.setattr(sampling, "sample_surface", counted)
    return counts


@pytest.mark.slow
def test_a_small_region_is_searched_only_near_it(run, tmp_path, tried):
    box = (0.05, -0.0215, 0.0585, 0.07, -0.0185, 0.0615)  # 9 mm2 of the ball's 31,000
    cloud = read_spectral_ply(export_cloud(run, tmp_path, CloudOptions(num_points=300, roi_box=box)))
    assert 280 <= len(cloud) <= 300
    np.testing.assert_allclose(np.ptp(cloud.points[:, 1:], axis=0), 0.003, rtol=0.05)
    assert sum(tried) < 60_000


def test_a_region_with_hardly_any_surface_gives_what_it_has(run, tmp_path, tried, monkeypatch, capsys):
    monkeypatch.setattr(sampling, "MAX_BATCH", 2000)
    monkeypatch.setattr(sampling, "MAX_CANDIDATES", 1)
    box = (0.05, -0.0215, 0.0585, 0.07, -0.0185, 0.0615)
    options = CloudOptions(num_points=2000, roi_box=box, remove_outliers=False)
    count = len(read_spectral_ply(export_cloud(run, tmp_path, options)))
    assert 0 < count < 1000
    assert max(tried) <= 2000
    assert f"Only {count} points were found" in " ".join(capsys.readouterr().out.split())


def test_a_few_points_are_no_outliers_and_a_cloud_is_never_empty(run, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(run.dataset, "metric", False)
    path = export_cloud(run, tmp_path / "[bold]", CloudOptions(num_points=2))
    assert len(read_spectral_ply(path)) == 2
    assert not read_spectral_ply(path).metric
    assert str(path) in capsys.readouterr().out
    monkeypatch.setattr(spectral_export, "statistical_inliers", lambda *_: np.zeros(0, int))
    with pytest.raises(InputError, match="every point counts as an outlier"):
        export_cloud(run, tmp_path / "none", CloudOptions(num_points=100))
    assert not (tmp_path / "none").exists()


def test_clouds_that_cannot_be_written_are_refused_before_rendering(run, tmp_path, monkeypatch):
    monkeypatch.setattr(spectral_export, "render_depth_maps", lambda *_: pytest.fail("the model was rendered"))
    with pytest.raises(InputError, match=r"holds no mask of a training frame.*ball_000\.png"):
        export_cloud(run, tmp_path, CloudOptions(roi_masks=tmp_path))
    monkeypatch.setattr(formats, "LAS_MAX_DIMENSIONS", 10)
    (tmp_path / "point_cloud.zarr").mkdir()
    for file_format, message in (("las", r"LAS has room for \d bands"), ("zarr", "is not a Zarr folder")):
        pytest.importorskip({"las": "laspy"}.get(file_format, file_format))
        with pytest.raises(InputError, match=message):
            export_cloud(run, tmp_path, CloudOptions(format=file_format))


@pytest.mark.slow
def test_a_painted_mask_keeps_what_its_frame_sees_in_it(run, tmp_path, capsys):
    painted = np.zeros((LENS.h, LENS.w), np.uint8)
    painted[:, : LENS.w // 2] = 255
    (tmp_path / "roi").mkdir()
    cv2.imwrite(str(tmp_path / "roi" / "ball_003.png"), painted)
    options = CloudOptions(num_points=500, remove_outliers=False, roi_masks=tmp_path / "roi")
    cv2.imwrite(str(tmp_path / "roi" / "nobody.png"), painted)
    points = run.to_scene(read_spectral_ply(export_cloud(run, tmp_path, options)).points)
    assert "they are of no training frame: nobody.png" in " ".join(capsys.readouterr().out.split())
    xy_px, _ = project(points, POSES[3], LENS)
    assert len(points) == 500
    assert xy_px[:, 0].max() < LENS.w / 2 + 0.1
    assert ((POSES[3][:3, 3] - points) * points).sum(axis=1).min() > 0


@pytest.mark.slow
def test_keep_turntable_keeps_the_turntable(run, tmp_path):
    """The object's box and mask cut the ball to its upper half; without them all of it is there."""
    cut = known_run(tmp_path / "cut")
    cut.dataset.object_box_m[0, 2] = 0.06
    for keep, lowest in ((False, 0.0), (True, -0.5)):
        options = CloudOptions(num_points=500, keep_turntable=keep)
        points = cut.to_scene(read_spectral_ply(export_cloud(cut, tmp_path, options)).points)
        assert lowest - 1e-3 < points[:, 2].min() < lowest + 0.3


@pytest.mark.slow
def test_nerfstudios_options_work(run, tmp_path):
    def exported(**options):
        return read_spectral_ply(export_cloud(run, tmp_path, CloudOptions(num_points=300, **options)))

    crop = exported(obb_center=(0.0, 0.5, 0.0), obb_rotation=(0.0, 0.0, np.pi / 4), obb_scale=(0.4, 0.4, 2.0))
    turned = run.to_scene(crop.points)[:, :2] - (0.0, 0.5)
    turned = turned @ np.array([[1, -1], [1, 1]]) / np.sqrt(2)
    assert np.abs(turned).max() < 0.2 + 1e-4
    assert (np.abs(turned).max(axis=0) > 0.19).all()
    outward = exported(normal_method="open3d")
    assert ((outward.normals * run.to_scene(outward.points)).sum(axis=1) / RADIUS > 0.9).all()


@pytest.mark.slow
def test_normals_are_those_of_the_surface_and_not_of_a_noisy_density(run, tmp_path, monkeypatch):
    """The gradient of a trained density is off by 10 to 30 degrees; here it is noise."""
    monkeypatch.setattr(run.model.field, "density_gradient", torch.randn_like)
    cloud = read_spectral_ply(export_cloud(run, tmp_path, CloudOptions(num_points=300)))
    cosines = (cloud.normals * run.to_scene(cloud.points)).sum(axis=1) / RADIUS
    assert np.rad2deg(np.arccos(np.clip(cosines, -1.0, 1.0))).max() < 8.0


def test_a_model_without_an_object_is_refused(run, tmp_path):
    class Empty(BallModel):
        def __call__(self, rays):
            outputs = super().__call__(rays)
            return outputs | {"accumulation": torch.zeros_like(outputs["accumulation"])}

    empty = known_run(tmp_path / "empty")
    empty.model = Empty()
    with pytest.raises(InputError, match="holds no object"):
        export_cloud(empty, tmp_path / "out", CloudOptions(num_points=100))
    assert not (tmp_path / "out").exists()


def test_large_frames_share_depths_between_pixels(run):
    cameras, masks = run.manager.train_dataset.cameras, run.manager.train_pixel_sampler.masks
    renders = render_depth_maps(run.model, cameras, masks, 4096, max_rays=1000)
    assert renders.cell_px > 1
    assert renders.depths.isfinite().sum() < 1500
    found = surface_points(run, 500, max_rays=1000)
    # Edges of the mesh are as long as what a cell covers, and cut into the ball by the square of that over 8 radii.
    edge = np.linalg.norm(POSES[0, :3, 3]) * renders.cell_px / LENS.fl_x
    np.testing.assert_allclose(np.linalg.norm(found.points, axis=1), RADIUS, atol=STEP + edge**2 / (8 * RADIUS))
