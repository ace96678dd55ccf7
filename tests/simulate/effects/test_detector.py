"""Effects of the sensor: each against its closed form, any two against their definitions, and none unless named."""

import dataclasses
import functools
import itertools

import numpy as np
import pytest
from scipy import stats

from hsi_sc_nerf.calibration.white_reference import white_reference
from hsi_sc_nerf.capture.envi import open_cube
from hsi_sc_nerf.capture.session import open_session
from hsi_sc_nerf.simulate import assemble, frames
from hsi_sc_nerf.simulate.effect import effect_rng
from hsi_sc_nerf.simulate.effects import detector as sensor
from hsi_sc_nerf.simulate.effects.detector import FEW_ELECTRONS, many_electrons, poisson
from hsi_sc_nerf.simulate.effects.image import gaussian_kernel
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.simulate.light import render
from hsi_sc_nerf.simulate.materials import Measured, endmembers
from hsi_sc_nerf.simulate.scene import load_scene, override, read_effects
from hsi_sc_nerf.simulate.session import simulate_session
from hsi_sc_nerf.simulate.truth import load_truth

DARK, LARGEST = 120, 4095
ELECTRONS_PER_COUNT = 30_000.0 / LARGEST
ALL_BUT_A_MILLIONTH = stats.norm.isf(0.5e-6)


def scene(name="sphere", size_px=24, bands=6, frames=2, **effects):
    """A shipped scene with effects, by name and strengths."""
    changed = override(load_scene(name), size_px=size_px, bands=bands, frames=frames)
    return dataclasses.replace(changed, effects=read_effects([{k: v} for k, v in effects.items()], "test"))


@functools.cache
def quiet(size_px, bands):
    """The scene without effects, simulated once for all tests."""
    return Simulation(scene(size_px=size_px, bands=bands))


def tarp(cube):
    """The pixels of a white capture that see nothing but tarp."""
    edge = round(frames.TARP_MARGIN * len(cube))
    return cube[edge:-edge, edge:-edge].reshape(-1, cube.shape[-1]).astype(float)


# Noise


def test_photon_transfer_curve():
    counts = tarp(
        Simulation(scene(size_px=160, bands=24, photon_noise={}, read_noise={"electrons": 60.0})).white().counts
    )
    mean, variance = counts.mean(axis=0) - DARK, counts.var(axis=0, ddof=1)
    assert mean.max() > 8 * mean.min()
    expected = mean / ELECTRONS_PER_COUNT + (60.0 / ELECTRONS_PER_COUNT) ** 2 + 1.0 / 12.0
    degrees = len(counts) - 1
    assert (variance / expected < stats.chi2.isf(1e-6, degrees) / degrees).all()
    assert (variance / expected > stats.chi2.ppf(1e-6, degrees) / degrees).all()
    # The line itself, weighted by what is known of each variance.
    error = expected * np.sqrt(2.0 / degrees)
    line, covariance = np.polyfit(mean, variance, 1, w=1.0 / error, cov="unscaled")
    slope_error, offset_error = np.sqrt(np.diag(covariance))
    assert line[0] == pytest.approx(1.0 / ELECTRONS_PER_COUNT, abs=ALL_BUT_A_MILLIONTH * slope_error)
    assert slope_error < 0.02 / ELECTRONS_PER_COUNT
    read_noise = (60.0 / ELECTRONS_PER_COUNT) ** 2 + 1.0 / 12.0
    assert line[1] == pytest.approx(read_noise, abs=ALL_BUT_A_MILLIONTH * offset_error)
    assert offset_error < 0.03 * read_noise


def test_every_exposure_has_noise_of_its_own_and_the_same_seed_the_same():
    simulation = Simulation(scene(photon_noise={}, read_noise={}))
    first, second, again = simulation.frame(0), simulation.frame(1), Simulation(simulation.scene).frame(0)
    np.testing.assert_array_equal(first.counts, again.counts)
    np.testing.assert_array_equal(first.dark, again.dark)
    assert (first.dark != second.dark).mean() > 0.5
    other = Simulation(dataclasses.replace(simulation.scene, seed=99)).frame(0)
    assert (first.counts != other.counts).mean() > 0.5


