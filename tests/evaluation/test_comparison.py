import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from plyfile import PlyData, PlyElement
from random_cloud import random_cloud

from hsi_sc_nerf.cli.clouds import CompareCommand
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation import comparison
from hsi_sc_nerf.evaluation.comparison import CompareConfig, Comparison, compare, read_reference
from hsi_sc_nerf.evaluation.comparison_report import write_comparison
from hsi_sc_nerf.evaluation.registration import Registration, Rival
from hsi_sc_nerf.evaluation.spatial import sample_surface, score_at
from hsi_sc_nerf.export.cloud import write_spectral_ply
from hsi_sc_nerf.geometry.camera import Similarity
from hsi_sc_nerf.simulate.scores import seen_points, true_reference
from hsi_sc_nerf.simulate.truth import load_truth

RADIUS_M, CAMERA_M = 0.04, 0.2
BALL = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS_M)


def write_cloud(path: Path, points: np.ndarray) -> Path:
    rows = np.empty(len(points), [(axis, "f8") for axis in "xyz"])
    for axis, values in zip("xyz", points.T, strict=True):
        rows[axis] = values
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(path))
    return path


def on_ball(count: int, seed: int = 0) -> np.ndarray:
    return sample_surface(np.asarray(BALL.vertices), np.asarray(BALL.faces), count, seed)


def compared(cloud: Path, reference: Path, config: CompareConfig = CompareConfig()) -> Comparison:  # noqa: B008
    read = true_reference if reference.is_dir() else read_reference
    return compare(cloud, read(reference, config), config)


@pytest.fixture
def mesh(tmp_path: Path) -> Path:
    BALL.export(tmp_path / "ball.ply")
    return tmp_path / "ball.ply"


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """A session of one view from +x, which sees the ball from 0.2 m and whose picture lacks the ball below z = 0."""
    truth = tmp_path / "session" / "truth"
    (truth / "pixels").mkdir(parents=True)
    # Columns of the pose: the camera's right, up and backwards, and its place.
    pose = [[0, 0, 1, CAMERA_M], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]
    values = {
        "object": "ball",
        "intrinsics": {"w": 200, "h": 200, "fl_x": 400, "fl_y": 400, "cx": 100, "cy": 100},
        "frames": [{"capture": "ball_000", "angle_deg": 0, "camera_to_world": pose}],
        "marker_layout": {},
        "wavelengths_nm": [500, 600],
        "materials": ["skin"],
        "effects": {},
        "mesh": {"area_m2": BALL.area, "volume_m3": BALL.volume},
    }
    (truth / "truth.json").write_text(json.dumps(values))
    (truth / "endmembers.csv").write_text("wavelength_nm,skin\n500,0.5\n600,0.5\n")
    BALL.export(truth / "mesh.ply")
    coverage = np.ones((200, 200), np.float16)
    coverage[100:] = 0
    np.savez(truth / "pixels" / "ball_000.npz", object=coverage)
    return tmp_path / "session"


def test_a_view_sees_the_cap_that_faces_it_above_the_rim(session: Path) -> None:
    points = on_ball(20_000)
    seen = seen_points(load_truth(session), points, np.asarray(BALL.vertices), np.asarray(BALL.faces))
    # The cap of height r (1 - r / d), halved by the picture's lower half.
    assert seen.mean() == pytest.approx(0.5 * (1 - RADIUS_M / CAMERA_M) / 2, abs=0.01)
    expected = (points[:, 0] > RADIUS_M**2 / CAMERA_M) & (points[:, 2] > 0)
    assert np.mean(seen == expected) > 0.99


