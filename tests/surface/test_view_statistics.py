import numpy as np
import torch

from hsi_sc_nerf.capture.envi import open_cube
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, look_at
from hsi_sc_nerf.packed.cube import FLAGGED, PixelFlag, pack, write_packed_cube
from hsi_sc_nerf.packed.pixels import PixelReader
from hsi_sc_nerf.surface.depth_renders import DepthRenders
from hsi_sc_nerf.surface.view_statistics import view_statistics

LENS = PinholeIntrinsics(8, 6, 20.0, 20.0, 4.0, 3.0)


def frames(folder, levels, bands: int = 3):
    """Frames from the same place, each of one reflectance in all its pixels."""
    cubes = []
    for index, level in enumerate(levels):
        path = folder / f"{index}.hdr"
        write_packed_cube(path, pack(np.full((LENS.h, LENS.w, bands), level)), np.arange(bands) + 500.0)
        cubes.append(path)
    pose = look_at(np.array([4.0, 0.0, 0.5]), np.zeros(3))
    renders = DepthRenders(
        camera_to_world=torch.from_numpy(np.stack([pose] * len(levels))).float(),
        intrinsics=LENS,
        distortion=(0.0, 0.0, 0.0, 0.0),
        depths=torch.full((len(levels), LENS.h, LENS.w), torch.inf),
        cell_px=1,
        masks=torch.ones(len(levels), LENS.h, LENS.w, dtype=torch.bool),
        points=np.zeros((0, 3)),
    )
    return renders, cubes


def columns(renders, cubes, points, flags=None, bands=(0, 1, 2)):
    reader = PixelReader([open_cube(path).memmap() for path in cubes])
    normals = torch.tensor([[1.0, 0.0, 0.0]]).expand(len(points), 3)
    near = np.full((len(points), len(bands)), 0.5, np.float32)
    return view_statistics(points, normals, near, np.array(bands), renders, reader, flags)


def test_statistics_of_frames_of_known_levels(tmp_path) -> None:
    renders, cubes = frames(tmp_path, [0.2, 0.4, 0.6])
    renders.masks[1:, :, : LENS.w // 2] = False
    points = torch.tensor([[0.0, 0.4, 0.0], [0.0, -0.4, 0.0], [0.0, 9.0, 0.0]])
    found = columns(renders, cubes, points)
    np.testing.assert_array_equal(np.sort(found["views"]), [0, 1, 3])
    all_three = found["views"] == 3
    np.testing.assert_allclose(found["spectral_std"][all_three], 0.2, atol=1e-4)
    assert np.isnan(found["spectral_std"][~all_three]).all()
    np.testing.assert_array_equal(found["saturated"], 0.0)


def test_flagged_values_are_left_out_and_their_fraction_is_given(tmp_path) -> None:
    renders, cubes = frames(tmp_path, [0.2, 0.4, 0.9, 0.9])
    spoiled = pack(np.full((LENS.h, LENS.w, 3), 0.9))
    spoiled[..., 1:] = FLAGGED
    write_packed_cube(cubes[2], spoiled, np.arange(3) + 500.0)
    flags = np.zeros((4, LENS.h, LENS.w), np.uint8)
    flags[2], flags[3] = PixelFlag.SATURATED, PixelFlag.DEAD
    found = columns(renders, cubes, torch.zeros(1, 3), flags)
    two, three = np.std([0.2, 0.4, 0.9], ddof=1), np.std([0.2, 0.4, 0.9, 0.9], ddof=1)
    np.testing.assert_allclose(found["spectral_std"], (2 * two + three) / 3, atol=1e-4)
    np.testing.assert_array_equal(found["saturated"], 0.25)
    only_first = columns(renders, cubes, torch.zeros(1, 3), flags, bands=(0,))
    np.testing.assert_allclose(only_first["spectral_std"], three, atol=1e-4)
