"""A small renderer of marker turntables with known truth, for the tests of the poses alone (grey, no shadows)."""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, look_at, project, rotation_about_z

CELLS = 7  # a 5 x 5 marker with its black border
TEXELS = 16  # texels a cell


@dataclass
class MarkerScene:
    """A container with plaques on a disc with markers, before a camera that stands still."""

    size_px: int = 128
    frames: int = 36
    fov_deg: float = 31.0
    elevation_deg: float = 17.0
    distance_m: float = 0.45
    target_height_m: float = 0.05
    marker_side_m: float = 0.03
    direction: int = 1
    jitter_deg: float = 0.0
    noise: float = 0.0
    blur_px: float = 0.0
    drop: tuple[int, ...] = ()
    blank: tuple[int, ...] = ()
    side_markers: int = 6
    disc_markers: int = 8
    turn_deg: float = 360.0
    displaced: tuple[int, ...] = ()
    wobble_deg: float = 0.0
    seed: int = 0
    dictionary: int = cv2.aruco.DICT_5X5_50

    def __post_init__(self):
        rng = np.random.default_rng(self.seed)
        steps = self.turn_deg / self.frames
        angles = self.direction * (np.arange(self.frames) * steps + rng.normal(0, 1, self.frames) * self.jitter_deg)
        keep = [i for i in range(self.frames) if i not in self.drop]
        self.angles_deg = (angles - angles[0])[keep]
        focal = self.size_px / 2 / np.tan(np.deg2rad(self.fov_deg) / 2)
        self.intrinsics = PinholeIntrinsics(
            self.size_px, self.size_px, focal, focal, self.size_px / 2, self.size_px / 2
        )
        elevation = np.deg2rad(self.elevation_deg)
        target = np.array([0.0, 0.0, self.target_height_m])
        eye = target + self.distance_m * np.array([np.cos(elevation), 0.0, np.sin(elevation)])
        self.first_camera_to_world = look_at(eye, target)
        self.camera_to_world = np.zeros((len(self.angles_deg), 4, 4))
        for i in range(len(self.angles_deg)):
            phase = np.deg2rad(2.0 * self.angles_deg[i])
            lean_deg = self.wobble_deg * np.array([np.cos(phase), np.sin(phase)])
            shift_m = np.zeros(3)
            if i in self.displaced:
                lean_deg, shift_m = lean_deg + np.array([0.8, -0.5]), np.array([0.0005, 0.0015, -0.0005])
            self.camera_to_world[i] = self._moved(i, lean_deg, shift_m)
        self.corners_m = {}
        half = self.marker_side_m / 2
        for k in range(self.side_markers):
            azimuth = 2 * np.pi * k / self.side_markers + 0.2
            out = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
            right, up = np.array([-out[1], out[0], 0.0]), np.array([0.0, 0.0, 1.0])
            self.corners_m[k] = 0.0455 * out + 0.035 * up + _square(right, up, half)
        for k in range(self.disc_markers):
            azimuth = 2 * np.pi * k / self.disc_markers
            out = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
            right, up = np.array([-out[1], out[0], 0.0]), -out
            self.corners_m[self.side_markers + k] = 0.072 * out + _square(right, up, half)
        self.blanked = {keep.index(i) for i in self.blank}

    def _moved(self, frame, lean_deg, shift_m):
        """The frame's pose if the table leans about the disc's middle, and shifts, in the room."""
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec(np.deg2rad([*lean_deg, 0.0])).as_matrix()
        motion[:3, 3] = shift_m
        return rotation_about_z(-self.angles_deg[frame]) @ np.linalg.inv(motion) @ self.first_camera_to_world

    def render(self) -> list[np.ndarray]:
        rng = np.random.default_rng(self.seed + 1)
        images = []
        for i, pose in enumerate(self.camera_to_world):
            image = self._render(pose, i in self.blanked)
            image = image + rng.normal(0, 1, image.shape) * self.noise
            images.append(np.clip(np.round(image * 255), 0, 255).astype(np.uint8))
        return images

    def names(self) -> list[str]:
        return [f"frame_{i:03d}" for i in range(len(self.angles_deg))]

    def _render(self, pose, blank):
        over = max(4, 1024 // self.size_px)
        canvas = np.full((self.size_px * over, self.size_px * over), 0.35, np.float32)
        if not blank:
            self._fill(canvas, _ring(0.095, 0.0), pose, over, 0.8)
            for marker in range(self.side_markers, self.side_markers + self.disc_markers):
                self._paste(canvas, marker, pose, over, 0.9)
            self._fill(canvas, np.concatenate([_ring(0.045, 0.0), _ring(0.045, 0.07)]), pose, over, 0.6)
            for marker in range(self.side_markers):
                corners = self.corners_m[marker]
                centre = corners.mean(0)
                to_camera = pose[:3, 3] - centre
                cosine = centre[:2] @ to_camera[:2] / np.linalg.norm(centre[:2]) / np.linalg.norm(to_camera)
                if cosine > 0.05:
                    self._paste(canvas, marker, pose, over, 0.55 + 0.35 * cosine)
        if self.blur_px:
            canvas = cv2.GaussianBlur(canvas, (0, 0), self.blur_px * over)
        return cv2.resize(canvas, (self.size_px, self.size_px), interpolation=cv2.INTER_AREA)

    def _fill(self, canvas, points, pose, over, value):
        pixels, _ = project(points, pose, self.intrinsics)
        hull = cv2.convexHull((pixels * over - 0.5).astype(np.float32))
        cv2.fillConvexPoly(canvas, np.round(hull * 16).astype(np.int32), value, shift=4)

    def _paste(self, canvas, marker, pose, over, white):
        dictionary = cv2.aruco.getPredefinedDictionary(self.dictionary)
        cells = cv2.aruco.generateImageMarker(dictionary, marker, CELLS)
        margin = 1
        cells = np.pad(cells, margin, constant_values=255).astype(np.float32) / 255
        texture = np.kron(cells, np.ones((TEXELS, TEXELS), np.float32))
        texture = np.float32(white) * (0.08 + 0.92 * texture)
        size = CELLS * TEXELS
        corners = np.array([[0, 0], [size, 0], [size, size], [0, size]], np.float64) + margin * TEXELS
        pixels, _ = project(self.corners_m[marker], pose, self.intrinsics)
        homography = cv2.getPerspectiveTransform(corners.astype(np.float32), (pixels * over).astype(np.float32))
        to_centre, to_corner = np.eye(3), np.eye(3)
        to_centre[:2, 2], to_corner[:2, 2] = -0.5, 0.5
        homography = to_centre @ homography @ to_corner
        extent = texture.shape[0]
        outline = np.array([[[0, 0], [extent, 0], [extent, extent], [0, extent]]], np.float64) - 0.5
        quad = cv2.perspectiveTransform(outline, homography)
        # Only the part of the canvas around the marker is drawn.
        corner = np.clip(np.floor(quad[0].min(axis=0)).astype(int) - 1, 0, canvas.shape[0])
        left, top = corner
        right, bottom = np.clip(np.ceil(quad[0].max(axis=0)).astype(int) + 2, corner, canvas.shape[0])
        to_corner[:2, 2] = -corner
        part = canvas[top:bottom, left:right]
        if not part.size:
            return
        mask = np.zeros(part.shape, np.uint8)
        cv2.fillConvexPoly(mask, np.round((quad - corner) * 16).astype(np.int32), 1, shift=4)
        warped = cv2.warpPerspective(
            texture, to_corner @ homography, part.shape[::-1], flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        part[mask > 0] = warped[mask > 0]


def _square(right, up, half):
    """Corners of a marker, clockwise from its upper left as seen from outside."""
    return half * np.array([-right + up, right + up, right - up, -right - up])


def _ring(radius, height):
    a = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    return np.stack([radius * np.cos(a), radius * np.sin(a), np.full_like(a, height)], -1)


def detected_corners(
    image: np.ndarray, enlarge: int = 2, dictionary: int = cv2.aruco.DICT_5X5_50
) -> dict[int, np.ndarray]:
    """Corners (4, 2) in corner-origin pixels of an ``image`` (h, w) in [0, 1], by the marker's number."""
    enlarged = cv2.resize(image.astype(np.float32), None, fx=enlarge, fy=enlarge, interpolation=cv2.INTER_CUBIC)
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(dictionary), parameters)
    corners, numbers, _ = detector.detectMarkers(np.clip(enlarged * 255, 0, 255).astype(np.uint8))
    return {int(n): (c[0] + 0.5) / enlarge for n, c in zip(numbers.ravel(), corners, strict=True)}
