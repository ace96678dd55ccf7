"""One object's row: what its files say, in the table's units; damage becomes its status and nothing else."""

import json
import shutil

import pytest
from batch_folder import traits_of, write_object

from hsi_sc_nerf.batch.objects import read_objects
from hsi_sc_nerf.files import write_json


def row_of(folder):
    (row,), report = read_objects(folder)
    return {column.name: value for column, value in row.items()}, report


def test_a_row_has_what_the_files_say_in_the_columns_units(tmp_path):
    write_object(tmp_path / "pear")
    row, report = row_of(tmp_path / "pear")
    assert report == tmp_path / "pear" / "report.html"
    expected = {
        "status": "done",
        "step": "",
        "sentence": "",
        "quality": "amber",
        "flags": "focus",
        "watertight": True,
        "area_cm2": 230.0,
        "area_sd_cm2": 1.0,
        "volume_ml": 250.0,
        "volume_sd_ml": 2.0,
        "height_mm": 90.0,
        "largest_diameter_mm": 70.0,
        "smallest_diameter_mm": 68.0,
        "equivalent_diameter_mm": 78.0,
        "seen_area_cm2": 200.0,
        "reflectance": 0.4,
        "reflectance_sd": 0.01,
        "ndvi": 0.7,
        "ndvi_sd": 0.05,
        "class_bruise_area_cm2": 50.0,
        "class_bruise_fraction": 0.25,
        "class_bruise_mixture_fraction": 0.2,
        "class_in_no_class_fraction": 0.75,
        "class_in_no_class_mixture_fraction": 0.8,
        "region_bruise_area_cm2": 200.0,
        "region_bruise_reflectance": 0.4,
        "region_bruise_ndvi": 0.7,
        "sam_rad": 0.03,
        "rmse": 0.02,
        "psnr_db": 34.0,
        "ssim": 0.95,
        "inspect_s": 1.0,
        "report_s": 8.0,
        "total_s": 36.0,
        "peak_memory_mib": 800.0,
    }
    for name, value in expected.items():
        assert row[name] == (pytest.approx(value) if isinstance(value, float) else value), name
    assert row["wi"] is None  # null in the file
    assert (row["brix_percent"], row["brix_sd_percent"]) == (12.5, 0.4)


def test_objects_that_stood_on_one_table_have_a_row_each(tmp_path):
    pieces = [
        {"piece": number, "centre_m": [0.02 * number, -0.01, 0.1], **traits_of(volume)}
        for number, volume in ((1, 250.0), (2, 120.0))
    ]
    write_object(tmp_path / "berries", {"pieces": pieces})
    rows, _ = read_objects(tmp_path / "berries")
    rows = [{column.name: value for column, value in row.items()} for row in rows]
    assert [row["volume_ml"] for row in rows] == [pytest.approx(250.0), pytest.approx(120.0)]
    assert [(row["piece"], row["piece_x_mm"], row["status"]) for row in rows] == [(1, 20, "done"), (2, 40, "done")]
    assert [row["sam_rad"] for row in rows] == [0.03, 0.03]
    # They add up to those of all sessions.
    assert [row.get("total_s") for row in rows] == [36.0, None]


def test_areas_by_classifiers_have_columns_with_their_deviations(tmp_path):
    traits = traits_of()
    areas = {"areas_m2": {"sound": 0.0196, "bruised": 0.0004}, "area_sds_m2": {"bruised": 5e-5}, "outside_m2": 0.0}
    traits["regions"]["whole surface"]["classifiers"] = {"tissue": areas}
    write_object(tmp_path / "pear", traits)
    row, _ = row_of(tmp_path / "pear")
    found = [row[f"tissue_{name}_cm2"] for name in ("bruised_area", "bruised_area_sd", "sound_area", "sound_area_sd")]
    assert found == [pytest.approx(4.0), pytest.approx(0.5), pytest.approx(196.0), None]


def test_a_mesh_with_holes_has_no_volume(tmp_path):
    write_object(tmp_path / "pear", traits_of(watertight=False))
    row, _ = row_of(tmp_path / "pear")
    assert row["status"] == "done"
    assert row["watertight"] is False
    assert row["height_mm"] == pytest.approx(90.0)
    assert not {"volume_ml", "volume_sd_ml", "equivalent_diameter_mm"} & row.keys()


