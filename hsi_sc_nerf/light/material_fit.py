"""The materials of elements under a given light, from their measurements in all views.

An element of reflectance rho has the radiance rho times its irradiance. Its irradiance changes from view to view,
because the element turns under stationary light; its material does not change, and follows from all views by weighted
least squares. Elements light each other, with the materials that were found. Light that the skin mirrors is taken off
once it is found (`Gloss`); Tukey's weights leave out what is left of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from jaxtyping import Float
from scipy.spatial import cKDTree

from hsi_sc_nerf.light.gloss import HIGHLIGHT_ERROR, Gloss, find_gloss, mirrored_chamber
from hsi_sc_nerf.light.shared_errors import SMALLEST_SCATTER, scatter_beyond
from hsi_sc_nerf.light.stationary_light import StationaryLight
from hsi_sc_nerf.light.views import SMALLEST, ElementViews, LampUnits, TurningElements
from hsi_sc_nerf.robust_scatter import robust_std, tukey_weights

OCCLUSION_ERROR = 0.1
"""Error of irradiance relative to the part that neighbours occlude: meshes are uncertain where bodies touch."""
LEAST_IRRADIANCE = 0.02
STEPS = 6
"""Turns of materials, bounces and weights under a known light: none changes any longer."""
GLOSS_STEPS, GLOSS_SETTLED = 6, 0.001
"""Turns of gloss and light, and the change of the mirrored fraction that ends them."""


@dataclass(frozen=True, eq=False)
class LightFit:
    """Light and materials that explain the views.

    Attributes:
        light: in the camera's frame.
        covariance: of the light's parameters: the chamber's harmonics, the lamps' strengths, their turns along two
            `tangents` each (rad), and their nearness if there are lamps.
        material: reflectance of each element; that of the nearest one for an element without a view.
        weights: Tukey's weight of each measurement, 0 to 1.
        irradiance: at each measurement.
        scatter: robust standard deviation of the measurements relative to the model.
        relative_std: relative standard deviation of each measurement's irradiance due to the light's uncertainty.
        gloss: what the skin mirrors; None where no highlights tell.
    """

    light: StationaryLight
    covariance: Float[np.ndarray, "parameters parameters"]
    material: Float[np.ndarray, "n bands"]
    weights: Float[np.ndarray, "m"]
    irradiance: Float[np.ndarray, "m bands"]
    scatter: float
    relative_std: Float[np.ndarray, "m"]
    gloss: Gloss | None


def materials_under(
    light: StationaryLight,
    covariance: Float[np.ndarray, "parameters parameters"],
    elements: TurningElements,
    views: ElementViews,
) -> LightFit:
    """The materials that explain the views under a known light.

    Args:
        light: by the bands of the views.
        covariance: of its parameters, in the order of `LightFit`.
        elements: that were measured.
        views: their measurements.
    """
    fit = MaterialFitting(elements, views, light)
    fit.settle_without_gloss(fit.settle)
    return fit.result(covariance)


class MaterialFitting:
    """The materials under a light that may still change.

    Args:
        elements: that were measured.
        views: their measurements.
        light: to begin with.
    """

    def __init__(self, elements: TurningElements, views: ElementViews, light: StationaryLight) -> None:
        self.elements, self.views, self.light = elements, views, light
        self.gloss: Gloss | None = None
        self.measured = views.reflectance  # without what the skin mirrors
        count = len(views.element), len(elements.positions)
        entries = np.ones(count[0]), (views.element, np.arange(count[0]))
        self._sum_by_element = scipy.sparse.csr_array(entries, shape=count[::-1])
        seen = np.bincount(views.element, minlength=count[1]) > 0
        self._nearest_seen = np.flatnonzero(seen)[cKDTree(elements.positions[seen]).query(elements.positions)[1]]
        self._chamber = elements.chamber_at(views)
        occluded = 1.0 - elements.transfer.sky[views.element]
        self._own_std = np.hypot(views.own_std, OCCLUSION_ERROR * occluded)
        self._highlight_std = np.zeros(count[0])
        self.precision = np.zeros(count[0])
        self.weights, self.scatter = np.ones(count[0]), 0.0
        self.bounced = np.zeros((count[0], views.reflectance.shape[1]), np.float32)
        self.lamps = elements.lamps_at(views, light.to_lamps)

    def settle(self) -> None:
        """Find materials, bounces and weights under the light of now."""
        for _ in range(STEPS):
            self.bounce()
            residual, _ = self.linearised()
            self.weigh(residual)
        self.bounce()

    def settle_without_gloss(self, settle: Callable[[], None]) -> None:
        """Settle, and again while gloss that is found and taken off changes.

        Args:
            settle: finds what else is unknown.
        """
        settle()
        for _ in range(GLOSS_STEPS):
            if not self.take_gloss_off():
                break
            settle()

    def take_gloss_off(self) -> bool:
        """Find what the skin mirrors under the light of now; False if that is nothing, or as much as before."""
        on_object, normals = self.views.on_object, self.elements.normals_in_camera(self.views)
        before = 0.0 if self.gloss is None else self.gloss.reflectance
        irradiance = self.irradiance()
        diffuse = self.materials(irradiance)[self.views.element] * irradiance
        left = (self.views.reflectance - diffuse).mean(axis=1) - before * mirrored_chamber(self.light)
        element, lit = self.views.element[on_object], irradiance[on_object].mean(axis=1)
        found = find_gloss(element, normals[on_object], left[on_object], lit, self.light)
        if found is None:
            return False
        if self.gloss is not None:  # lamps answer to gloss: whole steps swing around the answer
            found = replace(found, reflectance=(found.reflectance + before) / 2.0)
        self.gloss = found
        reflectance = self.views.reflectance
        matte = found.taken_off(reflectance, normals, self.light)
        self.measured = np.where(on_object[:, None], matte, reflectance)
        expected = np.maximum(diffuse.mean(axis=1), SMALLEST)
        self._highlight_std = HIGHLIGHT_ERROR * on_object * found.highlight(normals) / expected
        return abs(found.reflectance - before) > GLOSS_SETTLED

    def bounce(self) -> None:
        """Irradiance at the measurements by other elements, from the light and materials of now."""
        frames, which = np.unique(self.views.frame, return_inverse=True)
        of_frames = (self.elements.direct(self.light, int(frame)).astype(np.float32) for frame in frames)
        direct = np.stack([*of_frames], axis=1)
        for _ in range(1 if self.bounced.any() else 2):
            material = self.materials(self.irradiance())
            self.bounced = self.elements.bounced(direct, material)[self.views.element, which]

    def linearised(self) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m parameters"]]:
        """Relative residuals, and relative derivatives of the expected values by the light's parameters.

        Both are means over the bands, weighted by the square of the expected reflectance. The parameters are the
        chamber's harmonics, the lamps, their directions along two tangents, and their nearness if there are lamps.
        """
        light, irradiance = self.light, self.irradiance()
        expected = self.materials(irradiance)[self.views.element] * irradiance
        band_weights = expected**2 / (expected**2).sum(axis=1, keepdims=True)
        residual = (band_weights * (self.measured / expected - 1.0)).sum(axis=1)
        by_chamber = (band_weights * light.chamber_colour / irradiance).sum(axis=1)[:, None]
        by_lamps = (band_weights * light.lamp_colour / irradiance).sum(axis=1)[:, None]
        units: LampUnits = self.lamps
        columns = [self._chamber * by_chamber, (units.irradiance + light.nearness * units.by_nearness) * by_lamps]
        if len(light.lamps):
            turning = (units.by_direction * light.lamps[:, None]).reshape(len(band_weights), -1)
            columns += [turning * by_lamps, (units.by_nearness @ light.lamps)[:, None] * by_lamps]
        return residual, np.hstack(columns)

    def without_materials(self, *columns: np.ndarray) -> list[np.ndarray]:
        """Columns without their weighted mean over each element's views, which its material absorbs."""
        total = np.maximum(self._sum_by_element @ self.weights, 1e-9)[:, None]
        means = ((self._sum_by_element @ (self.weights[:, None] * column)) / total for column in columns)
        return [column - mean[self.views.element] for column, mean in zip(columns, means, strict=True)]

    def weigh(self, residual: Float[np.ndarray, "m"]) -> None:
        """Find the scatter and the measurements' weights."""
        used = self.views.shows_light
        self.scatter = float(robust_std(residual[self.views.on_object], least=SMALLEST_SCATTER))
        own_std = np.hypot(self._own_std, self._highlight_std)
        beyond = scatter_beyond(residual[used], own_std[used])
        std = np.hypot(beyond, own_std)
        # Never 0, so that no element is left without a measurement.
        self.weights = np.where(used, np.maximum(tukey_weights(residual / std), 1e-6), 1.0)
        self.precision = self.weights * used / std**2
        # A highlight that is not taken off in full would brighten the material, and so be found smaller each time.
        self.weights = self.weights / (1.0 + (self._highlight_std / beyond) ** 2)

    def irradiance(self) -> Float[np.ndarray, "m bands"]:
        """At the measurements."""
        chamber, lamps = self.direct()
        light = self.light
        total = chamber[:, None] * light.chamber_colour + lamps[:, None] * light.lamp_colour + self.bounced
        return np.maximum(total, LEAST_IRRADIANCE)

    def direct(self) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
        """Irradiance at the measurements by chamber and lamps, without their colours."""
        light, units = self.light, self.lamps
        return self._chamber @ light.chamber, (units.irradiance + light.nearness * units.by_nearness) @ light.lamps

    def materials(self, irradiance: np.ndarray) -> Float[np.ndarray, "n bands"]:
        """The reflectance of each element that fits its measurements best."""
        above = self._sum_by_element @ (self.weights[:, None] * self.measured * irradiance)
        below = self._sum_by_element @ (self.weights[:, None] * irradiance**2)
        return np.clip((above / np.maximum(below, 1e-9))[self._nearest_seen], 1e-4, 1.0)

    def result(self, covariance: Float[np.ndarray, "parameters parameters"]) -> LightFit:
        """The result, with the uncertainty of the irradiance.

        Args:
            covariance: of the light's parameters.
        """
        _, jacobian = self.linearised()
        variance = np.einsum("mi,ij,mj->m", jacobian, covariance, jacobian)
        irradiance = self.irradiance()
        return LightFit(
            self.light,
            covariance,
            self.materials(irradiance),
            self.weights,
            irradiance,
            self.scatter,
            np.sqrt(variance),
            self.gloss,
        )
