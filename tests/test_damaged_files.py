"""A small run of benchmarks/damaged_files.py: no damaged file ends in anything but a sentence or a result."""

import random
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from damaged_files import Kind, damaged, kinds, run_kind

from hsi_sc_nerf.errors import InputError

# Charts take tenths of a second to draw, settings of a run as long to read.
SLOW_READERS = {"config.yml": 2, "calibration.json": 2, "poses.json": 2, "comparison.json": 2}
INPUTS = 12


@pytest.fixture(scope="module")
def valid(tmp_path_factory):
    return kinds(tmp_path_factory.mktemp("damaged") / "valid")


@pytest.mark.slow
def test_damaged_files_are_refused_or_read(valid):
    for kind in valid:
        kind.read()
        outcome = run_kind(kind, SLOW_READERS.get(kind.name, INPUTS), seed=1)
        assert not outcome.errors, (kind.name, outcome.errors)
        kind.read()  # the valid file is back


def test_the_same_seed_damages_alike_and_every_input_is_counted(tmp_path):
    assert damaged(b'{"a": [1, 2]}', random.Random(3)) == damaged(b'{"a": [1, 2]}', random.Random(3))
    path = tmp_path / "a.json"
    path.write_bytes(b'{"a": 1}')
    said = iter(["read", "refused", "other", "other"])

    def read():
        what = next(said)
        if what == "refused":
            raise InputError("a: is damaged; make it again.")
        if what == "other":
            raise KeyError(what)

    outcome = run_kind(Kind("some", path, read), 4, seed=0, keep=tmp_path / "kept")
    assert outcome.row("some") == ["some", "4", "1", "1", "2", "0", "0"]
    assert len(list((tmp_path / "kept").iterdir())) == 2
    assert path.read_bytes() == b'{"a": 1}'
