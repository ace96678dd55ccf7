"""The benchmarks: tables that say where each row comes from, damaged files, the path-traced session, stand-ins."""

import csv
import os
import random
import subprocess
import sys
from functools import partial
from pathlib import Path

import accuracy_and_time
import numpy as np
import pytest
from accuracy_and_time import AccuracyAndTime
from beyond_the_paper import reflectance_of
from capture_factory import INFO, frame_reflectance, true_poses, write_session
from damaged_files import damaged, run_kind
from file_kinds import Kind, kinds
from results_table import RESULTS, SOURCE_COLUMNS, read_results, write_results

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.packed.dataset import open_packed
from hsi_sc_nerf.processing.process import process_session

ROOT = Path(__file__).parents[1]
with (ROOT / "benchmarks" / "mutations.csv").open(encoding="utf-8", newline="") as table:
    MUTATIONS = list(csv.DictReader(table))
COLUMNS = ["object", "method", "error, mm"]
OLD = {"commit": "aaaaaaa", "machine": "old machine", "seed": "1"}


def test_cells_are_read_as_they_were_written(tmp_path):
    rows = [["pear", "ours, plain", '0.1 "±" 0.2'], ["maize", "", "-"]]
    path = write_results("table", COLUMNS, rows, folder=tmp_path / "new", **OLD)
    titles, *found = read_results(path)
    assert titles == [*COLUMNS, *SOURCE_COLUMNS]
    assert found == [[*row, "aaaaaaa", "1", "old machine"] for row in rows]


def test_rows_that_are_not_measured_again_keep_their_sources(tmp_path):
    write_results("table", COLUMNS, [["pear", "a", "1"], ["pear", "b", "2"]], keys=2, folder=tmp_path, **OLD)
    path = write_results("table", COLUMNS, [["maize", "a", "3"], ["pear", "a", "4"]], keys=2, folder=tmp_path)
    _, *rows = read_results(path)
    assert [row[:3] for row in rows] == [["pear", "a", "4"], ["pear", "b", "2"], ["maize", "a", "3"]]
    assert rows[1][3:] == ["aaaaaaa", "1", "old machine"]
    for row in (rows[0], rows[2]):
        assert row[3] not in ("", "aaaaaaa")
        assert row[4] == "scene"
        assert "cores" in row[5]


def test_a_whole_table_replaces_the_file(tmp_path):
    write_results("table", COLUMNS, [["pear", "a", "1"], ["pear", "b", "2"]], folder=tmp_path, **OLD)
    path = write_results("table", COLUMNS, [["pear", "a", "4"], ["pear", "a", "5"]], folder=tmp_path)
    assert [row[2] for row in read_results(path)[1:]] == ["4", "5"]


def test_rows_of_another_table_are_not_mixed(tmp_path):
    path = write_results("table", COLUMNS, [["pear", "a", "1"]], folder=tmp_path, **OLD)
    before = path.read_bytes()
    with pytest.raises(ValueError, match="other columns"):
        write_results("table", COLUMNS[:2], [["pear", "b"]], keys=1, folder=tmp_path)
    assert path.read_bytes() == before


@pytest.mark.parametrize("path", sorted(RESULTS.glob("*.csv")), ids=lambda path: path.stem)
def test_committed_results_name_their_sources(path):
    titles, *rows = read_results(path)
    assert tuple(titles[-3:]) == SOURCE_COLUMNS
    assert rows
    assert all(len(row) == len(titles) and all(row[-3:]) for row in rows)


# Charts take tenths of a second to draw, settings of a run as long to read; NetCDF is read by processes of their own.
SLOW_READERS = {
    "point cloud (NetCDF)": 4,
    "point cloud (NetCDF), old": 8,
    "config.yml": 2,
    "calibration.json": 2,
    "poses.json": 2,
    "comparison.json": 2,
}
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

    run_kind(Kind("some", path, read), 3, 0, tmp_path / "kept", tmp_path / "progress.json")  # and is interrupted
    outcome = run_kind(Kind("some", path, read), 4, 0, tmp_path / "kept", tmp_path / "progress.json")
    assert outcome.row("some") == ["some", "4", "1", "1", "2", "0", "0"]
    assert len(list((tmp_path / "kept").iterdir())) == 2
    assert path.read_bytes() == b'{"a": 1}'


@pytest.mark.slow
def test_nine_wavelengths_give_all_spectra_and_the_drift_ends_where_it_is_said():
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed")
    import independent_session
    import path_traced_scene

    nodes_nm, bands_nm = independent_session.NODES_NM.ravel(), independent_session.BANDS
    mixing = independent_session.mixing_matrix()
    for name, spectrum in path_traced_scene.MATERIALS.items():
        np.testing.assert_allclose(spectrum(nodes_nm) @ mixing, spectrum(bands_nm), atol=0.016, err_msg=name)
    drift = independent_session.lamp_drift(30)
    assert (drift[-1, 0], drift[-1, -1]) == pytest.approx((0.90, 0.95), abs=1e-3)
    assert (np.diff(drift, axis=0) < 0).all()
    for _, corners in path_traced_scene.marker_poses().values():
        sides_m = np.linalg.norm(corners - np.roll(corners, -1, axis=0), axis=1)
        np.testing.assert_allclose(sides_m, path_traced_scene.MARKER_SIDE_M)
        # Clockwise for who looks from above.
        assert np.cross(corners[1] - corners[0], corners[2] - corners[1])[2] < 0


