"""The table reads back as it is, with csv and pyarrow; its columns and their types do not depend on luck."""

import csv
import sys

import pytest
from batch_folder import traits_of, write_object, write_season, write_sessions

from hsi_sc_nerf.batch import columns
from hsi_sc_nerf.batch.columns import STANDING, class_columns, region_columns
from hsi_sc_nerf.batch.page import write_overview
from hsi_sc_nerf.batch.tables import named_apart, read_table, write_tables
from hsi_sc_nerf.cli.batch import CollectCommand
from hsi_sc_nerf.errors import InputError

HOSTILE = "</script><img src=x onerror=alert(1)>\"'&{{ 7 * 7 }},\n=1+1"


def read_csv(path):
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_csv_and_parquet_hold_the_same_rows_and_the_dictionary_all_columns(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    write_season(tmp_path, 7)
    table = read_table(tmp_path)
    assert write_tables(table, tmp_path)
    rows, typed = read_csv(tmp_path / "traits.csv"), parquet.read_table(tmp_path / "traits.parquet")
    assert [row["object"] for row in rows] == [f"pear_{i:03d}" for i in range(7)]
    assert rows[2]["day"] == "7"  # as it stands in the list
    assert rows[5]["volume_ml"] == "400.0"
    assert rows[6]["status"] == "failed"
    assert "12 bytes too short" in rows[6]["sentence"]
    assert {rows[6][name] for name in ("volume_ml", "ndvi", "sam_rad", "watertight", "report_s")} == {""}
    assert list(rows[0]) == typed.column_names
    kinds = {"string": str, "double": float, "bool": lambda text: text == "True"}
    for field in typed.schema:
        read = kinds[str(field.type)]
        expected = [read(row[field.name]) if row[field.name] or read is str else None for row in rows]
        assert [value or "" if read is str else value for value in typed[field.name].to_pylist()] == expected
    assert typed.schema.field("day").type == "double"
    assert typed.schema.field("volume_sd_ml").metadata[b"unit"] == b"mL"

    meanings = read_csv(tmp_path / "traits_dictionary.csv")
    assert [one["name"] for one in meanings] == typed.column_names
    assert all(one["definition"] for one in meanings)
    assert {one["name"]: one["unit"] for one in meanings}["area_cm2"] == "cm²"


def test_types_are_the_same_where_all_failed(tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    types = []
    for folder, failed in ((tmp_path / "good", None), (tmp_path / "bad", "inspect")):
        write_sessions(folder, [("a", "s")], ("object", "session"))
        write_object(folder / "objects" / "a", traits_of(regions=(), calibrated=False), failed, "No.")
        write_tables(read_table(folder), folder)
        schema = parquet.read_schema(folder / "traits.parquet")
        types.append({field.name: field.type for field in schema})
    assert types[0] == types[1]
    assert {column.name for column in STANDING} < set(types[0])


def test_names_of_columns_are_safe_and_never_shared():
    assert all(column.name.isidentifier() and column.name.islower() for column in STANDING)
    found = {
        *class_columns("soft spot"),
        *class_columns("Soft-Spot"),
        *class_columns(HOSTILE),
        *region_columns("3 a"),
    }
    final = named_apart(["object", "Volume_ml", "status"], found)
    names = [column.name for column in final.values()]
    assert len(set(names)) == len(names)
    assert all(name.isidentifier() for name in names)
    assert {"class_soft_spot_fraction", "class_soft_spot_fraction_2", "volume_ml_2", "status_2"} <= set(names)
    # The uncertainty is that of the same column, also under a new name.
    assert final[columns.SIZE["volume_l"][0]].spread == final[columns.SIZE["volume_l"][1]]


def test_names_that_look_like_numbers_stay_names(tmp_path):
    write_sessions(
        tmp_path,
        [
            ("1", "s", "007", "1.5", "1", "1E2", "1.5e-3", "1e-05"),
            ("2", "s", "010", "", "b", "1E3", "-2.E+2", "-5E+05"),
        ],
        ("object", "session", "id", "ph", "plot", "bed", "dose", "offset"),
    )
    table = read_table(tmp_path)
    kinds = {column.name: column.kind for column in table.columns if column.group == "list"}
    assert kinds == {"object": "text", "session": "text", "id": "text", "ph": "number", "plot": "text"} | {
        "bed": "text",
        "dose": "number",
        "offset": "number",
    }
    assert table.values(table.columns[3]) == [1.5, None]
    assert table.values(table.columns[6]) == [0.0015, -200.0]
    assert table.values(table.columns[7]) == [1e-5, -5e5]


def test_hostile_texts_come_back_as_they_are(tmp_path):
    write_sessions(tmp_path, [("a", "s", HOSTILE)], ("object", "session", HOSTILE))
    write_object(tmp_path / "objects" / "a", traits_of(regions=(HOSTILE,)), "report", HOSTILE)
    write_tables(read_table(tmp_path), tmp_path)
    (row,) = read_csv(tmp_path / "traits.csv")
    assert row[HOSTILE] == HOSTILE
    assert row["sentence"] == HOSTILE.replace("\n", " ")


@pytest.mark.parametrize(("content", "told"), [(None, "hsi-sc-nerf batch"), (b"object,session\na\n", "has 1 cells")])
def test_a_list_that_cannot_be_used_is_refused_and_nothing_is_written(tmp_path, content, told):
    if content is not None:
        (tmp_path / "sessions.csv").write_bytes(content)
    before = set(tmp_path.iterdir())
    with pytest.raises(InputError, match=told) as refused:
        CollectCommand(tmp_path).main()
    assert str(refused.value).startswith(str(tmp_path / "sessions.csv"))
    assert set(tmp_path.iterdir()) == before


def test_without_pyarrow_the_rest_is_written_and_said(tmp_path, monkeypatch, capsys):
    write_season(tmp_path, 2)
    (tmp_path / "traits.parquet").write_bytes(b"of an earlier call")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    CollectCommand(tmp_path).main()
    assert {path.name for path in tmp_path.iterdir()} == {
        *("sessions.csv", "objects", "traits.csv", "traits_dictionary.csv", "index.html")
    }
    assert "pip install 'hsi-sc-nerf[batch]'" in capsys.readouterr().out


def test_objects_on_one_table_have_rows_and_names_of_their_own(tmp_path):
    write_sessions(tmp_path, [("berries", "captures/1", "A", "0"), ("pear", "captures/2", "B", "0")])
    pieces = [{"piece": number, "centre_m": [0.02, 0.0, 0.1], **traits_of(300.0 / number)} for number in (1, 2)]
    write_object(tmp_path / "objects" / "berries", {"pieces": pieces})
    write_object(tmp_path / "objects" / "pear")
    table = read_table(tmp_path)
    names = [column.name for column in table.columns]
    keys = [(row[names.index("object")], row[names.index("piece")]) for row in table.rows]
    assert keys == [("berries", 1.0), ("berries", 2.0), ("pear", None)]
    page = write_overview(table, tmp_path).read_text(encoding="utf-8")
    assert f'"piece": {names.index("piece")}' in page
    assert "3 objects" in page
