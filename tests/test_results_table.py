"""Benchmarks write their results as CSV files that say where each row comes from."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
from results_table import RESULTS, SOURCE_COLUMNS, read_results, write_results

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