def test_recall_counts_what_is_seen_and_precision_the_whole(session: Path, tmp_path: Path) -> None:
    points = on_ball(20_000, seed=1)
    quarter = points[(points[:, 0] > RADIUS_M**2 / CAMERA_M) & (points[:, 2] > 0)]
    below = points[points[:, 2] < -0.01][:1000]
    cloud = write_cloud(tmp_path / "cloud.ply", np.concatenate([quarter, below]))
    found = compared(cloud, session, CompareConfig(points=10_000))
    score = score_at(found.to_reference_m, found.to_cloud_m, 0.002)
    assert found.alignment == "none"
    assert found.seen_fraction == pytest.approx(0.2, abs=0.01)
    assert (score.precision, score.recall) == pytest.approx((100, 100), abs=0.5)
    whole = compared(cloud, session, CompareConfig(points=10_000, whole_reference=True))
    assert whole.seen_fraction is None
    assert score_at(whole.to_reference_m, whole.to_cloud_m, 0.002).recall < 60


@pytest.mark.slow
def test_the_command_writes_figures_pictures_and_the_cloud(mesh: Path, tmp_path: Path) -> None:
    outliers = 1.5 * on_ball(1000, seed=2)
    cloud = write_cloud(tmp_path / "cloud.ply", np.concatenate([on_ball(9000, seed=1), outliers]))
    out = tmp_path / "out"
    CompareCommand(cloud, mesh, out, CompareConfig(align="none", points=5000)).main()
    assert {path.name for path in out.iterdir()} == {
        "comparison.md",
        "comparison.json",
        "curves.png",
        "distances.png",
        "distances.ply",
    }
    numbers = json.loads((out / "comparison.json").read_text())
    chosen = numbers["scores"]["chosen"]
    assert (chosen["threshold_m"], chosen["precision"]) == (0.002, 90)
    assert chosen["f_score"] == pytest.approx(2 * 90 * chosen["recall"] / (90 + chosen["recall"]))
    assert numbers["cloud_to_reference"]["largest_m"] == pytest.approx(0.5 * RADIUS_M, rel=0.01)
    picture = np.array(Image.open(out / "distances.png").convert("L"))
    assert (picture[[0, 1, -2, -1]] == 255).all()  # neither titles nor labels are cut
    assert "| 2.00 (the paper's) | 90.00 |" in (out / "comparison.md").read_text()
    vertices = PlyData.read(out / "distances.ply")["vertex"]
    assert vertices["scalar_distance_m"][:9000].max() < 1e-5
    np.testing.assert_allclose(vertices["scalar_distance_m"][9000:], 0.02, rtol=0.01)
    # Dark blue and yellow, the ends of the scale.
    assert vertices["blue"][0] > vertices["red"][0]
    assert vertices["red"][-1] > vertices["blue"][-1]


def test_a_mesh_against_itself_in_millimetres_is_exact(mesh: Path, tmp_path: Path) -> None:
    BALL.copy().apply_scale(1000).export(tmp_path / "mm.stl")
    found = compared(mesh, tmp_path / "mm.stl", CompareConfig(align="none", reference_unit="mm", points=2000))
    assert max(found.to_reference_m.max(), found.to_cloud_m.max()) < 1e-6
    with pytest.raises(InputError, match=r"1e\+03 times as large as .* \(--reference-unit"):
        compared(mesh, tmp_path / "mm.stl", CompareConfig(align="none", points=2000))
    with pytest.raises(InputError, match=r"mm\.stl: is 1e\+03 times as large.* in metres"):
        compared(tmp_path / "mm.stl", mesh, CompareConfig(align="none", points=2000))


def test_icp_brings_a_shifted_cloud_back(mesh: Path, tmp_path: Path) -> None:
    cloud = write_cloud(tmp_path / "cloud.ply", on_ball(3000, seed=1) + np.array([0.003, -0.002, 0.001]))
    found = compared(cloud, mesh, CompareConfig(align="icp", points=20_000))
    assert found.registration is not None
    np.testing.assert_allclose(found.registration.transform(np.array([[0.003, -0.002, 0.001]])), 0, atol=1e-4)
    assert found.to_reference_m.max() < 2e-4