@pytest.mark.parametrize("mean", [FEW_ELECTRONS, 100.0, 1000.0, 20_000.0])
def test_many_electrons_are_distributed_like_poisson_numbers(mean):
    # The step from k to k + 1 lies at one z, found by bisection: no drawing, no chance.
    low, high = stats.poisson.ppf([1e-9, 1.0 - 1e-9], mean)
    number = np.arange(low, high + 1)
    below, above = np.full((2, len(number)), [[-9.0], [9.0]])
    for _ in range(50):
        z = (below + above) / 2.0
        is_above = many_electrons(np.full(len(z), mean), z) > number
        below, above = np.where(is_above, below, z), np.where(is_above, z, above)
    assert np.abs(stats.norm.cdf(z) - stats.poisson.cdf(number, mean)).max() < 2e-4
    probability = np.diff(stats.norm.cdf(z))
    moments = [(probability * number[1:] ** power).sum() / probability.sum() for power in (1, 2)]
    assert moments[0] == pytest.approx(mean, rel=1e-4)
    assert moments[1] - moments[0] ** 2 == pytest.approx(mean, rel=2e-3)


def test_few_electrons_are_poisson_numbers():
    drawn = poisson(np.full((300, 100), 0.7, np.float32), np.random.default_rng(0))
    fractions = np.bincount(drawn.astype(int).ravel(), minlength=5)[:5] / drawn.size
    error = np.sqrt(stats.poisson.pmf(range(5), 0.7) / drawn.size)
    assert (np.abs(fractions - stats.poisson.pmf(range(5), 0.7)) < ALL_BUT_A_MILLIONTH * error).all()
    assert (poisson(np.zeros((4, 4), np.float32), np.random.default_rng(0)) == 0.0).all()


@pytest.mark.slow
def test_calibration_of_a_noisy_white_sphere_is_unbiased(tmp_path):
    quiet_scene = scene(size_px=96, bands=8)
    noisy = dataclasses.replace(quiet_scene, effects=read_effects(["photon_noise", "read_noise", "dark_pattern"], ""))
    simulate_session(noisy, tmp_path / "s", False)
    session, truth = open_session(tmp_path / "s"), load_truth(tmp_path / "s")
    white = white_reference(session.white).measured
    for capture in session.frames:
        dark = capture.dark.read().mean(axis=0)
        # Without the clip to [0, 1], which halves the noise of what is white and so moves its mean.
        reflectance = (capture.cube.read() - dark) / white
        sphere = reflectance[truth.object_coverage(capture.name) == 1.0]
        assert len(sphere) > 400
        error = sphere.std(axis=0) / np.sqrt(len(sphere))
        # Half a count of rounding in the dark level's mean is far less than the noise that dithers it.
        assert (np.abs(sphere.mean(axis=0) - 1.0) < ALL_BUT_A_MILLIONTH * error).all()
        assert (error < 0.003).all()


# Detector


def test_dark_pattern_is_the_same_in_all_exposures():
    simulation, even = Simulation(scene(size_px=64, bands=40, dark_pattern={"spread": 8.0})), quiet(64, 40)
    pattern = simulation.detector_maps["dark_pattern"]["dark_offset"]
    degrees = pattern.size - 1
    assert pattern.var(ddof=1) == pytest.approx(64.0, rel=ALL_BUT_A_MILLIONTH * np.sqrt(2.0 / degrees))
    assert pattern.mean() == pytest.approx(0.0, abs=ALL_BUT_A_MILLIONTH * 8.0 / np.sqrt(pattern.size))
    for capture, without in ((simulation.white(), even.white()), (simulation.frame(1), even.frame(1))):
        np.testing.assert_array_equal(capture.dark, np.broadcast_to(np.rint(DARK + pattern), capture.dark.shape))
        # Each rounded on its own: a count apart at most.
        added = capture.counts.astype(float) - without.counts - pattern
        assert np.abs(added).max() <= 1.0 + 1e-3


