"""Opacity of a soft surface: a ray loses light where the density rises along it, besides in the density itself.

A trained density rises over a millimetre or two. A ray that touches the surface stays in that rise for centimetres,
and a ray from the front crosses it at once. So by density alone, the outlines see a surface one or two millimetres
outside the one that the texture on its front shows, and no density suits both. A rise takes the same light from a ray
whatever its direction, as the opacity of NeuS does (Wang et al. 2021, "NeuS: Learning Neural Implicit Surfaces by
Volume Rendering", section 3.1), which follows from the change of a signed distance. The more of the opacity is due to
the rise, the closer lie both surfaces.
"""

from __future__ import annotations

from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

SHORTEST = 1e-9
"""Samples of no length, which have no opacity, are taken to have this length; scene units."""


def opaque_density(
    densities: Float[Tensor, "*rays samples"],
    lengths: Float[Tensor, "*#rays samples"],
    rise_length: Float[Tensor, ""] | float,
) -> Float[Tensor, "*rays samples"]:
    """The density that has the opacity of both: of the density, and of its rises along the ray.

    The optical depth of a sample is ``density * length + rise_length * rise``, where the rise is that of the density
    from the sample before. What falls takes no light, and before the first sample lies nothing.

    Args:
        densities: of the samples along each ray, in order, not negative.
        lengths: of the samples, in the unit of which the density is the inverse.
        rise_length: a rise is as opaque as this length of the density that it rises to; 0 for the density alone.

    Example:
        >>> opaque_density(torch.tensor([0.0, 2.0, 1.0, 4.0]), torch.full((4,), 0.5), rise_length=0.25)
        tensor([0.0000, 3.0000, 1.0000, 5.5000])
    """
    rises = (densities - functional.pad(densities[..., :-1], (1, 0))).relu()
    return densities + rise_length * rises / lengths.clamp_min(SHORTEST)
