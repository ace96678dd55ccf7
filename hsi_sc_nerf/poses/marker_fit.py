"""Sub-pixel marker corners: the marker's known pattern is fitted to the pixels that it covers.

In small markers, refining each corner on its own is biased by the cells beside it. All edges of the pattern together,
rendered through the pixel's area, give the corners to some hundredths of a pixel, and their covariance.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float
from scipy.special import ndtr

from hsi_sc_nerf.poses.marker_detection import marker_pattern
from hsi_sc_nerf.robust_scatter import robust_std

# Of the paper around the marker this much is taken into the fit, in cells.
_MARGIN_CELLS = 0.7
# Pixels and blur mix in what is around the paper: the margin is narrower by half a pixel and by this many standard
# deviations of the blur, down to a least one.
_BLUR_MARGIN = 1.5
_LEAST_MARGIN_CELLS = 0.2
# The pattern's edges are ramps one texel wide: half a pixel, where a cell has more than a few pixels.
_TEXELS_PER_PX = 2.0
_TEXELS_PER_CELL = (8, 16, 32)
_ITERATIONS = 12
_CONVERGED_PX = 3e-3
# A fit explains the pixels if its residuals have less than this fraction of their variance.
_LARGEST_UNEXPLAINED = 0.15
# A start with larger residuals cannot converge: something else is in front of the marker.
_HOPELESS_UNEXPLAINED = 0.8
# Errors of the pattern's model itself (print, lens, shading) that the pixels' residual does not show.
_MODEL_ERROR_PX = 0.02
_HUBER_SIGMAS = 2.5
# A pixel's footprint is cut off at this many standard deviations of the blur.
_BLUR_REACH = 3.0


@dataclass(frozen=True)
class FittedMarker:
    """A marker's corners in pixels (corner origin) and their covariance (x0, y0, x1, y1, ...)."""

    corners_px: Float[np.ndarray, "4 2"]
    covariance_px2: Float[np.ndarray, "8 8"]
    unexplained: float


def fit_marker(
    image: Float[np.ndarray, "h w"],
    dictionary: str,
    marker: int,
    corners_px: Float[np.ndarray, "4 2"],
    blur_px: float = 0.0,
    largest_shift_px: float = 2.0,
) -> FittedMarker | None:
    """Least-squares fit of the marker's homography and of its shading to the image.

    The image must be linear in reflectance: a gamma would move the half-way level of every edge. Gauss-Newton on
    the 8 numbers of the homography (pixels to cells) with the shading eliminated: the black level is linear over the
    marker, the contrast quadratic, because shade that bends over the marker would shift its edges. Pixels that do not
    fit are weighted down (Huber).

    Args:
        dictionary: OpenCV's name of the marker's dictionary.
        corners_px: where to start, within about one cell of the truth.
        blur_px: standard deviation of the camera's blur beside the pixel's own area.
        largest_shift_px: the fit fails where a corner moves farther than this.

    Returns:
        None where the pattern does not explain the pixels or reaches outside the image.
    """
    cells = marker_pattern(dictionary, marker).shape[0]
    window = _window(corners_px, cells, blur_px, image.shape)
    if window is None:
        return None
    first, inside = window
    rows, columns = np.nonzero(inside)
    values = image[rows + first[1], columns + first[0]]
    centre = corners_px.mean(0)
    extent = np.abs(corners_px - centre).max()
    local = (np.stack([columns, rows], -1) + first + 0.5 - centre) / extent
    homography = _homography((corners_px - centre) / extent, cells)
    footprint = _footprint(corners_px, cells, blur_px, first, inside.shape, centre, extent)
    texels_per_cell = _TEXELS_PER_PX * np.sqrt(quad_area(corners_px)) / cells
    nearest = min(_TEXELS_PER_CELL, key=lambda texels: abs(np.log(texels / texels_per_cell)))
    texture = _texture(dictionary, marker, nearest)
    unit_corners = _unit_square(cells).astype(float)
    corners = corners_px
    linear = np.stack([np.ones(len(local)), local[:, 0], local[:, 1]], -1)
    quadratic = np.concatenate([linear, local**2, local[:, :1] * local[:, 1:]], -1)
    robust = np.ones(len(local))
    for _ in range(_ITERATIONS):
        rendered, by_homography = (part[inside] for part in _render(footprint, homography, texture))
        design = np.concatenate([linear, quadratic * rendered[:, None]], -1)
        root = np.sqrt(robust)[:, None]
        # Cholesky's factor of the 9 x 9 Gram matrix: as good as QR for these columns, and many times faster.
        gram = (root * design).T @ (root * design)
        try:
            back = np.linalg.inv(np.linalg.cholesky(gram)).T
        except np.linalg.LinAlgError:
            return None
        basis = root * design @ back
        weighted = root[:, 0] * values
        residual = weighted - basis @ (basis.T @ weighted)
        if residual @ residual > _HOPELESS_UNEXPLAINED * np.sum((weighted - weighted.mean()) ** 2):
            return None
        white_over_black = quadratic @ (back @ (basis.T @ weighted))[3:]
        jacobian = root * white_over_black[:, None] * by_homography
        jacobian = jacobian - basis @ (basis.T @ jacobian)
        information = jacobian.T @ jacobian
        try:
            step = np.linalg.solve(information, jacobian.T @ residual)
        except np.linalg.LinAlgError:
            return None
        homography = homography + step
        previous = corners
        corners = _corners(homography, unit_corners) * extent + centre
        if not np.isfinite(corners).all() or np.abs(corners - corners_px).max() > largest_shift_px:
            return None
        raw = residual / root[:, 0]
        sigma = robust_std(raw) + 1e-6
        robust = np.minimum(1.0, _HUBER_SIGMAS * sigma / np.maximum(np.abs(raw), 1e-12))
        if np.abs(corners - previous).max() < _CONVERGED_PX:
            break
    # Quantised to 8 bit, no pixel is known better than 1/sqrt(12) of a level.
    variance = max(float(residual @ residual) / max(len(local) - homography.size - back.shape[1], 1), 1.0 / 12.0)
    unexplained = float(np.sum(raw**2) / np.sum((values - values.mean()) ** 2))
    if unexplained > _LARGEST_UNEXPLAINED or white_over_black.min() <= 0.0:
        return None
    to_corners = _corner_jacobian(homography, unit_corners) * extent
    covariance = variance * to_corners @ np.linalg.solve(information, to_corners.T)
    return FittedMarker(corners, covariance + _MODEL_ERROR_PX**2 * np.eye(8), unexplained)