def test_bad_pixels_and_dead_bands_are_where_the_maps_say_and_nothing_else_changes():
    fractions = {"dead_fraction": 0.01, "hot_fraction": 0.02}
    even, single = quiet(40, 30), Simulation(scene(size_px=40, bands=30, bad_pixels=fractions))
    banded = Simulation(scene(size_px=40, bands=30, bad_pixels={**fractions, "dead_bands": 3}))
    maps, more = (simulation.detector_maps["bad_pixels"] for simulation in (single, banded))
    assert maps["dead"].shape == (40, 30)
    assert (maps["dead"].sum(), maps["hot"].sum(), (maps["dead"] & maps["hot"]).sum()) == (12, 24, 0)
    # Dead bands come on top of the other bad pixels.
    dead_bands = more["dead"].all(axis=0)
    assert dead_bands.sum() == 3
    assert not more["hot"][:, dead_bands].any()
    for name in ("dead", "hot"):
        np.testing.assert_array_equal(more[name][:, ~dead_bands], maps[name][:, ~dead_bands])
    for simulation in (single, banded):
        dead, hot = (simulation.detector_maps["bad_pixels"][name] for name in ("dead", "hot"))
        for capture, without in ((simulation.white(), even.white()), (simulation.frame(0), even.frame(0))):
            for cube, reference in ((capture.counts, without.counts), (capture.dark, without.dark)):
                assert (cube[:, dead] == DARK).all()
                assert (cube[:, hot] == LARGEST).all()
                kept = np.broadcast_to(reference, cube.shape)
                np.testing.assert_array_equal(cube[:, ~dead & ~hot], kept[:, ~dead & ~hot])


@pytest.mark.slow
def test_saturation_clips_exactly_where_truth_says(tmp_path):
    changed = scene(size_px=40, bands=12, saturation={"exposure_factor": 1.6})
    simulate_session(changed, tmp_path / "s", False)
    truth = load_truth(tmp_path / "s")
    simulation, even = Simulation(changed), quiet(40, 12)
    signal = 1.6 * sensor.white_signal(changed.sensor, truth.wavelengths_nm)
    clipped = []
    for capture in truth.captures:
        counts = open_cube(tmp_path / "s" / capture / "capture" / f"{capture}.hdr").read()
        unlimited = np.rint(truth.light(capture).radiance(signal_of_white=signal) + DARK)
        np.testing.assert_array_equal(counts, np.minimum(unlimited, LARGEST))
        clipped.append((unlimited > LARGEST).mean())
        metadata = (tmp_path / "s" / capture / "metadata" / f"{capture}.xml").read_text()
        assert '<key field="integration_time" unit="ms">16.0</key>' in metadata
    assert 0.05 < np.mean(clipped) < 0.9
    # The tarp is taken with the same integration time, so where neither stops the ratio is the one without.
    white, white_quiet = tarp(simulation.white().counts)[0], tarp(even.white().counts)[0]
    assert (white == LARGEST).any()
    frame, frame_quiet = simulation.frame(0).counts, even.frame(0).counts
    fits = (frame < LARGEST) & (white < LARGEST)
    ratio, ratio_quiet = (frame - DARK) / (white - DARK), (frame_quiet - DARK) / (white_quiet - DARK)
    assert np.abs(ratio - ratio_quiet)[fits].max() < 1.0 / (white_quiet.min() - DARK)
    np.testing.assert_array_equal(simulation.frame(0).dark, even.frame(0).dark)


