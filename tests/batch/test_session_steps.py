"""What a folder says of its steps is believed only where it can be."""

import pytest

from hsi_sc_nerf.batch.session_steps import STEPS_NAME, Step, is_up_to_date
from hsi_sc_nerf.files import write_json


@pytest.fixture
def step(tmp_path):
    (tmp_path / "traits.json").write_text("{}")
    return Step("traits", ("hsi-sc-nerf", "traits"), (), (tmp_path / "traits.json",))


def done(step, out, **changes):
    return {"fingerprint": step.fingerprint(out), "finished": True, "seconds": 1.5, "peak_memory_mib": 8} | changes


def test_a_finished_step_is_up_to_date_as_long_as_its_results_are_there(step, tmp_path):
    write_json(tmp_path / STEPS_NAME, {"traits": done(step, tmp_path)})
    assert is_up_to_date(step, tmp_path)
    step.outputs[0].unlink()
    assert not is_up_to_date(step, tmp_path)


@pytest.mark.parametrize("entry", [None, [], "done", 3, {}, {"finished": True}])
def test_an_entry_that_is_something_else_is_not_believed(step, tmp_path, entry):
    write_json(tmp_path / STEPS_NAME, {"traits": entry})
    assert not is_up_to_date(step, tmp_path)


@pytest.mark.parametrize(
    "changes", [{"finished": "yes"}, {"seconds": "1"}, {"seconds": float("nan")}, {"peak_memory_mib": [1]}]
)
def test_an_entry_with_damaged_figures_is_not_believed(step, tmp_path, changes):
    write_json(tmp_path / STEPS_NAME, {"traits": done(step, tmp_path, **changes)})
    assert not is_up_to_date(step, tmp_path)