def test_without_a_scale_there_are_no_lengths_areas_and_volumes(tmp_path):
    write_object(tmp_path / "pear")
    write_object(tmp_path / "one", traits_of() | {"settings": {"metric": False}})
    pieces = [{"piece": 1, "centre_m": [0.02, -0.01, 0.1], **traits_of(), "settings": {"metric": False}}]
    write_object(tmp_path / "berry", {"pieces": pieces})
    known, _ = row_of(tmp_path / "pear")
    for name in ("one", "berry"):
        row, _ = row_of(tmp_path / name)
        assert row["status"] == "done"
        sized = {column for column in row if column.endswith(("_ml", "_cm2", "_mm"))}
        assert {"volume_ml", "height_mm", "seen_area_cm2", "class_bruise_area_cm2", "region_bruise_area_cm2"} < sized
        assert {row[column] for column in sized} == {None}
        assert all(row[column] == known[column] for column in known.keys() - sized)


def test_what_failed_says_so_and_results_of_an_earlier_attempt_do_not_count(tmp_path):
    folder = tmp_path / "pear"
    write_object(folder)
    failure = {"step": "train", "status": "failed", "seconds": 3, "sentence": "It ran\nout of memory."}
    write_json(folder / "steps" / "train.json", failure)
    row, report = row_of(folder)
    assert (row["status"], row["step"], row["sentence"]) == ("failed", "train", "It ran out of memory.")
    assert not {"volume_ml", "sam_rad"} & row.keys()
    assert row["quality"] == "amber"  # of steps that went well
    assert report is None


@pytest.mark.parametrize("step", ["inspect", "material"])
def test_where_a_step_fails_that_others_do_without_the_object_is_done(tmp_path, step):
    write_object(tmp_path)
    write_json(tmp_path / "steps" / f"{step}.json", {"status": "failed", "sentence": "No."})
    row, report = row_of(tmp_path)
    assert (row["status"], row["step"], row["sentence"]) == ("done", step, "No.")
    assert {"volume_ml", "sam_rad", "quality"} < row.keys()
    assert report is not None


def test_a_failed_step_leaves_the_results_before_it(tmp_path):
    write_object(tmp_path, failed="export", sentence="No.")
    row, _ = row_of(tmp_path)
    assert row["sam_rad"] == pytest.approx(0.03)
    assert row["total_s"] == pytest.approx(1.0 + 2.0 + 3.0 + 4.0)
    assert row["traits_s"] is None  # it was skipped


def test_an_object_that_is_not_there_yet_is_unfinished(tmp_path):
    row, report = row_of(tmp_path / "nothing")
    assert (row, report) == ({"status": "unfinished", "step": "", "sentence": ""}, None)
    write_object(tmp_path / "pear")
    shutil.rmtree(tmp_path / "pear" / "traits")
    row, _ = row_of(tmp_path / "pear")
    assert row["status"] == "unfinished"
    assert row["sam_rad"] == pytest.approx(0.03)


def test_a_refused_session_has_the_findings_of_inspect(tmp_path):
    write_object(tmp_path / "pear", failed="process", sentence="No white.")
    assert row_of(tmp_path / "pear")[0]["flags"] == "focus"


@pytest.mark.parametrize(
    ("file", "step", "content"),
    [
        ("traits/traits.json", "traits", "{"),
        ("traits/traits.json", "traits", "[]"),
        ("traits/traits.json", "traits", '{"watertight": true}'),
        ("traits/traits.json", "traits", '{"pieces": []}'),
        ("traits/traits.json", "traits", json.dumps(traits_of() | {"seen_area_m2": 0})),
        ("traits/traits.json", "traits", json.dumps(traits_of() | {"regions": {"whole surface": 3}})),
        ("traits/traits.json", "traits", json.dumps(traits_of() | {"size_sd": {"volume_l": 10**400}})),
        ("eval.json", "evaluate", '{"results": {"sam": "low", "rmse": 1, "psnr": 1, "ssim": 1}}'),
        ("eval.json", "evaluate", "\0"),
        ("steps/train.json", "train", '{"seconds": 3}'),
        ("steps/train.json", "train", '{"status": "done", "seconds": [1]}'),
        ("data/report/inspection.json", "inspect", '{"findings": [{"name": "a", "level": "violet"}]}'),
        ("data/report/inspection.json", "inspect", '{"findings": 7}'),
    ],
)
def test_a_damaged_file_is_the_objects_status_and_the_rest_stays(tmp_path, file, step, content):
    folder = tmp_path / "pear"
    write_object(folder)
    (folder / file).write_text(content)
    row, _ = row_of(folder)
    assert (row["status"], row["step"]) == ("damaged", step)
    assert row["sentence"].startswith(f"{file}: ")  # not the folders of this machine
    assert row["peak_memory_mib"] == pytest.approx(800.0)
    assert ("volume_ml" in row) == (step != "traits")