def test_a_sharp_edge_of_a_spectrum_shifts_by_the_smiles_parabola():
    edge = Measured((300.0, 690.0, 710.0, 1100.0), (0.1, 0.1, 0.9, 0.9))
    changed = dataclasses.replace(
        scene(size_px=32, bands=204, spectral_smile={"shift_nm": 4.0}), materials={"chamber": edge}
    )
    simulation = Simulation(changed)
    white, frame = simulation.white().counts, simulation.frame(0)
    assert (frame.material_weights[0, :, -1] == 1.0).all()
    for sample in range(4, 28):
        # Each sample divided by the tarp at the same sample, as a line-scan camera is calibrated.
        ratio = (frame.counts[0, sample] - float(DARK)) / (white[16, sample] - float(DARK))
        rise = slice(ratio.searchsorted(0.2), ratio.searchsorted(0.8))
        seen_nm = np.interp(0.5, ratio[rise], simulation.wavelengths_nm[rise])
        from_middle = (sample + 0.5) / 16.0 - 1.0
        assert seen_nm == pytest.approx(700.0 - 4.0 * from_middle**2, abs=0.03)
    np.testing.assert_array_equal(simulation.wavelengths_nm, sensor.band_centres_nm(204))


# Exposure


def test_tarp_of_its_own_integration_time():
    usual, changed = quiet(24, 6), Simulation(scene(tarp_exposure={"exposure_factor": 0.4}))
    white, frame = changed.white(), changed.frame(1)  # their times are looked at in test_session.py
    np.testing.assert_array_equal(frame.counts, usual.frame(1).counts)
    signal, expected = white.counts - float(DARK), 0.4 * (usual.white().counts - float(DARK))
    # Each rounded on its own.
    assert np.abs(signal - expected).max() <= 0.5 + 0.4 * 0.5 + 1e-3
    np.testing.assert_array_equal(white.dark, usual.white().dark)


# Orientation


@pytest.mark.parametrize("quarter_turns", [1, 2, 3])
def test_a_rotated_image_is_the_upright_one_turned(quarter_turns):
    rotated = Simulation(scene(size_px=40, image_rotation={"quarter_turns": quarter_turns}))
    frame, upright = rotated.frame(1), quiet(40, 6).frame(1)
    np.testing.assert_array_equal(frame.counts, np.rot90(upright.counts, quarter_turns))
    assert (frame.counts != upright.counts).any()
    np.testing.assert_array_equal(frame.material_weights, upright.material_weights)
    np.testing.assert_array_equal(frame.dark, upright.dark)


def test_rotation_leaves_the_detector_where_it_is_and_truth_knows_its_maps(tmp_path):
    bad_pixels = {"dead_fraction": 0.05, "hot_fraction": 0.02}
    turned = scene(size_px=32, image_rotation={}, dark_pattern={"spread": 30.0}, bad_pixels=bad_pixels)
    truth = load_truth(simulate_session(turned, tmp_path / "s", False))
    assert truth.effects["image_rotation"] == {"quarter_turns": 1}
    simulation = Simulation(turned)
    maps, frame = truth.detector_maps(), simulation.frame(0)
    for effect in ("dark_pattern", "bad_pixels"):
        for name, expected in simulation.detector_maps[effect].items():
            np.testing.assert_array_equal(maps[name], expected)
    good = ~maps["hot"] & ~maps["dead"]
    assert (frame.counts[:, maps["hot"]] == LARGEST).all()
    assert (frame.counts[:, maps["dead"]] == DARK).all()
    np.testing.assert_array_equal(frame.dark.mean(axis=0)[good], np.rint(DARK + maps["dark_offset"])[good])
    light = truth.light(truth.captures[0]).radiance()
    np.testing.assert_allclose(light, np.rot90(truth.reflectance(truth.captures[0])), atol=1e-6)


# Together and off

