"""A fruit in closed form: a ball with a cap of another colour at a pole, and a rod on top as its stem."""

import numpy as np

from hsi_sc_nerf.export.cloud import SpectralCloud

NM = np.linspace(400.0, 1000.0, 31)
RADIUS_M, STEM_M, STEM_RADIUS_M, CAP_DEG = 0.03, 0.02, 0.0025, 30.0
CAP_CM2 = 2e4 * np.pi * RADIUS_M**2 * (1.0 - np.cos(np.deg2rad(CAP_DEG)))
SKIN = 0.6 / (1.0 + np.exp((560.0 - NM) / 25.0))
GREEN = 0.55 / (1.0 + np.exp((700.0 - NM) / 15.0)) + 0.1 * np.exp(-(((NM - 550.0) / 30.0) ** 2))
BROWN = np.linspace(0.05, 0.4, len(NM))


def ball(count, rng):
    normals = rng.normal(size=(count, 3))
    return RADIUS_M * normals / np.linalg.norm(normals, axis=1, keepdims=True)


def rod(length_m, radius_m, count, rng):
    """An open tube that stands on z = 0."""
    azimuth = rng.uniform(0.0, 2.0 * np.pi, count)
    height_m = rng.uniform(0.0, length_m, count)
    return np.stack([radius_m * np.cos(azimuth), radius_m * np.sin(azimuth), height_m], axis=-1)


def noisy(spectra, rng):
    """Shade, and the white errors of a run's cloud."""
    return spectra * rng.uniform(0.6, 1.0, (len(spectra), 1)) * rng.normal(1.0, 0.02, spectra.shape)


def fruit(stem=BROWN, cap=GREEN, count=20_000, cap_at=-1.0):
    """Points of one density on the surface, their spectra, and which of them belong to what."""
    rng = np.random.default_rng(0)
    body = ball(count, rng)
    of_rod = int(count * STEM_M * STEM_RADIUS_M / (2.0 * RADIUS_M**2))
    stalk = rod(STEM_M, STEM_RADIUS_M, of_rod, rng) + np.array([0.0, 0.0, RADIUS_M])
    on_cap = np.append(cap_at * body[:, 2] > RADIUS_M * np.cos(np.deg2rad(CAP_DEG)), np.zeros(of_rod, bool))
    on_stem = np.arange(count + of_rod) >= count
    spectra = np.where(on_stem[:, None], stem, np.where(on_cap[:, None], cap, SKIN))
    return np.concatenate([body, stalk]), noisy(spectra, rng), {"stem": on_stem, "calyx": on_cap}


def fruit_cloud(**changes):
    """The same with normals, as a cloud."""
    points_m, spectra, true = fruit(**changes)
    normals = np.where(true["stem"][:, None], points_m * [1.0, 1.0, 0.0], points_m)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    arrays = (one.astype(np.float32) for one in (points_m, normals))
    return SpectralCloud(*arrays, np.full(points_m.shape, 128, np.uint8), spectra.astype(np.float32), NM)
