"""Light that was found on one object and serves others: chamber and lamps stand still with the camera.

A round body shows the light from all sides. A body whose sides are all upright shows how high a lamp stands only by
its shadow. It can take the light of the round one, captured in the same chamber with the same camera and white
reference.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import content_of, read_json
from hsi_sc_nerf.light.stationary_light import TERMS, StationaryLight
from hsi_sc_nerf.spectra import same_bands


@dataclass(frozen=True, eq=False)
class KnownLight:
    """Light of an earlier session.

    Attributes:
        light: at the bands of that session.
        covariance: of its parameters, in the order of `LightFit`.
        centre_m: the point that its lamps' directions and nearness refer to, camera's frame.
        wavelengths_nm: of its bands.
    """

    light: StationaryLight
    covariance: Float[np.ndarray, "parameters parameters"]
    centre_m: Float[np.ndarray, "3"]
    wavelengths_nm: Float[np.ndarray, "bands"]

    def at(self, centre_m: Float[np.ndarray, "3"], wavelengths_nm: Float[np.ndarray, "selected"]) -> KnownLight:
        """The same light, referred to another point, at some of its bands.

        Args:
            centre_m: camera's frame.
            wavelengths_nm: of the bands.

        Raises:
            InputError: one of the bands is not among the light's.
        """
        bands = same_bands(self.wavelengths_nm, wavelengths_nm)
        if bands is None:
            raise InputError(
                "the known light has other bands than the run; take one of a session with the same bands."
            )
        light = self.light
        # Lamp at 1 / nearness from the old centre: vectors in units of that distance.
        to_lamps = light.to_lamps - light.nearness * (centre_m - self.centre_m)
        distance = np.linalg.norm(to_lamps, axis=1)
        if len(distance) and distance.min() < 0.1:
            raise InputError("a lamp of the known light would stand inside the object; take a light of this chamber.")
        lamps = light.lamps / distance**2
        # All lamps share one distance.
        nearness = light.nearness / np.average(distance, weights=light.lamps) if light.nearness else 0.0
        moved = replace(
            light,
            lamps=lamps,
            to_lamps=to_lamps / distance[:, None],
            nearness=float(nearness),
            chamber_colour=light.chamber_colour[bands],
            lamp_colour=light.lamp_colour[bands],
        )
        return KnownLight(moved, self.covariance, centre_m, wavelengths_nm)

    def values(self) -> dict[str, Any]:
        """All of it, ready for JSON."""
        light = self.light
        return {
            "chamber_harmonics": light.chamber.tolist(),
            "lamps": light.lamps.tolist(),
            "to_lamps": light.to_lamps.tolist(),
            "lamps_distance_m": 1.0 / light.nearness if light.nearness else None,
            "chamber_colour": light.chamber_colour.tolist(),
            "lamp_colour": light.lamp_colour.tolist(),
            "covariance": self.covariance.tolist(),
            "centre_m": self.centre_m.tolist(),
            "wavelengths_nm": self.wavelengths_nm.tolist(),
        }


def read_light(path: Path) -> KnownLight:
    """Read the light in a JSON file that `hsi-sc-nerf material` wrote.

    Raises:
        InputError: the file cannot be read, or holds no light or a damaged one.

    Example:
        >>> known = read_light(Path("sphere/point_cloud-material.json"))
    """
    remedy = "take the file that `hsi-sc-nerf material` of this version writes beside its cloud"
    told = read_json(path, remedy)
    with content_of(path, "light", remedy):
        values = told["light"]
        distance_m = values["lamps_distance_m"]
        nearness = 0.0 if distance_m is None else 1.0 / float(distance_m)
        lamps, bands = len(values["lamps"]), len(values["wavelengths_nm"])
        if not bands:
            raise ValueError("it has no bands")
        parameters = TERMS + 3 * lamps + (lamps > 0)

        def array(name: str, *shape: int) -> np.ndarray:
            found = np.array(values[name], float).reshape(shape)
            if not np.isfinite(found).all():
                raise ValueError(f"{name} is damaged")
            return found

        light = StationaryLight(
            array("chamber_harmonics", TERMS),
            array("lamps", lamps),
            array("to_lamps", lamps, 3),
            nearness,
            array("chamber_colour", bands),
            array("lamp_colour", bands),
        )
        if (light.lamps <= 0.0).any() or not np.allclose(np.linalg.norm(light.to_lamps, axis=1), 1.0, atol=1e-3):
            raise ValueError("its lamps have no strength or no direction")
        covariance, centre_m = array("covariance", parameters, parameters), array("centre_m", 3)
        return KnownLight(light, covariance, centre_m, array("wavelengths_nm", bands))
