"""Light that stands still with the camera: shading and highlights by the surface normal in the camera's frame.

The object turns before fixed lamps and a fixed camera. How a lamp shades a point, and whether it shows a highlight
there, then depends on the normal in the camera's frame, nearly alike for all points (the reflectance map of Horn,
"Understanding image intensities", 1977). So it is one function that all views and points share. A field that sees
the viewing direction has to learn each point's highlights from the few views that show them, and guesses the others.

The object and its support (container and disc) are two bodies of different material, and each has a function of its
own. With one for both, the lowest millimetres of the object come out too far (docs/notes/earlier_measurements.md).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from nerfstudio.field_components.mlp import MLP
from torch import Tensor, nn
from torch.nn import functional

REFRESH_EVERY = 50
"""Steps after which the normals follow the opacities of the occupancy grid."""
SMOOTHING_CELLS = 2.5
"""Standard deviation of the Gaussian that smooths the opacities before their gradient is taken. Less makes the
normals noisy, more rounds the object (docs/notes/dead_ends.md)."""
MAP_SIZES = (8, 16, 32, 64)
"""Sides of the maps over the normals, which go from -1 to 1 in x and y. A cell of the finest has 1.8 degrees."""
MAP_CHANNELS, HIDDEN = 4, 32
LIMB = 0.966
"""Length in the image of the unit normals at 75 degrees from the camera's axis. Normals beyond have the shading of
those. Pixels at the limb also cover what is behind it: shading of their own would take over its colour, and the
surface come out too far, further with every step (docs/notes/earlier_measurements.md)."""
MIRRORED_CELLS, OBJECT_OPACITY = (5, 8, 11, 14, 18), 0.4
"""Where a mirrored ray is looked up, in cells from its start (11 to 40 mm), and the smoothed opacity of an object.
Before 5 cells, the surface that mirrors it is still near."""
LARGEST_LOG_GAIN = 4.0
"""No lamp is 50 times brighter than the chamber's mean; what is more would be a step gone wrong."""


