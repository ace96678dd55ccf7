"""Fractions of endmembers in mixed spectra."""

import numpy as np
import pytest
from halved_cylinder import BROWN, GREEN, NM

from hsi_sc_nerf.analysis.classes import unmix
from hsi_sc_nerf.analysis.library import SpectralLibrary
from hsi_sc_nerf.analysis.spectral_mesh import SpectralMesh
from hsi_sc_nerf.analysis.traits import classified
from hsi_sc_nerf.simulate.mesh import cylinder

RED = 0.5 + 0.3 * np.sin(NM / 60.0)
ENDMEMBERS = np.stack([GREEN, BROWN, RED])


@pytest.mark.slow
def test_fractions_of_mixtures_are_found_at_any_brightness():
    rng = np.random.default_rng(0)
    fractions = rng.dirichlet([0.5, 0.5, 0.5], 200)
    fractions[0] = [1.0, 0.0, 0.0]
    shade = rng.uniform(0.05, 1.5, (200, 1))
    found, angles = unmix(shade * (fractions @ ENDMEMBERS), ENDMEMBERS)
    np.testing.assert_allclose(found, fractions, atol=1e-6)
    assert angles.max() < 1e-3


def test_fractions_are_the_nearest_without_a_negative_one():
    """Against a search over all mixtures of two, brightness free."""
    spectrum = 1.3 * GREEN - 0.3 * BROWN + 0.02 * np.cos(NM / 20.0)
    steps = np.linspace(0.0, 1.0, 1001)
    mixtures = steps[:, None] * GREEN + (1.0 - steps[:, None]) * BROWN
    level = (mixtures @ spectrum) / np.square(mixtures).sum(axis=1)
    error = np.square(spectrum - level[:, None] * mixtures).sum(axis=1)
    fractions, angles = unmix(spectrum[None], ENDMEMBERS[:2])
    assert fractions[0] == pytest.approx([steps[error.argmin()], 1.0 - steps[error.argmin()]], abs=1e-3)
    assert angles[0] > 0.01


@pytest.mark.parametrize("spectrum", [np.zeros(31), np.full(31, -0.1)])
def test_what_holds_none_of_the_endmembers_has_no_fractions(spectrum):
    fractions, angles = unmix(spectrum[None], ENDMEMBERS)
    assert (fractions == 0.0).all()
    assert angles[0] == pytest.approx(np.pi / 2)


def test_endmembers_that_are_mixtures_of_others_do_no_harm():
    """A library with references between two others' has no single answer, but a finite one that adds up."""
    endmembers = np.stack([GREEN, 0.5 * GREEN + 0.5 * BROWN, BROWN, BROWN])
    fractions, angles = unmix((0.25 * GREEN + 0.75 * BROWN)[None], endmembers)
    assert fractions.sum() == pytest.approx(1.0)
    assert fractions[0, 0] + 0.5 * fractions[0, 1] == pytest.approx(0.25, abs=1e-6)
    assert angles[0] < 1e-3


def test_blur_moves_the_edge_of_a_class_by_angle_but_not_by_mixture():
    """A brown spot on green, sharp and then blurred, in light that falls off."""
    mesh = cylinder(0.04, 0.04, segments=128, spacing_m=0.001)
    distance_m = np.linalg.norm(mesh.vertices - [0.02, 0.0, 0.02], axis=1)
    light = np.linspace(0.2, 1.0, len(mesh.vertices))[:, None]
    library = SpectralLibrary(("green", "brown"), NM, np.stack([GREEN, BROWN]))
    by_angle, by_mixture = [], []
    for edge_m in (0.0001, 0.008):
        brown = np.clip(0.5 + (0.008 - distance_m) / edge_m, 0.0, 1.0)[:, None]
        spectra = (light * (brown * BROWN + (1.0 - brown) * GREEN)).astype(np.float32)
        surface = SpectralMesh(mesh, spectra, NM, np.ones(len(spectra), bool))
        found = classified(surface, library, 0.1)
        by_angle.append(found.areas_m2[1])
        by_mixture.append(found.mixture_areas_m2[1])
        assert found.mixture_areas_m2.sum() == pytest.approx(mesh.area_m2(), rel=0.01)
    assert by_mixture[1] == pytest.approx(by_mixture[0], rel=0.01)
    assert by_angle[0] == pytest.approx(by_mixture[0], rel=0.01)
    assert abs(by_angle[1] / by_angle[0] - 1.0) > 0.2


def even_surface(fractions):
    """A cylinder with one mixed spectrum everywhere."""
    mesh = cylinder(0.04, 0.04, segments=32, spacing_m=0.005)
    spectra = np.tile(np.float32(fractions) @ ENDMEMBERS, (len(mesh.vertices), 1)).astype(np.float32)
    return SpectralMesh(mesh, spectra, NM, np.ones(len(spectra), bool))


def test_references_of_one_name_are_one_class_of_a_mixture():
    """Two fifths of each of two skins and a fifth of a bruise are skin, not nothing."""
    surface = even_surface([0.4, 0.2, 0.4])
    found = classified(surface, SpectralLibrary(("skin", "bruise", "skin"), NM, ENDMEMBERS), 0.1)
    assert found.names == ("skin", "bruise")
    assert found.mixture_areas_m2 == pytest.approx([surface.mesh.area_m2(), 0.0])


def test_a_spot_of_which_no_class_has_half_is_of_none():
    surface = even_surface([0.45, 0.3, 0.25])
    found = classified(surface, SpectralLibrary(("green", "brown", "red"), NM, ENDMEMBERS), np.pi)
    assert (found.mixture_labels == -1).all()
    assert (found.labels >= 0).all()


def test_what_is_no_mixture_of_the_library_is_of_no_class():
    mesh = cylinder(0.04, 0.04, segments=64, spacing_m=0.002)
    left = mesh.vertices[:, 1:2] > 0.0
    surface = SpectralMesh(mesh, np.where(left, GREEN, RED).astype(np.float32), NM, np.ones(len(left), bool))
    found = classified(surface, SpectralLibrary(("green",), NM, GREEN[None]), 0.1)
    np.testing.assert_array_equal(found.mixture_labels, np.where(left[:, 0], 0, -1))
    assert found.mixture_areas_m2 == pytest.approx(found.areas_m2)
