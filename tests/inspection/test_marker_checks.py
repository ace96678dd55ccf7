import numpy as np
import pytest
from turntable_scene import MarkerScene

from hsi_sc_nerf.geometry.camera import project
from hsi_sc_nerf.inspection.marker_checks import frame_angles_deg


def exact_detections(scene: MarkerScene, noise_px: float = 0.0) -> list[dict]:
    """Corners of the disc's markers, and of the container's that face the camera."""
    rng = np.random.default_rng(0)
    detections = []
    for pose in scene.camera_to_world:
        seen = {}
        for marker, corners_m in scene.corners_m.items():
            outwards = corners_m.mean(0)[:2] @ (pose[:3, 3] - corners_m.mean(0))[:2]
            if marker >= scene.side_markers or outwards > 0.02:
                pixels, _ = project(corners_m, pose, scene.intrinsics)
                seen[marker] = pixels + rng.normal(0, noise_px, (4, 2)) if noise_px else pixels
        detections.append(seen)
    return detections


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("distance_m", [0.45, 2.0])
def test_angles_come_back(direction, distance_m):
    fov_deg = 31.0 * 0.45 / distance_m
    scene = MarkerScene(frames=18, direction=direction, jitter_deg=2.0, distance_m=distance_m, fov_deg=fov_deg)
    angles_deg = frame_angles_deg(exact_detections(scene, noise_px=0.1))
    error_deg = (angles_deg - scene.angles_deg + 180.0) % 360.0 - 180.0
    assert np.abs(error_deg - error_deg.mean()).max() < 3.0


def test_a_frame_that_shares_no_marker_has_no_angle():
    detections = exact_detections(MarkerScene(frames=12))
    detections[4] = {}
    detections[5] = {marker + 100: corners for marker, corners in detections[5].items()}
    angles_deg = frame_angles_deg(detections)
    assert np.flatnonzero(np.isnan(angles_deg)).tolist() == [4, 5]
    assert np.isnan(frame_angles_deg([{}, {}])).all()