@pytest.mark.slow
def test_a_frame_without_a_pose_has_noise_free_reflectance(tmp_path):
    """At 64 px a frame of the noise-free session shows no marker that can be read, and the noisy one does."""
    session = write_session(tmp_path / "session", info=INFO)
    data = process_session(
        session, tmp_path / "data", progress=False, estimate_poses=partial(true_poses, unused=("ball_2",))
    )
    assert "ball_2" not in {frame.capture for frame in open_packed(data).frames}
    reflectance, valid = reflectance_of(data, "ball_2")
    np.testing.assert_allclose(reflectance[valid], frame_reflectance(90.0)[valid], atol=0.01)
    assert valid.all()


def test_rows_are_trained_for_the_steps_that_their_time_buys(tmp_path, monkeypatch):
    """Seconds of a step that an earlier part measured are kept; those of a slower hour are scaled to them."""
    seconds, datasets = {"default": 0.1, "25 bands": 0.08, "64 x 64 pixels": 0.09}, []

    def measured(runs, common):
        datasets.append({name: data for name, (data, _) in runs.items()})
        return {name: len(datasets) * seconds[name] for name in runs}

    monkeypatch.setattr(accuracy_and_time, "step_seconds", measured)
    monkeypatch.setattr(AccuracyAndTime, "_sessions", lambda self: (f"{self.size} {self.bands} {self.binning}", None))
    for names in (("25 bands",), ("default", "25 bands", "64 x 64 pixels")):
        command = AccuracyAndTime(output_dir=tmp_path, names=names, default_step_seconds=0.05)
        rows = command._rows("pictures", command._step_seconds("pictures"))
    assert {name: row.iterations for name, row, _ in rows} == {
        "default": 800,
        "25 bands": 1000,
        "64 x 64 pixels": 889,
    }
    assert datasets == [
        {"default": "128 204 1", "25 bands": "128 25 8"},
        {"default": "128 204 1", "64 x 64 pixels": "64 204 1"},
    ]


def test_a_part_is_named_after_what_is_not_usual_in_it():
    titles = {
        AccuracyAndTime(output_dir=Path(), **change)._title("presets")
        for change in ({}, {"scene": "maize"}, {"size": 256, "bands": 25})
    }
    assert titles == {"presets", "presets, maize", "presets, 256 px, 25 bands"}


STAND_INS = Path(__file__).parents[1] / "benchmarks" / "gpu_stand_ins"
SCRIPT = """
import sys
import numpy as np
import open3d
from hsi_sc_nerf.simulate.frames import Simulation
from hsi_sc_nerf.simulate.scene import load_scene, override

scene = override(load_scene("pear"), frames=4, size_px=40, bands=5, effects=("chamber_shading",))
frame = Simulation(scene).frame(1)
np.savez(sys.argv[1], where=open3d.__file__, counts=frame.counts, coverage=frame.coverage)
"""


@pytest.mark.slow
def test_frames_by_the_stand_in_equal_open3d(tmp_path, monkeypatch):
    pytest.importorskip("embreex")
    pytest.importorskip("open3d")
    path = str(tmp_path / "stand_in.npz")
    search = os.pathsep.join([str(STAND_INS), os.environ.get("PYTHONPATH", "")])
    subprocess.run([sys.executable, "-c", SCRIPT, path], check=True, env={**os.environ, "PYTHONPATH": search})
    monkeypatch.setattr(sys, "argv", ["", str(tmp_path / "open3d.npz")])
    exec(SCRIPT, {})
    with np.load(path) as found, np.load(tmp_path / "open3d.npz") as expected:
        assert str(STAND_INS) in str(found["where"])
        np.testing.assert_allclose(found["coverage"], expected["coverage"], atol=1e-3)
        difference = np.abs(found["counts"].astype(int) - expected["counts"].astype(int))
    # A ray along the edge of two triangles may go to either.
    assert (difference > 1).mean() < 1e-3


@pytest.mark.parametrize("row", MUTATIONS, ids=lambda row: f"{row['function']}, {row['broken by']}")
def test_what_the_mutations_break_is_there_once_and_so_are_its_tests(row):
    text = (ROOT / "hsi_sc_nerf" / f"{row['module']}.py").read_text(encoding="utf-8")
    assert text.count(row["text"].replace("\\n", "\n")) == 1
    assert all((ROOT / "tests" / test).is_file() for test in row["tests"].split())