STRENGTHS = {
    "lens_distortion": {"k1": -0.35, "k2": 0.2, "p1": 0.004, "p2": -0.006},
    "optical_blur": {"sigma_px": 1.1},
    "image_rotation": {"quarter_turns": 1},
    "spectral_smile": {"shift_nm": 5.0},
    "saturation": {"exposure_factor": 1.4},
    "photon_noise": {},
    "dark_pattern": {"spread": 9.0},
    "read_noise": {"electrons": 50.0},
    "bad_pixels": {"dead_fraction": 0.05, "hot_fraction": 0.05},
}


def by_definition(changed, renderer, exposure):
    """Counts of a frame from what each effect says it is, written down once more without the stages."""
    on = {effect.name: effect for effect in changed.effects}
    camera = assemble.intrinsics(changed.camera), assemble.first_camera(changed.camera)
    lens = on.get("lens_distortion")
    view = *camera, changed.camera.supersampling, lens and lens.straighten
    weights = render(renderer, *view).material_weights
    if "optical_blur" in on:
        kernel = gaussian_kernel(on["optical_blur"].sigma_px)
        reach, size = len(kernel) // 2, len(weights)
        matrix = np.zeros((size, size))
        for i, k in itertools.product(range(size), range(len(kernel))):
            mirrored = (i + k - reach) % (2 * size)
            matrix[i, min(mirrored, 2 * size - 1 - mirrored)] += kernel[k]
        weights = np.einsum("il,lsm,js->ijm", matrix, weights, matrix)
    if "image_rotation" in on:
        weights = weights.swapaxes(0, 1)[::-1]
    nm = np.tile(sensor.band_centres_nm(changed.sensor.bands), (len(weights), 1))
    if "spectral_smile" in on:
        nm += on["spectral_smile"].shift_nm * np.linspace(-1, 1, 2 * len(nm) + 1)[1::2, None] ** 2
    signal = sensor.white_signal(changed.sensor, nm)
    if "saturation" in on:
        signal = signal * on["saturation"].exposure_factor
    counts = np.einsum("ijm,mjb->ijb", weights, endmembers(renderer.materials, nm)) * signal + DARK

    def rng(name, *exposure):
        return effect_rng(changed.seed, on[name], *exposure)

    if "photon_noise" in on:
        electrons = ((counts - DARK) * ELECTRONS_PER_COUNT).astype(np.float32)
        random = rng("photon_noise", exposure, 0)
        counts = np.stack([poisson(line, random) for line in electrons]) / ELECTRONS_PER_COUNT + DARK
    if "dark_pattern" in on:
        counts = counts + 9.0 * rng("dark_pattern").standard_normal(counts.shape[1:], dtype=np.float32)
    if "read_noise" in on:
        noise = rng("read_noise", exposure, 0).standard_normal(counts.shape, dtype=np.float32)
        counts = counts + 50.0 / ELECTRONS_PER_COUNT * noise
    if "bad_pixels" in on:
        shape = counts.shape[1:]
        order = rng("bad_pixels").permutation(shape[0] * shape[1])
        fraction = round(0.05 * len(order))
        samples, bands = np.unravel_index(order[: 2 * fraction], shape)
        counts[:, samples[:fraction], bands[:fraction]] = DARK
        counts[:, samples[fraction:], bands[fraction:]] = LARGEST
    return np.clip(np.rint(counts), 0, LARGEST)


@pytest.mark.slow
def test_effects_together_are_what_their_definitions_say():
    renderer = assemble.build_renderer(scene(), assemble.object_part(scene()))
    for pair in [*itertools.pairwise(STRENGTHS), tuple(STRENGTHS)]:
        # Named in the wrong order: what counts is the order of EFFECTS.
        changed = scene(**{name: STRENGTHS[name] for name in reversed(pair)})
        counts = Simulation(changed).frame(0).counts
        off = np.abs(counts - by_definition(changed, renderer, exposure=1))
        # Sums in another order round a few numbers, and electrons, to the other side.
        assert off.max() <= 1.0, pair
        assert (off > 0).mean() < 0.005, pair
