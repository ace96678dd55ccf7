"""The light on a run's object, and the command: a ball under a lamp, whose irradiance is known in closed form."""

import ball_run
import capture_factory as factory
import numpy as np
import pytest

from hsi_sc_nerf.cli.light import bands_of, summary, with_material
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.spatial import sample_surface
from hsi_sc_nerf.export.cloud import SpectralCloud
from hsi_sc_nerf.geometry.camera import pixel_rays
from hsi_sc_nerf.light.of_run import light_of_run
from hsi_sc_nerf.models.trained_run import open_run
from hsi_sc_nerf.packed.cube import pack, write_packed_cube
from hsi_sc_nerf.packed.dataset import open_packed

TO_LAMP = np.array([-0.45, 0.3, 0.84]) / np.linalg.norm([-0.45, 0.3, 0.84])
LAMP = 0.5
FACING = np.array([0.0, 0.0, 1.0])


def irradiance(normals, camera_to_world):
    """On the ball without its surroundings, relative to a white reference that faces the camera."""
    cosines = np.maximum(normals @ camera_to_world[:3, :3] @ TO_LAMP, 0.0)
    return (1.0 - LAMP + LAMP * cosines) / (1.0 - LAMP + LAMP * TO_LAMP[2])


def open_lit_ball(root, lit):
    dataset = open_packed(ball_run.write_ball_dataset(root / "data"))
    for frame in dataset.frames if lit else ():
        mask = frame.mask()
        line, sample = np.nonzero(mask)
        pixels = np.stack([sample, line], axis=1) + 0.5
        origin, directions = pixel_rays(dataset.intrinsics, frame.camera_to_world, pixels)
        to_centre = factory.SPHERE_CENTRE_M - origin
        along = directions @ to_centre
        hidden = to_centre @ to_centre - along**2
        depth = along - np.sqrt(np.maximum(factory.SPHERE_RADIUS_M**2 - hidden, 0.0))
        normals = (origin + depth[:, None] * directions - factory.SPHERE_CENTRE_M) / factory.SPHERE_RADIUS_M
        reflectance = np.broadcast_to(factory.BACKGROUND, (*mask.shape, factory.BANDS)).copy()
        reflectance[mask] = factory.PLANT * irradiance(normals, frame.camera_to_world)[:, None]
        write_packed_cube(frame.cube_path, pack(reflectance), factory.WAVELENGTHS_NM)
    run = open_run(ball_run.write_untrained_run(root / "data", root / "runs"))
    ball_run.fill_with_ball(run)
    return run


@pytest.fixture(scope="module")
def lit(tmp_path_factory):
    return light_of_run(open_lit_ball(tmp_path_factory.mktemp("lit"), lit=True), FACING)


@pytest.fixture(scope="module")
def even(tmp_path_factory):
    return light_of_run(open_lit_ball(tmp_path_factory.mktemp("even"), lit=False), FACING)


def upper_cloud(found, lit):
    """Points of the upper half, which the disc hardly shades, with what their most frontal frames measure of them."""
    run = found.run
    points = run.to_metres(sample_surface(found.mesh.vertices, found.mesh.triangles, 600))
    normals = points - factory.SPHERE_CENTRE_M
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    frames = run.manager.train_dataparser_outputs.metadata["turntable"]["frame_indices"]
    cameras = run.refined_poses_m()[frames]
    sight = cameras[:, :3, 3] - points[:, None]
    cosines = (normals[:, None] * sight).sum(axis=-1) / np.linalg.norm(sight, axis=-1)
    light = np.ones(len(points))
    if lit:
        light = np.array([irradiance(n, cameras[c]) for n, c in zip(normals, cosines.argmax(axis=1), strict=True)])
    cloud = SpectralCloud(
        points.astype(np.float32),
        normals.astype(np.float32),
        np.zeros((len(points), 3), np.uint8),
        (factory.PLANT * light[:, None]).astype(np.float32),
        factory.WAVELENGTHS_NM,
    )
    return cloud.select((cosines.max(axis=1) > 0.5) & (normals[:, 2] > 0.2))


def test_a_lamp_on_a_run_is_found_and_divided_out(lit):
    assert lit.evidence.shaded
    cloud = upper_cloud(lit, lit=True)
    corrected = with_material(cloud, lit, np.arange(factory.BANDS), corrected=True)
    assert list(corrected.extra)[-2:] == ["irradiance", "irradiance_std"]
    by_band, std = lit.irradiance(cloud.points.astype(float))
    for band, name in enumerate(list(corrected.extra)[: factory.BANDS]):
        np.testing.assert_allclose(corrected.extra[name] * by_band[:, band], cloud.spectra[:, band], rtol=1e-4)
    np.testing.assert_allclose(corrected.extra["irradiance_std"], std, rtol=1e-4)
    assert (std > 0.0).all()
    np.testing.assert_array_equal(corrected.spectra, cloud.spectra)
    assert summary(lit, corrected=True)["shaded"] is True


def test_even_light_is_left_alone(even):
    assert not even.evidence.shaded
    cloud = upper_cloud(even, lit=False)
    same = with_material(cloud, even, np.arange(factory.BANDS), corrected=False)
    np.testing.assert_array_equal(same.extra["material_400.00nm"], cloud.spectra[:, 0])
    np.testing.assert_array_equal(same.extra["irradiance"], 1.0)


def test_a_cloud_of_other_bands_is_refused(tmp_path):
    with pytest.raises(InputError):
        bands_of(np.array([500.0, 512.0]), np.array([500.0, 510.0]), tmp_path / "cloud.ply")
