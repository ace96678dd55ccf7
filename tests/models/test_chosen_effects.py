"""Which effects a model simulates, and that it is built of these alone."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from small_trainer import trainer

from hsi_sc_nerf.config import hsi_sc_nerf_paper
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.findings import EffectEvidence
from hsi_sc_nerf.models.chosen_effects import MODEL_EFFECTS, chosen_effects, effects_setting, require_effects
from hsi_sc_nerf.models.spectral_model import SpectralModelConfig
from hsi_sc_nerf.packed.dataset import open_packed, write_transforms

pytestmark = pytest.mark.usefixtures("quick_start")


def effect(name, present):
    return EffectEvidence(name, present, 2.0, 0.1, 1.0, "%", "A sentence.")


def with_effects(dataset, *present):
    effects = tuple(effect(name, name in present) for name in (*MODEL_EFFECTS, "wobble"))
    return replace(dataset, effects=effects)


@pytest.fixture
def dataset(tiny_dataset):
    return open_packed(tiny_dataset[0])


def copied(tiny_dataset, folder, *present):
    """The tiny dataset with other decisions."""
    shutil.copytree(tiny_dataset[0], folder)
    write_transforms(with_effects(open_packed(folder), *present))
    return folder, tiny_dataset[1]


def made(dataset, folder, effects="auto", **changes):
    made = trainer(dataset, folder, effects=effects, **changes)
    return made, made.pipeline.model


def test_the_evidence_or_the_user_decides(dataset):
    found = with_effects(dataset, "still_chamber", "wobble")
    assert chosen_effects("auto", found) == ("still_chamber",)
    assert chosen_effects("none", found) == ()
    assert chosen_effects("pose_refinement,view_dependence", found) == ("view_dependence", "pose_refinement")
    for effects in ((), MODEL_EFFECTS, MODEL_EFFECTS[1:]):
        assert chosen_effects(effects_setting(effects), found) == effects


def test_an_older_dataset_has_all_effects(dataset):
    old = replace(dataset, effects=())
    assert chosen_effects("auto", old) == ("view_dependence", "still_chamber")
    assert chosen_effects("auto", replace(old, pose_method="colmap")) == MODEL_EFFECTS


@pytest.mark.parametrize("setting", ["gloss", "view_dependence,wobble", "", "auto,none"])
def test_unknown_effects_are_refused(setting):
    with pytest.raises(InputError, match="effect"):
        require_effects(setting)
    with pytest.raises(SystemExit, match=r"--pipeline\.model\.effects"):
        SpectralModelConfig(effects=setting)


def test_the_published_preset_keeps_what_it_has():
    model = hsi_sc_nerf_paper.config.pipeline.model
    assert (model.effects, model.background) == ("view_dependence", "last-sample")
    assert model.camera_optimizer.mode == "free-discarded"


@pytest.mark.slow
def test_what_is_off_is_not_built(tiny_dataset, tmp_path):
    _, bare = made(tiny_dataset, tmp_path / "none", "none")
    _, full = made(tiny_dataset, tmp_path / "all", ",".join(MODEL_EFFECTS))
    assert bare.field.shading is None
    assert full.field.shading is not None
    assert not full.field.view_dependent  # the normal stands in for the viewing direction
    assert bare.background.image is None
    assert full.background.image is not None
    assert [*bare.camera_optimizer.parameters()] == []
    assert len([*full.camera_optimizer.parameters()]) == 2
    assert "camera_opt" not in bare.get_param_groups()


@pytest.mark.slow
def test_a_run_keeps_its_effects_when_the_dataset_changes(tiny_dataset, tmp_path):
    data = copied(tiny_dataset, tmp_path / "data", "view_dependence")
    first, model = made(data, tmp_path / "run")
    assert model.effects == ("view_dependence",)
    first.save_checkpoint(0)
    write_transforms(with_effects(open_packed(data[0]), "still_chamber"))
    saved = yaml.load(Path(first.base_dir / "config.yml").read_text(), Loader=yaml.Loader)
    assert saved.pipeline.model.effects == "view_dependence"
    resumed, model = made(data, tmp_path / "resumed", load_dir=first.checkpoint_dir)
    assert model.effects == ("view_dependence",)
    assert resumed._start_step == 1
    both = made(data, tmp_path / "both", "pose_refinement,view_dependence")[0]
    both.save_checkpoint(0)
    made(data, tmp_path / "again", "pose_refinement,view_dependence", load_dir=both.checkpoint_dir)
    _, anew = made(data, tmp_path / "anew")
    assert anew.effects == ("still_chamber",)
    with pytest.raises(SystemExit, match="view_dependence"):
        made(data, tmp_path / "other", "none", load_dir=first.checkpoint_dir)


def test_effects_are_stored_and_read_back(tiny_dataset, tmp_path):
    data, _ = copied(tiny_dataset, tmp_path / "data", "view_dependence")
    unknown = EffectEvidence("wobble", False, None, None, None, "-log10 p", "Not looked for.")
    dataset = replace(open_packed(data), effects=(effect("still_chamber", True), unknown))
    write_transforms(dataset)
    assert open_packed(data).effects == dataset.effects
    path = data / "transforms.json"
    content = json.loads(path.read_text())
    del content["effects"][0]["present"]
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="present"):
        open_packed(data)
    del content["effects"]
    path.write_text(json.dumps(content))
    assert open_packed(data).effects == ()