def test_icp_is_as_good_on_a_survey_grid(tmp_path: Path) -> None:
    origin_m, shift_m = np.array([4.5e5, 5.2e6, 120.0]), np.array([0.003, -0.002, 0.001])
    reference = write_cloud(tmp_path / "reference.ply", on_ball(20_000) + origin_m)
    cloud = write_cloud(tmp_path / "cloud.ply", on_ball(3000, seed=1) + origin_m + shift_m)
    found = compared(cloud, reference, CompareConfig(align="icp", points=20_000))
    assert found.registration is not None
    np.testing.assert_allclose(found.registration.transform(origin_m[None] + shift_m) - origin_m, 0.0, atol=1e-4)


@pytest.mark.slow
def test_a_symmetric_shape_is_said_to_be_one(mesh: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = Registration(Similarity(), 0.001, Rival(90.0, 0.0001, 0.0001))
    monkeypatch.setattr(comparison, "align_by_features", lambda *_: found)
    with pytest.raises(InputError, match=r"turned by 90 degrees.* --align icp"):
        compared(mesh, mesh, CompareConfig(points=500))
    accepted = compared(mesh, mesh, CompareConfig(points=500, accept_symmetric=True))
    write_comparison(tmp_path / "out", accepted, "cloud", "reference")
    assert "Turned by 90 degrees it fits as well" in (tmp_path / "out" / "comparison.md").read_text()


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("missing.ply", None, "there is no such file"),
        ("cloud.las", "", "cannot be compared"),
        ("broken.ply", "ply\nformat ascii 1.0\nelement vertex 3\nend_header\n", "cannot be read"),
        ("nan.obj", "v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not finite"),
        ("flat.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no area"),
    ],
)
def test_files_that_cannot_be_compared(mesh: Path, tmp_path: Path, name: str, text: str | None, told: str) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    out = tmp_path / "out"
    with pytest.raises(InputError, match=f"{name}: .*{told}"):
        CompareCommand(tmp_path / name, mesh, out, CompareConfig(align="none", points=200)).main()
    assert not out.exists()


@pytest.mark.parametrize(
    ("config", "told"),
    [
        (CompareConfig(threshold_m=float("nan")), "--threshold-m is nan"),
        (CompareConfig(points=5), "--points is 5"),
        (CompareConfig(align="none", with_scale=True), "choose one"),
    ],
)
def test_settings_that_make_no_sense(mesh: Path, config: CompareConfig, told: str) -> None:
    with pytest.raises(InputError, match=told):
        compared(mesh, mesh, config)


def test_a_folder_without_truth_and_a_cloud_too_thin_to_align(mesh: Path, session: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has no truth"):
        compared(mesh, tmp_path)
    with pytest.raises(InputError, match="as for a simulated session"):
        compared(mesh, session, CompareConfig(with_scale=True))
    thin = write_cloud(tmp_path / "thin.ply", on_ball(20))
    with pytest.raises(InputError, match=r"thin\.ply: has 20 points, too few"):
        compared(thin, mesh, CompareConfig(points=500))


def test_lengths_without_a_scale_are_compared_with_their_like_or_with_a_scale(mesh: Path, tmp_path: Path) -> None:
    write_spectral_ply(tmp_path / "own.ply", random_cloud(200, metric=False))
    own, config = tmp_path / "own.ply", CompareConfig(align="none", points=200)
    for pair in ((own, mesh), (mesh, own)):
        with pytest.raises(InputError, match=r"own\.ply: nothing gave its scale.*--with-scale"):
            compared(*pair, config)
    assert compared(own, own, config).to_reference_m.max() == 0.0


def test_a_reference_of_one_point_is_told_to_be_too_small(mesh: Path, tmp_path: Path) -> None:
    point = write_cloud(tmp_path / "point.ply", np.zeros((1, 3)))
    with pytest.raises(InputError, match="times as large"):
        compared(mesh, point, CompareConfig(align="none", points=2000))
