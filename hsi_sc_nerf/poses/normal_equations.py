"""Normal equations of a bundle adjustment, from which the Schur complement eliminates the landmarks.

B. Triggs et al., "Bundle adjustment - a modern synthesis" (2000), section 6.1. Each landmark is seen in a few frames
and meets no other landmark: its small block is inverted by itself.

Symbols: l landmarks of d parameters, p other parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve


@dataclass(frozen=True)
class NormalEquations:
    """Gauss-Newton equations of camera and motion, and of the landmarks."""

    motion: Float[np.ndarray, "p p"]
    motion_gradient: Float[np.ndarray, "p"]
    landmarks: tuple[LandmarkEquations, ...]

    def solve(self, damping: float) -> tuple[Float[np.ndarray, "p"], list[Float[np.ndarray, "l d"]]]:
        """The damped step of camera and motion, and of each kind of landmarks.

        Raises:
            LinAlgError: the damped equations are singular.
        """
        normal, right, eliminated = self._eliminated(damping)
        normal[np.diag_indices_from(normal)] += damping * np.maximum(self.motion.diagonal(), 1e-12)
        step = -cho_solve(cho_factor(normal), right)
        return step, [
            -np.einsum("lij,lj->li", inverse, part.gradient) - through @ step
            for part, (inverse, through) in zip(self.landmarks, eliminated, strict=True)
        ]

    def information(self) -> Float[np.ndarray, "p p"]:
        """The inverse covariance of camera and motion for residuals of unit variance, the landmarks being unknown."""
        return self._eliminated(0.0)[0]

    def reduced(self) -> list[tuple[Float[np.ndarray, "p p"], Float[np.ndarray, "l p"]]]:
        """Of each kind of landmarks, these being unknown: its part of ``information``, and of the gradient of camera
        and motion what each landmark contributes. The latter add to zero where the turntable is adjusted."""
        return [
            (
                part.motion - np.einsum("ldp,ldq->pq", part.coupling, through),
                part.motion_gradient - np.einsum("ldp,ld->lp", through, part.gradient),
            )
            for part, (_, through) in zip(self.landmarks, self._eliminated(0.0)[2], strict=True)
        ]

    def landmark_responses(self) -> list[Float[np.ndarray, "l d p"]]:
        """Derivatives of the landmarks that fit best by camera and motion, of each kind."""
        return [-through for _, through in self._eliminated(0.0)[2]]

    def _eliminated(self, damping):
        """Normal matrix and right side of camera and motion alone, and what leads back to the landmarks."""
        normal, right, back = self.motion.copy(), self.motion_gradient.copy(), []
        for part in self.landmarks:
            diagonal = np.einsum("lii->li", part.normal)
            floor = 1e-12 * (1.0 + diagonal.max(axis=0, initial=0.0))
            inverse = np.linalg.inv(
                part.normal + (damping * diagonal + floor)[:, :, None] * np.eye(diagonal.shape[1])
            )
            through = inverse @ part.coupling
            normal -= part.coupling.reshape(-1, len(normal)).T @ through.reshape(-1, len(normal))
            right -= through.reshape(-1, len(normal)).T @ part.gradient.ravel()
            back.append((inverse, through))
        return normal, right, back


@dataclass(frozen=True)
class LandmarkEquations:
    """Gauss-Newton equations of the landmarks of one kind, and their coupling with camera and motion."""

    normal: Float[np.ndarray, "l d d"]
    gradient: Float[np.ndarray, "l d"]
    coupling: Float[np.ndarray, "l d p"]
    motion: Float[np.ndarray, "p p"]
    """The equations of camera and motion by these landmarks' sightings; of the gradient, each landmark's part."""
    motion_gradient: Float[np.ndarray, "l p"]
