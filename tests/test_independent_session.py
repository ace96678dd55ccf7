"""The path-traced session: its files open as a SPECIM IQ's, and its truth is what the pictures show."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from seen_markers import detected_corners

pytest.importorskip("mitsuba", reason="Mitsuba is not installed")

from hsi_sc_nerf.capture.session import open_session
from hsi_sc_nerf.geometry.camera import OPENCV_TO_OPENGL

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))


@pytest.mark.slow
def test_pictures_show_markers_fruit_and_drift_where_the_truth_says(tmp_path):
    import independent_session

    independent_session.IndependentSession(tmp_path / "s", frames=2, size=128, rays=4).main()
    session = open_session(tmp_path / "s")
    truth = json.loads((tmp_path / "s" / "truth" / "truth.json").read_text())
    masks = np.load(tmp_path / "s" / "truth" / "masks.npz")
    assert session.frames[0].integration_time_ms == 98.0
    dark, white = (session.white.dark.read().mean(axis=0), session.white.cube.read())
    signal = np.median(white[48:80, 48:80], axis=(0, 1)) - dark
    wall = []
    for capture, frame in zip(session.frames, truth["frames"], strict=True):
        reflectance = (capture.cube.read() - capture.dark.read().mean(axis=0)) / signal
        to_camera = np.linalg.inv(np.array(frame["camera_to_world"]) @ OPENCV_TO_OPENGL)
        rotation, _ = cv2.Rodrigues(to_camera[:3, :3])
        k = truth["intrinsics"]
        camera = np.array([[k["fl_x"], 0, k["cx"]], [0, k["fl_y"], k["cy"]], [0, 0, 1]])
        seen = detected_corners(reflectance[..., 100:140].mean(axis=-1), 4, cv2.aruco.DICT_4X4_50)
        assert len(seen) >= 3
        for number, corners in seen.items():
            layout = np.array(truth["marker_layout"][str(number)])
            expected, _ = cv2.projectPoints(layout, rotation, to_camera[:3, 3], camera, None)
            assert np.abs(corners - expected[:, 0]).max() < 2.0
        # The fruit reflects far more in the infrared than at 500 nm, as the container below it does not.
        ratio = reflectance[..., 150] / reflectance[..., 36]
        assert np.median(ratio[masks[frame["capture"]] > 0.9]) > 3.0
        wall.append(reflectance[:16].mean(axis=(0, 1)) / np.array(frame["drift"]))
    np.testing.assert_allclose(wall[1], wall[0], rtol=0.02)
