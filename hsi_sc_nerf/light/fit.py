"""Fit of the light and the materials to the measurements of all elements in all views.

An element of reflectance rho has the radiance rho times its irradiance. Its irradiance changes from view to view,
because the element turns under stationary light; its material does not change. The fit is Gauss-Newton with the
materials eliminated (variable projection, Golub and Pereyra 1973), with Tukey's weights against gloss and weights
from the scatter between parts of the surface (`SharedErrors`). Lamps are added one by one while they are significant.

The object's shadow on the level surface that it stands on belongs to the measurements.

Light that does not change with the turn cannot be seen in the views. Prior knowledge determines it: a nearly even
chamber, few lamps, and irradiance 1 on the white reference.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.geometry.camera import unit_vectors
from hsi_sc_nerf.light.gloss import CHAMBER_ERROR, mirrored_chamber
from hsi_sc_nerf.light.material_fit import LightFit, MaterialFitting
from hsi_sc_nerf.light.shared_errors import CORRELATED, SharedErrors
from hsi_sc_nerf.light.stationary_light import (
    DEGREE_OF_TERM,
    TERMS,
    StationaryLight,
    even_chamber,
    even_directions,
    relative_nearness,
    tangents,
    unit_irradiance,
)
from hsi_sc_nerf.light.views import ElementViews, TurningElements

MOST_LAMPS = 4
CANDIDATES = 200
"""Number of directions in which a lamp is searched for."""
BEHIND = -0.2
"""Lamps stand on the camera's side: the cosine between their direction and the camera's is above this. Two lamps in
front of and behind a body can hardly be distinguished from one lamp and an uneven chamber."""
SIGNIFICANT_LAMP = 30.0
"""Squared standard deviations by which a lamp in one of 200 directions must exceed 0: more than errors of mesh and
model that resemble a lamp reach (docs/validation/light.md)."""
NEARLY = 0.9
"""Lamps whose significance is at least this fraction of the largest are told apart by their shadows on the level
surface: upright bodies hardly tell how high a lamp stands. Shadows alone would mislead where there are two lamps."""
LEAST_LAMP = 0.02
"""Weaker lamps are removed."""
UNEVENNESS, UNEVENNESS_COUNT = 0.03, 2.0
"""Expected root mean square of a chamber's harmonics, and the number of harmonics that this prior is worth. Visible
harmonics update it for those that are not visible."""
UNEVENNESS_AT_FIRST = 0.003
"""Expected root mean square while a lamp is searched for, so that the chamber does not explain the lamp's
nearness."""
MOST_UNEVEN = 0.1
"""Largest root mean square of a chamber's harmonics: light that is more uneven is a lamp's."""
LEAST_DISTANCE_M = 0.25
"""Least distance of lamps; the first order of their nearness still describes it."""
LAMP_STD, TURN_STD_RAD, NEARNESS_STD = 1.0, 1.0, 1.5
"""Expected size of a lamp, of a correction of its direction, and of one over the lamps' distance (1/m)."""
WHITE_STD = 0.01
"""Error of the white reference's own reflectance and orientation."""
WHITE_PLACE_STD_M = 0.02
"""Error of the place at which it was captured."""
COLOUR_STD = 0.1
"""Expected scatter of the lamps' colour from the white reference's light."""
LEAST_LAMPS = 0.05
"""The lamps' colour is fitted if they give the white reference at least this fraction of its light."""
LEAST_CHAMBER = 0.02
"""Likewise the chamber, whose colour is what the lamps leave of the white's."""
STEPS, LEAST_STEPS = 10, 3
"""Steps of Gauss-Newton for each number of lamps."""
SETTLED = 0.01
"""Squared standard deviations of a step at which the fit has converged."""
LARGEST_TURN_RAD = 0.2


def fit_light(
    elements: TurningElements,
    views: ElementViews,
    white_normal: Float[np.ndarray, "3"],
    white_m: Float[np.ndarray, "3"] | None = None,
) -> LightFit:
    """Fit light and materials.

    Args:
        elements: that were measured.
        views: their measurements.
        white_normal: outward unit normal of the white reference, camera's frame.
        white_m: its place relative to the elements' origin, camera's frame; None for that origin.
    """
    fit = _LightFitting(elements, views, white_normal, np.zeros(3) if white_m is None else white_m)
    fit.converge()
    while len(fit.light.lamps) < MOST_LAMPS:
        before = copy(fit)
        if not fit.add_lamp():
            break
        fit.converge()
        fit.unevenness = UNEVENNESS
        fit.converge()
        if fit.light.lamps.min() < LEAST_LAMP:
            fit = before
            break
    # The chamber explains only what no lamp explains.
    fit.unevenness = UNEVENNESS
    fit.errors = SharedErrors(elements.cells[views.element], elements.facing(views))
    fit.settle_without_gloss(partial(fit.converge, estimate_unevenness=True))
    return fit.result(fit.covariance())


