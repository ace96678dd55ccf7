"""Objects that stand apart in one cloud are told apart and measured one by one."""

from dataclasses import replace

import numpy as np
import pytest
from standing_sphere import RADIUS_M, STAND_M, sphere_points

from hsi_sc_nerf.analysis.closed_mesh import MeshConfig
from hsi_sc_nerf.analysis.measured_pieces import measure_pieces, write_pieces
from hsi_sc_nerf.analysis.measurement import measure_traits
from hsi_sc_nerf.analysis.report import each_object
from hsi_sc_nerf.analysis.standing_pieces import one_piece, standing_pieces
from hsi_sc_nerf.cli.clouds import TraitsCommand
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import SpectralCloud
from hsi_sc_nerf.files import read_json
from hsi_sc_nerf.report.run_sections import traits_section

CONFIG = MeshConfig(octree_depth=5, base_height_m=STAND_M)


def balls(*scales_and_places) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points and normals of spheres of the usual one's size times a scale, moved in metres, and the ball of each."""
    points, normals = sphere_points(12000, above=-0.93)
    foot = np.array([0.0, 0.0, STAND_M])
    moved = [scale * (points - foot) + foot + place for scale, place in scales_and_places]
    ball = np.repeat(np.arange(len(moved)), len(points))
    return np.concatenate(moved), np.tile(normals, (len(moved), 1)), ball


def cloud_of(points, normals) -> SpectralCloud:
    colours, spectra = np.zeros((len(points), 3), np.uint8), np.full((len(points), 2), 0.5)
    return SpectralCloud(points, normals, colours, spectra, np.array([500.0, 600.0]))


def test_pieces_that_stand_apart_are_told_apart_by_size():
    points, _, ball = balls((0.6, [-0.06, 0, 0]), (1.0, [0.06, 0, 0]))
    order = np.random.default_rng(0).permutation(len(points))
    found = standing_pieces(points[order], CONFIG)
    assert [set(ball[order][piece]) for piece in found] == [{1}, {0}]
    assert sum(map(len, found)) == len(points)


@pytest.mark.parametrize("count", [200, 1000])
@pytest.mark.parametrize("seed", range(5))
def test_gaps_between_the_few_points_of_a_small_cloud_are_no_gaps_between_objects(count, seed):
    points, _, ball = balls((1.0, [-0.07, 0, 0]), (1.0, [0.07, 0, 0]))
    few = np.random.default_rng(seed).choice(len(points), 2 * count, replace=False)
    assert len(standing_pieces(points[few][ball[few] == 0], CONFIG)) == 1
    assert {frozenset(ball[few][piece]) for piece in standing_pieces(points[few], CONFIG)} == {
        frozenset({0}),
        frozenset({1}),
    }


@pytest.mark.parametrize(
    "second",
    [
        (1.0, [0, 2 * RADIUS_M + 0.0005, 0]),  # touches the first
        (0.4, [0, 0, 2 * RADIUS_M + 0.01]),  # hangs over it, as a stem that training left apart
        (0.1, [0, 2 * RADIUS_M, 0]),  # a speck
    ],
)
def test_what_is_no_object_of_its_own_belongs_to_the_other(second):
    points, _, _ = balls((1.0, [0, 0, 0]), second)
    (piece,) = standing_pieces(points, CONFIG)
    np.testing.assert_array_equal(piece, np.arange(len(points)))


@pytest.mark.slow
def test_each_object_is_measured_by_itself(tmp_path):
    points, normals, _ = balls((0.6, [-0.06, 0, 0]), (1.0, [0.06, 0, 0]))
    cloud = cloud_of(points, normals)
    with pytest.raises(InputError, match=r"2 objects.*--piece 1 to --piece 2"):
        measure_traits(cloud, mesh=CONFIG, splits=0)
    with pytest.raises(InputError, match=r"--piece is 3.* choose 1 to 2"):
        one_piece(cloud, 3, CONFIG)
    regions = {"top of the small": (-0.06, 0, STAND_M + 1.2 * RADIUS_M, 0.01)}
    measured = measure_pieces(cloud, mesh=CONFIG, splits=0, regions=regions)
    write_pieces(tmp_path, measured, "two balls")
    content = read_json(tmp_path / "traits.json", "")
    ball_l = 4000 * np.pi * RADIUS_M**3 / 3
    for number, (one, volume_l, x_m) in enumerate(
        zip(each_object(content), (ball_l, 0.6**3 * ball_l), (0.06, -0.06), strict=True), start=1
    ):
        assert one["size"]["volume_l"] == pytest.approx(volume_l, rel=0.02)
        assert one["centre_m"][0] == pytest.approx(x_m, abs=0.001)
        assert one["piece"] == number
        assert (tmp_path / f"piece-{number}" / "traits.md").is_file()
        assert ("top of the small" in one["regions"]) == (number == 2)
    section = traits_section(content, tmp_path / "traits.json")
    captions = [table.caption for table in section.blocks]
    assert [caption[:14] for caption in captions if "Size" in caption] == ["Piece 1. Size.", "Piece 2. Size."]
    assert [finding.sentence[:7] for finding in section.findings] == ["Piece 1", "Piece 2"]
    assert "wrong" not in (tmp_path / "traits.md").read_text()

    # The same folder again, with another number of objects.
    own = tmp_path / "piece-2" / "notes.txt"
    own.write_text("of the user")
    (tmp_path / "calibration_tissue.png").touch()
    write_pieces(tmp_path, measured[:1], "two balls", piece=1)
    assert {"traits.json", "traits.md", "mesh.ply", "spectra.csv"} < set(names := files_in(tmp_path))
    assert {name for name in names if name.startswith(("piece-", "calibration_"))} == {"piece-2/notes.txt"}
    write_pieces(tmp_path, [replace(one, settings={"metric": False}) for one in measured], "two balls")
    assert "Sizes are wrong" in (tmp_path / "traits.md").read_text()
    assert {name for name in files_in(tmp_path) if "/" not in name} == {"traits.json", "traits.md"}
    assert own.is_file()
    assert (tmp_path / "piece-1" / "region_spectra.png").is_file()


@pytest.mark.parametrize("far_m", [np.nan, np.inf, 1e6])
def test_a_point_that_is_nowhere_or_far_away_is_told(far_m):
    points, normals, _ = balls((1.0, [0, 0, 0]))
    points[7, 1] = far_m
    with pytest.raises(InputError, match=r"not finite or kilometres apart|too large for a smoothing radius"):
        measure_traits(cloud_of(points, normals), splits=0)


def files_in(folder):
    return [str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()]


def test_organs_are_proposed_of_clouds_of_one_object(tmp_path):
    with pytest.raises(InputError, match="leave out --piece or this option"):
        TraitsCommand(tmp_path / "cloud.ply", tmp_path / "out", piece=1, propose_regions=True).main()
    assert not any(tmp_path.iterdir())