def quad_area(corners: Float[np.ndarray, "4 2"]) -> float:
    """Area of a quadrilateral, from its diagonals."""
    a, b = corners[2] - corners[0], corners[3] - corners[1]
    return 0.5 * abs(float(a[0] * b[1] - a[1] * b[0]))


def _window(corners_px, cells, blur_px, shape):
    """First pixel (x, y) of a box around the marker and which of its pixels the fit takes; None outside the image."""
    to_image = cv2.getPerspectiveTransform(_unit_square(cells), corners_px.astype(np.float32))
    cell_px = np.sqrt(quad_area(corners_px)) / cells
    margin = max(_LEAST_MARGIN_CELLS, _MARGIN_CELLS - (0.5 + _BLUR_MARGIN * blur_px) / cell_px)
    low, high = -margin, cells + margin
    outline = np.array([[[low, low], [high, low], [high, high], [low, high]]], np.float64)
    outline = cv2.perspectiveTransform(outline, to_image)[0]
    first, last = np.floor(outline.min(0)).astype(int), np.ceil(outline.max(0)).astype(int)
    if first.min() < 0 or last[0] > shape[1] or last[1] > shape[0]:
        return None
    x, y = np.meshgrid(np.arange(first[0], last[0]) + 0.5, np.arange(first[1], last[1]) + 0.5)
    inside = np.ones(x.shape, bool)
    for corner, edge in zip(outline, np.roll(outline, -1, 0) - outline, strict=True):
        inside &= edge[0] * (y - corner[1]) - edge[1] * (x - corner[0]) > 0
    return (first, inside) if inside.sum() >= 24 else None


def _unit_square(cells):
    return np.array([[0, 0], [cells, 0], [cells, cells], [0, cells]], np.float32)


def _homography(corners, cells):
    """The 8 numbers h of (u, v) = ((h0 x + h1 y + h2) / d, (h3 x + h4 y + h5) / d), d = h6 x + h7 y + 1."""
    return cv2.getPerspectiveTransform(corners.astype(np.float32), _unit_square(cells)).ravel()[:8]


