"""The normal equations against numerical derivatives, for markers and points alone and together."""

import numpy as np
import pytest
from exact_turntable import marker_observations, marker_turntable, point_tracks, point_turntable
from turntable_scene import MarkerScene

from hsi_sc_nerf.poses.bundle_adjustment import FreeParameters, Problem
from hsi_sc_nerf.poses.residuals import MarkerResiduals, PointResiduals

NO_LOSS = 1e9
"""So large a loss scale leaves the squares."""
H = 1e-6


def markers(turntable, rng, **free):
    observations = marker_observations(turntable, noise_px=0.5)
    weights = rng.normal(size=(len(observations), 8, 8))
    return MarkerResiduals(turntable, observations, NO_LOSS, weights, **free)


@pytest.mark.parametrize(
    ("kinds", "free"),
    [
        ("m", FreeParameters(radial_terms=2)),
        ("m", FreeParameters(radial_terms=1, motion_sigmas=(0.02, 0.003))),
        ("held", FreeParameters(camera=False, motion_sigmas=(0.02, 0.003))),
        ("sides", FreeParameters(camera=False, angles=False)),
        ("p", FreeParameters(distance=False, radial_terms=2)),
        ("mp", FreeParameters()),
        ("mp", FreeParameters(known_focal=(200.0, 0.01), known_angles=(np.ones(3), 0.01))),
    ],
)
def test_a_step_is_that_of_numerical_derivatives(kinds, free):
    rng = np.random.default_rng(0)
    start = marker_turntable(
        MarkerScene(frames=3, turn_deg=40.0, side_markers=2, disc_markers=2), radial=(-0.1, 0.05)
    )
    residuals = []
    if kinds != "p":
        options = {"held": {"free": False}, "sides": {"free_sides": True}}
        residuals.append(markers(start, rng, **options.get(kinds, {})))
    if "p" in kinds:
        start = point_turntable(start, 12)
        tracks = point_tracks(start, noise_px=0.5)
        residuals.append(PointResiduals(start, tracks, NO_LOSS, 0.7))
    problem = Problem(*residuals, free=free)
    size, m = problem.layout.size, problem.layout.motion_size

    def numbers(turntable):
        prior, _ = problem.priors(turntable)
        return np.concatenate([*(part.values(turntable).ravel() for part in residuals), prior])

    here = start if kinds == "sides" else problem.moved(start, 0.03 * rng.normal(size=size))
    # The turntable holds one side for all markers.
    moves = np.setdiff1d(np.arange(size), problem.layout.landmarks[0][:, 6:])
    ahead, back = (
        np.stack([numbers(problem.moved(here, d)) for d in sign * np.eye(size)[moves]]) for sign in (H, -H)
    )
    jacobian = (ahead - back).T / (2.0 * H)
    equations = problem.normal_equations(here)
    found = equations.jacobian.toarray()
    np.testing.assert_allclose(found[:, moves], jacobian, atol=1e-6 * np.abs(jacobian).max())
    np.testing.assert_allclose(equations.residual, numbers(here), rtol=1e-9)
    normal = found.T @ found
    whole = -np.linalg.lstsq(normal + np.diag(np.diag(normal)), found.T @ numbers(here))[0]
    if m:
        np.testing.assert_allclose(equations.solve(1.0), whole, atol=2e-5 * np.abs(whole).max())
    schur = normal[:m, :m] - normal[:m, m:] @ np.linalg.pinv(normal[m:, m:], hermitian=True) @ normal[m:, :m]
    np.testing.assert_allclose(equations.information(), schur, atol=1e-3 * np.abs(schur).max(initial=0.0))