def newton_step(
    hessian: Float[np.ndarray, "n n"], gradient: Float[np.ndarray, "n"], bounds: tuple[float, float]
) -> Float[np.ndarray, "n"]:
    """The step that minimises ``step @ hessian @ step / 2 - gradient @ step``, its last element within bounds.

    At a bound, the other elements are those that fit it. If the last one were cut after all of them are found, they
    would go on making up for what is cut.
    """
    step = np.linalg.solve(hessian, gradient)
    last = np.clip(step[-1], *bounds)
    if last == step[-1]:
        return step
    return np.append(np.linalg.solve(hessian[:-1, :-1], gradient[:-1] - hessian[:-1, -1] * last), last)


class _LightFitting(MaterialFitting):
    """State of the fit: the light, and what follows from it."""

    def __init__(
        self, elements: TurningElements, views: ElementViews, white: np.ndarray, white_m: np.ndarray
    ) -> None:
        super().__init__(elements, views, even_chamber(views.reflectance.shape[1]))
        self.white, self.white_m = white, white_m
        self.errors = SharedErrors(elements.cells[views.element])
        self.unevenness = UNEVENNESS_AT_FIRST

    def converge(self, *, estimate_unevenness: bool = False) -> None:
        """Gauss-Newton with the present lamps; the chamber's unevenness is estimated as well on request."""
        for number in range(STEPS):
            self.bounce()
            residual, jacobian = self.linearised()
            self.weigh(residual)
            residual, jacobian = self.without_materials(residual[:, None], jacobian)
            information, known = self.errors.information(residual[:, 0], jacobian, self.precision)
            prior, pull = self._prior()
            hessian = information + prior
            step = self._step(hessian, known + pull)
            self._move(step)
            if estimate_unevenness:
                self._estimate_unevenness(np.linalg.inv(hessian))
            self._estimate_colours()
            if number + 1 >= LEAST_STEPS and step @ hessian @ step < SETTLED:
                break

    def add_lamp(self) -> bool:
        """Add the lamp that explains most of the residuals; False if none is significant."""
        self.bounce()
        directions = even_directions(CANDIDATES)
        # The disc hides what shines from below its plane; an upright body would hardly tell it from light from above.
        up = self.elements.rotations[:, 2].mean(axis=0)
        directions = directions[(directions[:, 2] > BEHIND) & (directions @ up > 0.0)]
        units = self.elements.by_each_lamp(self.views, directions)
        residual, jacobian = self.linearised()
        expected = 1.0 / self.irradiance().mean(axis=1, keepdims=True)
        residual, columns, others = self.without_materials(residual[:, None], units * expected, jacobian)
        precision = (self.precision * self.views.on_object)[:, None]
        # The part that chamber and lamps can explain is removed.
        hessian = (others * precision).T @ others + CORRELATED * self._prior()[0]
        known = np.linalg.solve(hessian, (others * precision).T @ np.hstack([residual, columns]))
        residual, *columns = (np.hstack([residual, columns]) - others @ known).T
        columns = np.stack(columns, axis=-1)
        significance = self.errors.significance(residual, columns, precision[:, 0])
        with_shadows = self.errors.significance(residual, columns, self.precision)
        best = int(np.where(significance >= NEARLY * significance.max(), with_shadows, -1.0).argmax())
        if significance[best] < SIGNIFICANT_LAMP:
            return False
        weighted = columns[:, best] * precision[:, 0]
        strength = (weighted @ residual) / (weighted @ columns[:, best])
        light = self.light
        self._set(
            replace(
                light,
                lamps=np.append(light.lamps, strength),
                to_lamps=np.concatenate([light.to_lamps, directions[best : best + 1]]),
            )
        )
        return True

    def covariance(self) -> Float[np.ndarray, "parameters parameters"]:
        """Of the light's parameters."""
        self.bounce()
        residual, jacobian = self.linearised()
        residual, jacobian = self.without_materials(residual[:, None], jacobian)
        information, _ = self.errors.information(residual[:, 0], jacobian, self.precision)
        return np.linalg.inv(information + self._prior()[0])

    def _prior(self) -> tuple[np.ndarray, np.ndarray]:
        """Precision of the parameters' prior, and its gradient at their present values."""
        light, lamps = self.light, len(self.light.lamps)
        precision = np.zeros(TERMS + 3 * lamps + (lamps > 0))
        precision[:TERMS] = np.where(DEGREE_OF_TERM > 0, self.unevenness**-2.0, 0.0)
        precision[TERMS : TERMS + lamps] = LAMP_STD**-2.0
        precision[TERMS + lamps : TERMS + 3 * lamps] = TURN_STD_RAD**-2.0
        nearness = slice(TERMS + 3 * lamps, None)  # of no lamps there is none
        precision[nearness] = NEARNESS_STD**-2.0
        now = np.zeros(len(precision))
        now[:TERMS], now[TERMS : TERMS + lamps], now[nearness] = light.chamber, light.lamps, light.nearness
        of_chamber, of_lamps = unit_irradiance(self.white, light.to_lamps)
        nearer = relative_nearness(self.white_m[None], self.white[None], light.to_lamps)[0]
        factors = 1.0 + light.nearness * nearer
        white = np.zeros(len(precision))
        white[:TERMS], white[TERMS : TERMS + lamps] = of_chamber, of_lamps * factors
        # A lamp that turns gives the white reference another light.
        lit = light.lamps * factors * (light.to_lamps @ self.white > 0.0)
        white[TERMS + lamps : TERMS + 3 * lamps] = (lit[:, None] * (tangents(light.to_lamps) @ self.white)).ravel()
        by_lamps = float(of_lamps * factors @ light.lamps)
        white[nearness] = of_lamps * nearer @ light.lamps
        missing = 1.0 - of_chamber @ light.chamber - by_lamps
        # The light of a near lamp changes with the place twice as fast as the distance.
        std = np.hypot(WHITE_STD, 2.0 * light.nearness * by_lamps * WHITE_PLACE_STD_M)
        return np.diag(precision) + np.outer(white, white) / std**2, white * missing / std**2 - precision * now

    def _step(self, hessian: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """The Gauss-Newton step, to lamps neither nearer than ``LEAST_DISTANCE_M`` nor beyond infinity."""
        if not len(self.light.lamps):
            return np.linalg.solve(hessian, gradient)
        nearness = self.light.nearness
        return newton_step(hessian, gradient, (-nearness, 1.0 / LEAST_DISTANCE_M - nearness))

    def _move(self, step: np.ndarray) -> None:
        """Change the parameters; lamps stay positive, and turn by no more than ``LARGEST_TURN_RAD`` at once."""
        light, lamps = self.light, len(self.light.lamps)
        turns = np.clip(
            step[TERMS + lamps : TERMS + 3 * lamps].reshape(lamps, 2), -LARGEST_TURN_RAD, LARGEST_TURN_RAD
        )
        to_lamps = light.to_lamps + np.einsum("lt,ltk->lk", turns, tangents(light.to_lamps))
        self._set(
            replace(
                light,
                chamber=light.chamber + step[:TERMS],
                lamps=np.maximum(light.lamps + step[TERMS : TERMS + lamps], 0.1 * light.lamps),
                to_lamps=unit_vectors(to_lamps),
                nearness=max(float(light.nearness + step[-1]), 0.0) if lamps else 0.0,
            )
        )

    def _set(self, light: StationaryLight) -> None:
        if not np.array_equal(light.to_lamps, self.light.to_lamps):
            self.lamps = self.elements.lamps_at(self.views, light.to_lamps)
        self.light = light

    def _estimate_unevenness(self, covariance: np.ndarray) -> None:
        """Root mean square of the chamber's harmonics, weighted by how well the views show them (MacKay 1992)."""
        uneven = DEGREE_OF_TERM > 0
        seen = np.clip(1.0 - np.diag(covariance)[:TERMS] / self.unevenness**2, 0.0, 1.0)[uneven].sum()
        square = (self.light.chamber[uneven] ** 2).sum() + UNEVENNESS_COUNT * UNEVENNESS**2
        self.unevenness = min(float(np.sqrt(square / (seen + UNEVENNESS_COUNT))), MOST_UNEVEN)

    def _estimate_colours(self) -> None:
        """The colour of the lamps that fits each band best; the white reference stays white."""
        light = self.light
        of_chamber, of_lamps = light.on(self.white, self.white_m)
        whole = of_chamber + of_lamps
        if of_lamps < LEAST_LAMPS * whole or of_chamber < LEAST_CHAMBER * whole:
            return
        irradiance = self.irradiance()
        expected = self.materials(irradiance)[self.views.element] * irradiance
        chamber, lamps = self.direct()
        slope = (lamps - chamber * of_lamps / of_chamber)[:, None] / irradiance
        gloss = 0.0 if self.gloss is None else CHAMBER_ERROR * self.gloss.reflectance * mirrored_chamber(light)
        columns = self.measured / expected - 1.0, slope, gloss * self.views.on_object[:, None] / expected
        residual, slope, gloss_error = self.without_materials(*columns)
        step = np.empty(len(light.lamp_colour))
        for band, own in enumerate(slope.T):
            information, known = self.errors.information(residual[:, band], own[:, None], self.precision)
            weighted = self.precision * own
            # All measurements share the error of the mirrored chamber, which is large where the material is dark.
            by_gloss = (weighted @ gloss_error[:, band]) / max(float(weighted @ own), 1e-12)
            gain = 1.0 / (1.0 / information[0, 0] + by_gloss**2)
            pull = gain * known[0] / information[0, 0] + (1.0 - light.lamp_colour[band]) * COLOUR_STD**-2
            step[band] = pull / (gain + COLOUR_STD**-2)
        # A change that all bands share is one of the lamps' strength.
        colour = np.clip(light.lamp_colour + step - step.mean(), 0.0, 1.0 + of_chamber / of_lamps)
        chamber_colour = 1.0 + (1.0 - colour) * of_lamps / of_chamber
        self.light = replace(light, lamp_colour=colour, chamber_colour=chamber_colour)