def _footprint(
    corners_px, cells, blur_px, first, shape, centre, extent
) -> list[tuple[Float[np.ndarray, "samples"], Float[np.ndarray, "pixels samples"]]]:
    """What each pixel of a window averages over, its own area and the blur around it: along x, then along y.

    The window is sampled on a finer grid; a pixel's row of weights belongs to the samples' places, which are relative
    to the marker's centre, in units of its extent.
    """
    side = np.linalg.norm(np.roll(corners_px, -1, 0) - corners_px, axis=-1)
    narrowest_cell = quad_area(corners_px) / side.max() / cells
    # The pattern's edges are sharp, so the samples must be dense on it; a wide blur averages over more of them.
    samples_per_px = int(np.clip(np.ceil(4.0 / narrowest_cell), 2, 6))
    if blur_px > 0:
        samples_per_px = int(np.clip(np.ceil(2.5 / blur_px), 1, samples_per_px))
    margin = int(np.ceil(_BLUR_REACH * blur_px))
    axes = []
    for start, size, middle in zip(first, shape[::-1], centre, strict=True):
        samples = start - margin + (np.arange((size + 2 * margin) * samples_per_px) + 0.5) / samples_per_px
        offset = samples - (start + np.arange(size) + 0.5)[:, None]
        if blur_px > 0:
            weight = ndtr((offset + 0.5) / blur_px) - ndtr((offset - 0.5) / blur_px)
        else:
            weight = (np.abs(offset) < 0.5).astype(float)
        weight /= weight.sum(axis=1, keepdims=True)
        axes.append((((samples - middle) / extent).astype(np.float32), weight.astype(np.float32)))
    return axes


@lru_cache(maxsize=64)
def _texture(dictionary, marker, texels):
    """Three channels: the pattern with a white margin of three cells, and its derivatives by u and v (per cell)."""
    pattern = np.pad(marker_pattern(dictionary, marker), 3, constant_values=1).astype(np.float32)
    texture = np.kron(pattern, np.ones((texels, texels), np.float32))
    derivatives = [cv2.Sobel(texture, cv2.CV_32F, dx, 1 - dx, ksize=1) * (texels / 2) for dx in (1, 0)]
    return cv2.merge([texture, *derivatives]), np.float32(texels)


def _render(footprint, homography, texture):
    """The pattern seen by each pixel of the window, in [0, 1], and its derivatives by the homography.

    Single precision is a millionth of a cell here.
    """
    (x, over_x), (y, over_y) = footprint
    h = np.append(homography, 1.0).astype(np.float32).reshape(3, 3)
    inverse_d, u, v = ((h[k, 1] * y + h[k, 2])[:, None] + h[k, 0] * x for k in (2, 0, 1))
    np.reciprocal(inverse_d, out=inverse_d)
    u *= inverse_d
    v *= inverse_d
    picture, texels = texture
    to_texel = 3 * texels - np.float32(0.5)
    seen = cv2.remap(
        picture,
        u * texels + to_texel,
        v * texels + to_texel,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    rendered, du, dv = cv2.split(seen)
    du *= inverse_d
    dv *= inverse_d
    over_x = over_x.T
    jacobian = np.empty((len(over_y), over_x.shape[1], 9))
    for k, derivative in enumerate((du, dv, -(du * u + dv * v))):
        along_x = derivative @ np.concatenate([over_x, over_x * x[:, None]], axis=1)
        total, by_x = np.split(over_y @ along_x, 2, axis=1)
        jacobian[..., 3 * k], jacobian[..., 3 * k + 2] = by_x, total
        jacobian[..., 3 * k + 1] = (over_y * y) @ along_x[:, : over_x.shape[1]]
    return (over_y @ (rendered @ over_x)).astype(float), jacobian[..., :8]


def _corners(homography, unit_corners):
    """Where the marker's corners lie."""
    back = np.linalg.solve(np.append(homography, 1.0).reshape(3, 3), np.vstack([unit_corners.T, np.ones(4)]))
    return (back[:2] / back[2]).T


def _corner_jacobian(homography, unit_corners):
    """Derivatives of the corners (x0, y0, x1, ...) by the homography, which keeps their cells where they are."""
    h = np.append(homography, 1.0).reshape(3, 3)
    jacobian = []
    for (x, y), (u, v) in zip(_corners(homography, unit_corners), unit_corners, strict=True):
        d = h[2] @ [x, y, 1.0]
        by_pixel = (h[:2, :2] - np.outer([u, v], h[2, :2])) / d
        by_h = np.array([[x, y, 1, 0, 0, 0, -u * x, -u * y], [0, 0, 0, x, y, 1, -v * x, -v * y]]) / d
        jacobian.append(-np.linalg.solve(by_pixel, by_h))
    return np.concatenate(jacobian)