class CameraShading(nn.Module):
    """Gain and gloss by the normal in the frame of a camera that stands still while the object turns.

    The coefficients c of a point become ``gain * c + gloss``. Both are smooth maps of the normal, found by training,
    one for the object and one for its support.

    The lamps and the camera are not far away, so that the same highlight is at slightly different normals on the left
    and on the right of the object: the normal is displaced in proportion to the place, by one learned number.

    Args:
        shape: cells of the occupancy grid along each side.
        lower: its lower corner, scene units.
        cell: side of its cells, scene units.
        channels: coefficients of a sample.
        camera_to_world: pose of a measured camera, OpenGL axes, scene units.
        axis_origin: a point of the turntable's axis, which is parallel to z, scene units.
        base: height of the plane on which the object stands, scene units.

    Example:
        >>> shading = CameraShading(grid.opacity.shape, grid.lower, grid.cell, 8, camera_to_world, axis_origin, -0.1)
        >>> shading.refresh(grid.opacity)
        >>> shaded = shading(coefficients, positions, origins, shading.normals(positions))
    """

    smoothed: Tensor
    _normals: Tensor
    _lower: Tensor
    _sides: Tensor
    _camera: Tensor
    _axis: Tensor

    def __init__(
        self,
        shape: tuple[int, int, int],
        lower: Float[Tensor, "3"],
        cell: float,
        channels: int,
        camera_to_world: Float[Tensor, "4 4"],
        axis_origin: Float[Tensor, "3"],
        base: float,
    ) -> None:
        super().__init__()
        self.base = base
        self.register_buffer("smoothed", torch.zeros(shape))
        self.register_buffer("_normals", torch.zeros(1, 3, *shape), persistent=False)
        self.register_buffer("_lower", lower.clone(), persistent=False)
        self.register_buffer("_sides", torch.tensor(shape) * cell, persistent=False)
        self.register_buffer("_camera", camera_to_world.clone().float(), persistent=False)
        self.register_buffer("_axis", axis_origin.clone().float(), persistent=False)
        self.maps = nn.ParameterList(
            nn.Parameter(1e-2 * torch.randn(1, MAP_CHANNELS, size, size)) for size in MAP_SIZES
        )
        self.parallax = nn.Parameter(torch.zeros(()))
        self.network = MLP(
            in_dim=MAP_CHANNELS * len(MAP_SIZES) + 1,
            num_layers=3,
            layer_width=HIDDEN,
            out_dim=1 + channels,
            activation=nn.ReLU(),
            implementation="torch",
        )
        last = self.network.layers[-1]
        assert isinstance(last, nn.Linear)
        with torch.no_grad():  # training begins with a gain of 1 and no gloss
            last.weight.zero_()
            last.bias.zero_()
        self.register_load_state_dict_post_hook(lambda module, _: module._derive_normals())

    def forward(
        self,
        coefficients: Float[Tensor, "n channels"],
        positions: Float[Tensor, "n 3"],
        origins: Float[Tensor, "n 3"],
        normals: Float[Tensor, "n 3"],
    ) -> Float[Tensor, "n channels"]:
        """Shaded coefficients of points.

        Args:
            coefficients: coefficients of the points.
            positions: positions of the points, scene units; they get no gradient.
            origins: origins of the rays that see the points, scene units: the camera from there.
            normals: :meth:`normals` of the points.
        """
        with torch.no_grad():
            facing, aside = self.across_image(origins, normals, positions - self._axis)
        within = facing * (LIMB / facing.norm(dim=-1, keepdim=True).clamp_min(LIMB))
        # At NaN, the gradient of grid_sample is written outside of its table.
        at = (within + self.parallax * aside).nan_to_num()[None, None]
        looked_up = [
            functional.grid_sample(values, at, mode="bilinear", padding_mode="border", align_corners=True)[0, :, 0].T
            for values in self.maps
        ]
        looked_up.append((positions[:, 2:] < self.base).to(at))
        log_gain, gloss = self.network(torch.cat(looked_up, dim=-1)).split([1, coefficients.shape[-1]], dim=-1)
        return coefficients * torch.exp(log_gain.clamp(-LARGEST_LOG_GAIN, LARGEST_LOG_GAIN)) + gloss

    @torch.no_grad()
    def normals(self, positions: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
        """Unit normals out of the surface, object's frame, from the smoothed opacities; 0 where these are even."""
        return functional.normalize(self._look_up(self._normals, positions, "border"), dim=-1, eps=1e-12)

    @torch.no_grad()
    def open_normals(
        self, positions: Float[Tensor, "n 3"], origins: Float[Tensor, "n 3"], normals: Float[Tensor, "n 3"]
    ) -> Float[Tensor, "n 3"]:
        """Normals where the ray that is mirrored there meets no object again; 0 elsewhere, as at the rim of a hollow.

        Args:
            positions: positions of the points, scene units.
            origins: origins of the rays that see the points, scene units.
            normals: :meth:`normals` of the points.
        """
        along = functional.normalize(positions - origins, dim=-1)
        mirrored = along - 2.0 * (along * normals).sum(dim=-1, keepdim=True) * normals
        cell = self._sides[0] / self.smoothed.shape[0]
        is_open = torch.ones_like(positions[:, 2:], dtype=torch.bool)
        for cells in MIRRORED_CELLS:
            there = positions + cells * cell * mirrored
            opacity = self._look_up(self.smoothed[None, None], there.nan_to_num(), "zeros")
            is_open &= (opacity <= OBJECT_OPACITY) | (there[:, 2:] <= self.base)
        return normals * is_open

    def _look_up(
        self, values: Float[Tensor, "1 channels x y z"], positions: Float[Tensor, "n 3"], outside: str
    ) -> Float[Tensor, "n channels"]:
        """Values of a grid at positions, between the centres of its cells; outside as grid_sample's padding mode."""
        # grid_sample counts from -1 to 1 from border to border, and the last axis first.
        at = (2.0 * (positions - self._lower) / self._sides - 1.0).flip(-1)[None, None, None]
        found = functional.grid_sample(values, at, mode="bilinear", padding_mode=outside, align_corners=False)
        return found[0, :, 0, 0].T

    def across_image(
        self, origins: Float[Tensor, "n 3"], *vectors: Float[Tensor, "n 3"]
    ) -> list[Float[Tensor, "n 2"]]:
        """Components of vectors to the right and upwards in the camera that stands where rays begin.

        It is the measured camera turned about the axis. A viewer's rays have no measured camera, and are lit as those
        of the measured one at the same azimuth.
        """
        start, (x, y, _) = self._camera[:2, 3] - self._axis[:2], (origins - self._axis).unbind(dim=-1)
        cos, sin = start[0] * x + start[1] * y, start[0] * y - start[1] * x
        length = torch.hypot(cos, sin).clamp_min(1e-12)
        cos, sin = cos / length, sin / length
        right_and_up = self._camera[:3, :2]
        found = []
        for vector in vectors:
            x, y, z = vector.unbind(dim=-1)
            turned_back = torch.stack([cos * x + sin * y, cos * y - sin * x, z], dim=-1)
            # Not a matrix product, which mixed precision would round.
            found.append(torch.stack([(turned_back * axis).sum(dim=-1) for axis in right_and_up.unbind(-1)], dim=-1))
        return found

    @torch.no_grad()
    def refresh(self, opacity: Float[Tensor, "x y z"]) -> None:
        """Take over the opacities of an occupancy grid; cells without matter (below 0) are empty."""
        self.smoothed.copy_(smoothed_grid(opacity.clamp_min(0.0), SMOOTHING_CELLS))
        self._derive_normals()

    def _derive_normals(self) -> None:
        # In place: a captured step reads the same memory.
        self._normals.copy_(-torch.stack(torch.gradient(self.smoothed))[None])


def smoothed_grid(values: Float[Tensor, "x y z"], deviation_cells: float) -> Float[Tensor, "x y z"]:
    """A grid smoothed by a Gaussian, whose weights add up to 1 at the grid's sides as well."""
    for _ in range(3):  # along the last axis, which then comes first
        offsets = torch.arange(values.shape[-1], device=values.device, dtype=values.dtype)
        weights = torch.exp(-0.5 * ((offsets[:, None] - offsets) / deviation_cells) ** 2)
        values = (values @ (weights / weights.sum(dim=0))).permute(2, 0, 1)
    return values.contiguous()
