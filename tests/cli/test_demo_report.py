import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import matplotlib as mpl
import numpy as np
import pytest
from PIL import Image

from hsi_sc_nerf.cli import demo_report
from hsi_sc_nerf.cli.demo_report import draw_cloud, draw_spectra, draw_views
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.geometry.camera import OPENCV_TO_OPENGL, PinholeIntrinsics

WAVELENGTHS = np.linspace(400.0, 1000.0, 7)
RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)


def drawn(path: Path) -> np.ndarray:
    assert [file.name for file in path.parent.iterdir()] == [path.name]
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def where(picture: np.ndarray, colour: tuple[int, int, int], tolerance: int = 3) -> np.ndarray:
    """(row, column) of the pixels of a colour."""
    return np.argwhere((np.abs(picture - colour) <= tolerance).all(-1))


def plain(colour: tuple[int, int, int]) -> np.ndarray:
    return np.broadcast_to(np.array(colour, np.uint8), (20, 30, 3))


def test_views_stand_above_their_renderings(tmp_path: Path) -> None:
    path = tmp_path / "views.png"
    draw_views(path, [plain(RED)] * 2, [plain(GREEN) / 255.0] * 2, ["a", "b"])
    picture = drawn(path)
    red, green = (where(picture, colour) for colour in (RED, GREEN))
    assert len(red) == pytest.approx(len(green), rel=0.05)
    assert len(red) > 2000
    assert red[:, 0].max() < green[:, 0].min()


def test_marked_points_lie_where_their_pixels_are(tmp_path: Path) -> None:
    spectra = np.linspace(0.1, 0.6, 14).reshape(2, 7)
    path = tmp_path / "spectra.png"
    draw_spectra(
        path, WAVELENGTHS, spectra, spectra + 0.01, ["skin", "bruise"], plain(RED), np.array([[5, 5], [25, 15]])
    )
    picture = drawn(path)
    red = where(picture, RED)
    (top, left), (bottom, right) = red.min(0), red.max(0)
    for colour, (x, y) in (((0x00, 0x72, 0xB2), (5, 5)), ((0xD5, 0x5E, 0x00), (25, 15))):
        marks = where(picture, colour)
        marks = marks[(marks >= (top, left)).all(1) & (marks <= (bottom, right)).all(1)]
        row, column = (marks.max(0) + marks.min(0)) / 2
        assert (column - left) / (right - left) * 30 == pytest.approx(x, abs=0.3)
        assert (row - top) / (bottom - top) * 20 == pytest.approx(y, abs=0.3)


def test_a_marked_pixel_has_the_spectrum_of_the_points_that_the_lens_shows_there(monkeypatch) -> None:
    camera, distortion = PinholeIntrinsics(128, 128, 230.0, 230.0, 64.0, 64.0), np.array([-0.9, 0.0, 0.0, 0.0])
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-0.2, 0.2, 400)]))
    points = np.stack([x, y, np.full_like(x, 0.5)], axis=-1)  # before a camera at the origin that looks along z
    shown = cv2.projectPoints(points, np.zeros(3), np.zeros(3), camera.matrix(), distortion)[0][:, 0]
    frame = SimpleNamespace(
        mask=lambda: np.ones((128, 128), bool),
        cube=lambda: np.zeros((128, 128, 7), np.uint16),
        pseudo_rgb=lambda: np.zeros((128, 128, 3), np.uint8),
        camera_to_world=OPENCV_TO_OPENGL,
    )
    dataset = SimpleNamespace(frames=[frame], intrinsics=camera, distortion=distortion, wavelengths_nm=WAVELENGTHS)
    drawn = []
    monkeypatch.setattr(demo_report, "draw_spectra", lambda *given: drawn.append(given))
    # The first band of a point's spectrum is the column that shows it, the others the line.
    demo_report._draw_marked_spectra(Path("spectra.png"), dataset, points, shown[:, [0] + [1] * 6])
    ((_, _, _, reconstructed, *_, pixels),) = drawn
    np.testing.assert_allclose(reconstructed[:, :2], pixels, atol=0.3)


@pytest.mark.slow
def test_the_nearer_side_hides_the_farther(tmp_path: Path) -> None:
    # Two squares before and behind the axis seen from the camera (+x), the nearer one first in the list.
    y, z = (grid.ravel() for grid in np.meshgrid(np.linspace(-0.03, 0.03, 60), np.linspace(0.0, 0.06, 60)))
    near, far = (np.stack([np.full_like(y, x), y, z], -1) for x in (0.02, -0.02))
    colours = np.concatenate([np.full((3600, 3), RED, np.uint8), np.full((3600, 3), BLUE, np.uint8)])
    draw_cloud(tmp_path / "cloud.png", np.concatenate([near, far]), colours)
    picture = drawn(tmp_path / "cloud.png")[:, :580]  # the first of three sides
    assert len(where(picture, RED)) > 10_000
    assert len(where(picture, BLUE)) < 0.02 * len(where(picture, RED))


@pytest.mark.slow
def test_from_above_the_camera_is_at_the_bottom_and_from_the_left_on_the_right(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    points = random.uniform((-0.03, -0.03, 0.0), (0.03, 0.03, 0.06), (4000, 3))
    colours = np.where(points[:, :1] > 0, RED, BLUE).astype(np.uint8)
    draw_cloud(tmp_path / "cloud.png", points, colours)
    picture = drawn(tmp_path / "cloud.png")
    third = picture.shape[1] // 3
    left, above = picture[:, third : 2 * third], picture[:, 2 * third :]
    assert np.median(where(left, RED)[:, 1]) > np.median(where(left, BLUE)[:, 1]) + third // 4
    assert np.median(where(above, RED)[:, 0]) > np.median(where(above, BLUE)[:, 0]) + third // 4


@pytest.mark.slow
def test_a_stray_point_does_not_shrink_the_object(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(-0.03, 0.03, (5000, 3))
    colours = np.full((5001, 3), RED, np.uint8)
    draw_cloud(tmp_path / "cloud.png", np.concatenate([points, [[0.0, 9.0, 0.0]]]), colours)
    assert len(where(drawn(tmp_path / "cloud.png"), RED)) > 100_000


def test_a_picture_that_cannot_be_written_is_named_and_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "views.png").mkdir()
    with pytest.raises(InputError, match=r"views\.png"):
        draw_views(tmp_path / "views.png", [plain(RED)], [plain(GREEN)], ["a"])
    assert [file.name for file in tmp_path.iterdir()] == ["views.png"]


@pytest.mark.slow
def test_matplotlibs_global_state_stays_as_it_was(tmp_path: Path) -> None:
    before = mpl.rcParams["font.size"], mpl.rcParams["axes.grid"]
    draw_views(tmp_path / "views.png", [plain(RED)], [plain(GREEN)], ["a"])
    assert (mpl.rcParams["font.size"], mpl.rcParams["axes.grid"]) == before
    program = "import sys, hsi_sc_nerf.cli.demo_report; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0
