"""Decisions by evidence, and that `process` keeps them."""

import shutil
from dataclasses import replace
from types import SimpleNamespace

import capture_factory as factory
import numpy as np
import pytest

from hsi_sc_nerf.calibration.lamp_drift import LampDriftEstimate, NotMeasurable
from hsi_sc_nerf.cli.sessions import InspectCommand
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.findings import effect_rows
from hsi_sc_nerf.packed.dataset import open_packed, write_transforms
from hsi_sc_nerf.poses.result import Uncertainty
from hsi_sc_nerf.processing.effects import (
    LEAST_POSE_ERROR_PX,
    lamp_drift,
    lens_distortion,
    pose_refinement,
    saturated_highlights,
    spectral_rank,
    still_chamber,
    view_dependence,
    wobble,
)
from hsi_sc_nerf.processing.view_changes import Change

BOX_M = np.array([[-0.04, -0.03, 0.07], [0.04, 0.03, 0.15]])
NAMES = "view_dependence still_chamber pose_refinement lamp_drift lens_distortion wobble saturated_highlights "
NAMES += "spectral_rank uneven_light"


def poses(**changes):
    return replace(factory.true_poses([None] * 4, ["a", "b", "c", "d"]), **changes)


def stated(rotation_deg):
    return Uncertainty(0.01, 0.01, 0.01, np.zeros(4), rotation_deg, 0.001)


@pytest.mark.parametrize(("rms", "noise", "present"), [(0.02, 0.001, True), (0.02, 0.008, False), (0.003, 0, False)])
def test_evidence_has_to_exceed_its_noise_and_a_least_size(rms, noise, present):
    effect = view_dependence(Change(rms, noise))
    assert (effect.present, effect.evidence, effect.noise) == (present, 100.0 * rms, 100.0 * noise)
    assert effect.present == (effect.evidence > effect.threshold)
    assert still_chamber(Change(rms, noise)).present == (rms > max(0.005, 3.0 * noise))


def test_what_cannot_be_measured_is_simulated_if_that_is_safer():
    assert view_dependence(None).present
    assert not still_chamber(None).present


def test_uncertain_poses_are_refined_by_what_they_move_the_surface():
    method = pose_refinement(poses(), BOX_M)
    assert (method.present, method.evidence) == (False, None)
    assert pose_refinement(poses(method="angles"), BOX_M).present
    one_px_deg = np.rad2deg(0.4 / (factory.INTRINSICS.fl_x * 0.04))
    centre_m = BOX_M.mean(axis=0)
    for elevation in np.deg2rad([0.0, 75.0]):
        cameras = np.tile(np.eye(4), (4, 1, 1))
        cameras[:, :3, 3] = centre_m + 0.4 * np.array([np.cos(elevation), 0.0, np.sin(elevation)])
        effect = pose_refinement(poses(camera_to_world=cameras, uncertainty=stated(one_px_deg)), BOX_M)
        assert effect.evidence == pytest.approx(1.0)
    for factor in (0.9, 1.1):
        uncertain = poses(camera_to_world=cameras, uncertainty=stated(factor * LEAST_POSE_ERROR_PX * one_px_deg))
        assert pose_refinement(uncertain, BOX_M).present == (factor > 1.0)


def test_what_calibration_and_poses_decided_is_reported():
    factor = np.ones((3, 4))
    factor[2] = 0.95
    drift = LampDriftEstimate(factor, factor, 0.001 * factor, np.ones((1, 1), bool), 0.0, 1e-8)
    assert (lamp_drift(drift, True).present, lamp_drift(drift, False).present) == (True, False)
    assert lamp_drift(drift, True).evidence == pytest.approx(8.0)
    assert "-5.00 %" in lamp_drift(drift, True).sentence
    assert "-5.00 %, which calibration has not corrected" in lamp_drift(drift, False).sentence
    steady = lamp_drift(replace(drift, p_value=1.0), False)
    assert (steady.evidence, steady.sentence) == (0.0, "The frames show no change of the lamps beyond noise.")
    assert lamp_drift(NotMeasurable("it is dark"), False).evidence is None
    found = poses(evidence={"lens_distortion": 20.0, "wobble": 1.0}, distortion=(-0.1, 0.0, 0.0, 0.0))
    lens, table = lens_distortion(found), wobble(found)
    assert (lens.present, lens.evidence, table.present, table.evidence) == (True, 20.0, False, 1.0)
    corner = np.hypot(24.0, 24.0) / 90.0
    assert f"{0.1 * corner**3 * 90.0:.2g} px" in lens.sentence
    assert lens_distortion(poses(distortion=(-0.1, 0.0, 0.0, 0.0))).evidence is None


def test_saturated_pixels_count_on_the_object_alone():
    masks = np.zeros((1, 10, 10), bool)
    masks[0, :5] = True
    flags = np.zeros((10, 10), np.uint8)
    dataset = SimpleNamespace(frames=[SimpleNamespace(flags=lambda: flags)])
    flags[7], flags[0, 1] = 1, 2  # saturated beside the object, dead on it
    assert not saturated_highlights(dataset, masks).present
    flags[0, 0] = 1
    effect = saturated_highlights(dataset, masks)
    assert (effect.present, effect.evidence) == (True, pytest.approx(2.0))


def test_process_keeps_the_decisions(tiny_dataset):
    dataset = open_packed(tiny_dataset[0])
    assert " ".join(effect.name for effect in dataset.effects) == NAMES
    found = {effect.name: effect for effect in dataset.effects}
    # A matte pear in even light before an even wall, with poses from markers.
    for name in ("view_dependence", "still_chamber", "pose_refinement", "lamp_drift", "wobble", "uneven_light"):
        assert not found[name].present, found[name]
    assert found["spectral_rank"] == spectral_rank(dataset)
    assert 1 < found["spectral_rank"].evidence < 12
    assert (dataset.root / "report" / "effects.png").stat().st_size > 5000
    assert [row[1] for row in effect_rows(dataset.effects)].count("yes") == sum(e.present for e in dataset.effects)


def test_inspect_tells_them_of_a_dataset(tiny_dataset, tmp_path, capsys):
    InspectCommand(tiny_dataset[0]).main()
    with pytest.raises(InputError, match="--output-dir and --exclude are for a session"):
        InspectCommand(tiny_dataset[0], output_dir=tmp_path).main()
    shown = capsys.readouterr().out
    assert all(name in shown for name in NAMES.split())
    old = tmp_path / "old"
    shutil.copytree(tiny_dataset[0], old)
    write_transforms(replace(open_packed(old), effects=()))
    with pytest.raises(InputError, match="process"):
        InspectCommand(old).main()
