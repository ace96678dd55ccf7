"""Views of points in which no lamp's highlight lies on them.

What a highlight adds is known to a third only (`HIGHLIGHT_ERROR`), and its rim less. Highlights stay near the lamps'
mirrored directions while the object turns, so most points are also seen without them.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from hsi_sc_nerf.light.gloss import Gloss
from hsi_sc_nerf.surface.depth_renders import DepthRenders, FrameView

HIGHLIT = 0.01
"""A highlight that adds less to the reflectance is taken off with an error of a third of this."""
COSINE_OF_HIGHLIGHT = 20.0
"""Loss of cosine that is accepted to avoid an addition of 1 to the reflectance: 0.2 for 0.01."""
LEAST_COSINE = 0.42
"""Views of more than 65 degrees are blurred, and their irradiance is less certain."""

Values = TypeVar("Values", np.ndarray, Tensor)


def matte_views(
    renders: DepthRenders, gloss: Gloss, points: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]
) -> tuple[Int[Tensor, "n"], Float[Tensor, "n 2"]]:
    """The frame that shows each point best by `matte_score`, and its image coordinates there.

    The frame is -1 for points that are seen at no less than 65 degrees.

    Args:
        renders: depth maps of the frames.
        gloss: with the highlights.
        points: in the unit of the renders.
        normals: outward unit normals.
    """

    def score(index: int, view: FrameView) -> Float[Tensor, "n"]:
        in_camera = normals @ renders.camera_to_world[index, :3, :3].to(normals)
        highlights = torch.from_numpy(gloss.highlight(in_camera.cpu().numpy())).to(points)
        return torch.where(view.cosines > LEAST_COSINE, matte_score(view.cosines, highlights), -torch.inf)

    frames, xy_px, _ = renders.best_views(points, normals, score)
    return frames, xy_px


def matte_score(cosines: Values, highlights: Values) -> Values:
    """How well views show the material: the cosine of incidence, less what is given up to avoid a highlight.

    Args:
        cosines: of the angle between a point's normal and the direction to the camera.
        highlights: what the lamps' highlights add to its reflectance in the view.

    Example:
        >>> matte_score(np.array([1.0, 0.7]), np.array([0.06, 0.0]))
        array([0. , 0.7])
    """
    return cosines - COSINE_OF_HIGHLIGHT * (highlights - HIGHLIT).clip(min=0.0)
