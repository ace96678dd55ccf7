"""Some of benchmarks/odd_runs.py in a few steps: runs end with finite weights, or with one sentence."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from odd_runs import CASES, simulated, train

pytestmark = pytest.mark.usefixtures("quick_start")

STOPS = {"all masks empty": "the masks of all training frames are empty", "two dead bands": "free of flagged values"}
ENDS = [
    "1 band",
    "one training view",
    "two training views, 180 degrees apart",
    "loss weights 0 and 1",
    "learning rates times 100",
    "mixed precision, bfloat16",
]


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return simulated(tmp_path_factory.mktemp("odd"))


@pytest.mark.slow
@pytest.mark.parametrize("name", [*ENDS, *STOPS])
def test_odd_runs_end_finite_or_with_one_sentence(scene, tmp_path, name):
    (case,) = (case for case in CASES if case.name == name)
    ended = train(case, scene, tmp_path, steps=8)  # raises where a weight is not finite
    assert STOPS.get(name, "") in ended.message
    assert bool(ended.message) == (name in STOPS)
    assert "\n" not in ended.message
    assert name in STOPS or np.isfinite([ended.before, ended.after]).all()


@pytest.mark.slow
def test_an_odd_run_has_the_same_figures_whatever_was_drawn_before(scene, tmp_path):
    found = []
    for number in range(2):
        torch.rand(number + 1)
        found.append(train(CASES[0], scene, tmp_path / str(number), steps=2))
    assert found[0] == found[1]
    assert found[0].after != found[0].before
