"""Endmembers and components of surfaces that were mixed of known materials."""

import numpy as np
import pytest

from hsi_sc_nerf.analysis.classes import spectral_angles
from hsi_sc_nerf.analysis.components import find_components, purest_spectra
from hsi_sc_nerf.analysis.spectral_mesh import SpectralMesh
from hsi_sc_nerf.simulate.mesh import cylinder

NM = np.linspace(400.0, 1000.0, 31)
PURE = np.stack([np.linspace(0.1, 0.6, 31), np.linspace(0.4, 0.3, 31), 0.5 + 0.3 * np.sin(NM / 60.0)])


def mixed(count, seed=0, noise=0.0):
    """Mixtures, the first three pure, at any brightness."""
    rng = np.random.default_rng(seed)
    fractions = rng.dirichlet([0.7, 0.7, 0.7], count)
    fractions[:3] = np.eye(3)
    brightness = rng.uniform(0.6, 1.2, (count, 1))
    return brightness * (fractions @ PURE) + noise * rng.standard_normal((count, 31)), fractions


@pytest.mark.parametrize("seed", range(5))
def test_the_purest_spectra_of_mixtures_are_the_pure_ones(seed):
    spectra, _ = mixed(300, seed)
    basis = np.linalg.svd(spectra, full_matrices=False)[2][:3].T
    assert set(purest_spectra(spectra @ basis, 3)) == {0, 1, 2}


@pytest.mark.parametrize("seed", [0, 3, 9])
def test_without_pure_spectra_no_other_three_span_more(seed):
    spectra = mixed(40, seed)[0][3:]
    basis = np.linalg.svd(spectra, full_matrices=False)[2][:3].T
    coordinates = spectra @ basis
    scaled = coordinates / (coordinates @ coordinates.mean(axis=0))[:, None]
    found = abs(np.linalg.det(scaled[purest_spectra(coordinates, 3)]))
    every = (abs(np.linalg.det(scaled[[i, j, k]])) for i in range(37) for j in range(i) for k in range(j))
    assert found >= 0.98 * max(every)


def surface_of(noise, scatter):
    mesh = cylinder(0.04, 0.04, segments=64, spacing_m=0.002)
    count = len(mesh.vertices)
    spectra, fractions = mixed(count, noise=noise)
    seen = np.arange(count) % 10 != 9
    known = np.full(count, noise) if scatter else None
    return SpectralMesh(mesh, spectra.astype(np.float32), NM, seen, scatter=known), fractions


@pytest.mark.parametrize("scatter", [True, False])
def test_a_surface_has_as_many_components_as_materials_and_no_more(scatter):
    surface, fractions = surface_of(0.001, scatter)
    found = find_components(surface, 8)
    assert found.supported == 3
    order = spectral_angles(PURE, found.endmembers.spectra).argmin(axis=1)
    assert set(order) == {0, 1, 2}
    np.testing.assert_allclose(found.fractions[surface.seen][:, order], _scaled(fractions)[surface.seen], atol=0.06)
    assert np.isnan(found.fractions[~surface.seen]).all()
    assert np.isnan(found.scores[~surface.seen]).all()
    assert find_components(surface, 2).scores.shape[1] == 2


def _scaled(fractions):
    """Fractions of amounts are of the endmembers as found, whose brightness is that of their vertices."""
    brightness = np.random.default_rng(0)
    brightness.dirichlet([0.7, 0.7, 0.7], len(fractions))
    of_pure = brightness.uniform(0.6, 1.2, (len(fractions), 1))[:3, 0]
    amounts = fractions / of_pure
    return amounts / amounts.sum(axis=1, keepdims=True)


def test_scores_are_those_of_a_singular_value_decomposition():
    surface, _ = surface_of(0.001, True)
    found = find_components(surface, 2)
    weights = surface.areas_m2[surface.seen]
    spectra = surface.spectra[surface.seen].astype(float)
    centred = spectra - np.average(spectra, axis=0, weights=weights)
    _, singular, directions = np.linalg.svd(centred * np.sqrt(weights)[:, None], full_matrices=False)
    expected = centred @ directions[:2].T
    scores = found.scores[surface.seen]
    np.testing.assert_allclose(np.abs(scores), np.abs(expected), atol=1e-8)
    np.testing.assert_allclose(found.variance_fractions, (singular**2 / (singular**2).sum())[:2])
