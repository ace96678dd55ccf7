"""Nonsense in an option is refused when it is read, in any command."""

from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Literal, get_args, get_origin, get_type_hints

import numpy as np
import pytest

from hsi_sc_nerf.analysis.library import SpectralLibrary, write_library
from hsi_sc_nerf.batch.session_steps import SessionSettings
from hsi_sc_nerf.cli.change import ChangeCommand
from hsi_sc_nerf.cli.main import COMMANDS, _imported
from hsi_sc_nerf.cli.step_words import check_words
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.evaluation.comparison import CompareConfig
from hsi_sc_nerf.processing.masks import MaskConfig
from hsi_sc_nerf.processing.process import ProcessConfig, process_session
from hsi_sc_nerf.settings_file import check_options

CHECKED_ELSEWHERE = {
    *(f"simulate {name}" for name in ("frames", "size", "bands", "seed")),  # with those of the scene
    "traits roi",  # has a name among its numbers
    "benchmark checkpoints",  # above 0
}


def numbers_of(cls, prefix):
    """Name, and whether it has a range, of each option that is a number or several."""
    hints = get_type_hints(cls)
    for one in fields(cls):
        if is_dataclass(hints[one.name]):
            yield from numbers_of(hints[one.name], f"{prefix}{one.name}.")
        elif is_number(hints[one.name]):
            yield prefix + one.name, "range" in one.metadata


def is_number(hint):
    return hint in (int, float) or (get_origin(hint) is not Literal and any(map(is_number, get_args(hint))))


@pytest.mark.slow
def test_every_option_that_is_a_number_has_a_range():
    found = {name: ranged for command in COMMANDS for name, ranged in numbers_of(_imported(command), f"{command} ")}
    assert {name for name, ranged in found.items() if not ranged} == CHECKED_ELSEWHERE
    assert len(found) > 40


@pytest.mark.parametrize(
    ("config", "told"),
    [
        (ProcessConfig(masks=MaskConfig(pieces=0)), r"--masks\.pieces is 0; it must lie between 1 and 1000\."),
        (ProcessConfig(masks=MaskConfig(overhang=float("nan"))), r"--masks\.overhang is nan"),
        (ChangeCommand((Path("a"), Path("b")), Path("out"), piece=(1, 0)), "--piece is 0"),
        (ProcessConfig(workers=0), "--workers is 0"),
        (CompareConfig(points=0), r"--points is 0; it must be at least 100\."),
    ],
)
def test_nonsense_is_one_sentence(config, told):
    with pytest.raises(InputError, match=told):
        check_options(config)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "told"),
    [
        (SessionSettings(process="--masks.pieces 0"), r"--process: --masks\.pieces is 0; it must lie"),
        (SessionSettings(traits="--idx PRI"), "--traits: the step 'traits' cannot be called with --idx PRI"),
        (SessionSettings(traits="--index PRY"), "--traits: there is no index 'PRY'"),
        (SessionSettings(traits="--calibration none.csv"), r"--traits: none\.csv: cannot be read \(No such file"),
        (SessionSettings(traits="--library none.csv"), r"--traits: none\.csv"),
        (SessionSettings(traits="--roi-file none.json"), r"--traits: none\.json"),
        (SessionSettings(traits="--roi a 0 0 0 1 --roi a 0 0 1 1"), "--traits: --roi gives two regions the name a"),
        (SessionSettings(traits="--roi a 0 0 0 -1"), "--traits: region a: needs x y z and a radius above 0"),
        (SessionSettings(material="--white-azimuth-deg nan"), "--material: --white-azimuth-deg is nan"),
        (SessionSettings(material="--light none.json"), r"--material: none\.json: cannot be read"),
        # The other steps would not find the results, after hours of training.
        (SessionSettings(train="--vis viewer --timestamp mine"), "--train: --timestamp is given by the step itself"),
        (SessionSettings(train="--output_dir=elsewhere"), "--train: --output-dir is given"),
        (SessionSettings(train="--pipeline.model.efects none"), "--train: .*--pipeline.model.efects none"),
        (SessionSettings(train="--max-num-iterations 0"), "--train: .*iterations"),
        (SessionSettings(process="--output-dir elsewhere"), "--process: --output-dir is given"),
        (SessionSettings(material="--output other.ply"), "--material: --output is given"),
        (SessionSettings(traits="--output-dir elsewhere"), "--traits: --output-dir is given"),
    ],
)
def test_words_for_a_step_are_refused_before_the_first(settings, told):
    with pytest.raises(InputError, match=told):
        check_words(settings)


@pytest.mark.slow
def test_words_that_a_step_knows_pass():
    check_words(SessionSettings(process="--masks.pieces 2", traits="--index PRI --roi a 0 0 0 0.01"))
    check_words(SessionSettings(train="--pipeline.model.effects none --max-num-iterations 300 --vis tensorboard"))
    check_words(SessionSettings(traits="--index 'CRI = 1/R510 - 1/R550' --index own=R510"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "result"),
    [
        ({"process": "--camera {}/data"}, "data/transforms.json"),
        ({"material": "--light {}/point_cloud-material.json"}, "point_cloud-material.json"),
        ({"traits": "--library {}/traits/regions.sli"}, "traits/regions.sli"),
        ({"traits": "--library={}/traits/piece-1/spectra.csv"}, "traits/piece-1/spectra.csv"),
    ],
)
def test_words_do_not_name_what_their_own_step_writes(tmp_path, words, result):
    """The step would be outdated by its own result for ever, or fail after hours of training."""
    path, other = tmp_path / "ball" / result, tmp_path / "pear"
    path.parent.mkdir(parents=True)
    path.write_text("{}")
    if "library" in str(words):
        write_library(path, SpectralLibrary(("skin",), np.array([500.0, 600.0]), np.ones((1, 2))))
    ((step, text),) = words.items()
    settings = SessionSettings(**{step: text.format(tmp_path / "ball")})
    with pytest.raises(InputError, match=rf"--{step}: [^\n]*{path.name}[^\n]* copy it to another folder"):
        check_words(settings, [other, tmp_path / "ball"])
    if step != "material":  # that it is no light is said by another sentence
        check_words(settings, [other])


def test_process_refuses_it_before_it_looks_at_the_session(tmp_path):
    with pytest.raises(InputError, match=r"--masks\.pieces is 0"):
        process_session(tmp_path / "none", tmp_path / "out", ProcessConfig(masks=MaskConfig(pieces=0)))
    assert not (tmp_path / "out").exists()
