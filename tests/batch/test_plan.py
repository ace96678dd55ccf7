"""What a batch keeps of its plan, and one sentence for what it cannot be."""

import shlex
import shutil

import pytest

from hsi_sc_nerf.batch.plan import LIST_NAME, SETTINGS_NAME, read_plan, unlisted, write_plan
from hsi_sc_nerf.batch.session_steps import STEPS_NAME, SessionSettings
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import write_json


@pytest.mark.parametrize(
    "known", [{"process": 3}, {"folder": 3}, {"train": None}, {"num_points": "9"}, {"max_num_iterations": [1]}]
)
def test_settings_of_other_types_are_refused(tmp_path, known):
    write_json(tmp_path / SETTINGS_NAME, known)
    with pytest.raises(InputError, match="are no settings of a batch"):
        read_plan(tmp_path)


def plan(out, **sessions):
    """The sessions by their objects' names."""
    rows = [{"object": name, "session": str(session)} for name, session in sessions.items()]
    write_plan(out, rows, SessionSettings())
    return unlisted(out, rows)


@pytest.fixture
def sessions(tmp_path):
    """Two sessions, of one of which there is a batch."""
    monday, friday = tmp_path / "monday", tmp_path / "friday"
    monday.mkdir()
    friday.mkdir()
    out = tmp_path / "out"
    assert plan(out, pear=monday) == []
    return out, monday, friday


def test_results_of_another_session_are_not_replaced(sessions):
    out, monday, friday = sessions
    (out / "objects" / "pear").mkdir(parents=True)
    before = (out / LIST_NAME).read_text()
    with pytest.raises(InputError, match=r"pear: is of another session, .*monday; .* --output-dir"):
        plan(out, apple=friday, pear=friday)
    assert (out / LIST_NAME).read_text() == before
    shutil.move(monday, friday / "moved")
    plan(out, pear=friday / "moved")
    assert "moved" in (out / LIST_NAME).read_text()
    (out / "objects" / "pear").rmdir()
    plan(out, pear=friday)


def test_results_are_guarded_also_after_another_list(sessions):
    out, monday, friday = sessions
    command = shlex.join(["hsi-sc-nerf", "inspect", str(monday)])
    write_json(out / "objects" / "pear" / STEPS_NAME, {"inspect": {"command": command}})
    plan(out, apple=friday)
    with pytest.raises(InputError, match="pear: is of another session"):
        plan(out, pear=friday)


def test_objects_that_the_list_does_not_name_are_told(sessions):
    out, _, friday = sessions
    (out / "objects" / "pear").mkdir(parents=True)
    assert plan(out, apple=friday) == ["pear"]
    assert list(read_plan(out)) == ["apple"]


def test_a_list_of_the_users_is_not_replaced(tmp_path):
    (tmp_path / "session").mkdir()
    own = tmp_path / LIST_NAME
    own.write_text("object;session\n")
    with pytest.raises(InputError, match=r"sessions\.csv: is not of a batch"):
        plan(tmp_path, pear=tmp_path / "session")
    assert own.read_text() == "object;session\n"
    assert not (tmp_path / SETTINGS_NAME).exists()


@pytest.mark.parametrize("inside", [".", "results/out"])
def test_results_do_not_lie_in_a_session(sessions, inside):
    _, monday, _ = sessions
    with pytest.raises(InputError, match=r"lies in the session .*monday; choose another"):
        plan(monday / inside, pear=monday)
    assert not any(monday.iterdir())


def test_a_damaged_list_of_a_batch_is_written_anew(sessions):
    out, monday, _ = sessions
    (out / LIST_NAME).write_text("nothing")
    plan(out, pear=monday)
    assert list(read_plan(out)) == ["pear"]
