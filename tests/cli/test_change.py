"""`hsi-sc-nerf change` on three days of a simulated apple."""

import csv
import json
from dataclasses import replace

import av
import ball_run
import capture_factory as factory
import numpy as np
import pytest
from another_day import CloudErrors, SetDown, bruise_cm2, cloud_of, fruit_of

from hsi_sc_nerf.analysis import change_pictures
from hsi_sc_nerf.analysis.closed_mesh import MeshConfig
from hsi_sc_nerf.analysis.pictures import SideViews
from hsi_sc_nerf.cli import change
from hsi_sc_nerf.cli.change import ChangeCommand
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.export.cloud import INCIDENCE, read_spectral_ply, write_spectral_ply
from hsi_sc_nerf.models import trained_run

NM = np.linspace(400.0, 1000.0, 13)
DAYS = {
    "monday": SetDown(bruise_diameter_m=0.012),
    "monday_again": SetDown(bruise_diameter_m=0.012, turn_deg=120.0),
    "friday": SetDown(bruise_diameter_m=0.024, dried=0.3, turn_deg=40.0, keeps_stem=False),
}
REPEAT = SetDown(bruise_diameter_m=0.012, turn_deg=250.0, tip_deg=2.0)
"""Another capture of Monday."""
LIBRARY = ("apple_skin", "apple_blush", "lenticel", "bruise")


@pytest.fixture(scope="module")
def clouds(tmp_path_factory):
    folder = tmp_path_factory.mktemp("days")
    for seed, (name, day) in enumerate({**DAYS, "repeat": REPEAT}.items()):
        cloud = cloud_of(fruit_of(day, NM), day, CloudErrors(), 25_000, seed)
        (folder / name).mkdir()
        write_spectral_ply(folder / name / "point_cloud.ply", cloud)
    fruit = fruit_of(DAYS["monday"], NM)
    with (folder / "library.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerows([("nm", *LIBRARY), *zip(NM, *fruit.endmembers[:4], strict=True)])
    return folder


@pytest.fixture(scope="module")
def written(clouds, tmp_path_factory):
    out = tmp_path_factory.mktemp("change")
    days = tuple(clouds / name for name in DAYS)
    mesh = MeshConfig(octree_depth=6)
    library = clouds / "library.csv"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SideViews.__init__, "__defaults__", (80,))  # pixels of the pictures' height
        ChangeCommand(days, out, mesh, band_nm=(670.0,), library=library, repeat=clouds / "repeat").main()
    return out


def rows_of(written, **wanted):
    with (written / "change.csv").open(newline="") as file:
        return [row for row in csv.DictReader(file) if all(row[key] == value for key, value in wanted.items())]


def true_growth_cm2():
    monday_cm2, friday_cm2 = (bruise_cm2(fruit_of(DAYS[day], NM)) for day in ("monday", "friday"))
    return friday_cm2 - monday_cm2


@pytest.mark.slow
def test_a_second_capture_of_the_same_day_shows_no_change(written):
    rows = rows_of(written, after="2 monday_again", kind="change")
    assert {row["name"] for row in rows} >= {"spectrum", "brightness", "R670", "NDVI", "WI", "surface"}
    assert all(row["region"] == "whole surface" and float(row["p"]) > 0.01 for row in rows)


@pytest.mark.slow
def test_the_bruise_grew_by_its_area_and_the_fruit_dried(written):
    (bruise, *_) = rows_of(written, after="3 friday", kind="class", name="bruise")
    assert float(bruise["area_change_cm2"]) == pytest.approx(true_growth_cm2(), rel=0.2)
    (darker, *_) = (row for row in rows_of(written, after="3 friday", name="brightness") if row["region"] == "1")
    assert float(darker["area_after_cm2"]) == pytest.approx(true_growth_cm2(), rel=0.1)
    assert float(darker["change"]) < -0.3
    (water,) = rows_of(written, after="3 friday", name="WI", region="whole surface")
    assert float(water["p"]) < 1e-4
    assert -0.1 < float(water["change"]) < -0.04
    grown = rows_of(written, before="2 monday_again", kind="grown", name="brightness")
    assert grown[0]["area_before_cm2"] == "0"


@pytest.mark.slow
def test_files_hold_the_attitudes_the_maps_and_the_film(written):
    content = json.loads((written / "change.json").read_text())
    again, friday = (day["attitude"] for day in content["days"])
    assert again["turn_deg"] == pytest.approx(120.0, abs=0.5)
    assert friday["turn_deg"] == pytest.approx(40.0, abs=0.5)
    assert content["repeat"]["name"] == "repeat repeat"
    settings = content["settings"]
    assert settings["library"].endswith("library.csv")
    assert [index.split(" = ")[0] for index in settings["index"]] == ["NDVI", "NDVI705", "WI"]
    assert (settings["angle_rad"], settings["piece"]) == (0.1, [])
    assert content["repeat"]["attitude"]["turn_deg"] == pytest.approx(-110.0, abs=0.5)
    mesh = read_spectral_ply(written / "change.ply")
    assert {"ndvi_change_1", "spectrum_p_2", "surface_region_2", "r670_change_2"} <= set(mesh.extra)
    changed = mesh.extra["brightness_region_2"] > 0
    assert np.median(mesh.extra["brightness_change_2"][changed]) < -0.3
    assert (mesh.extra["brightness_region_1"] == 0).all()
    assert (mesh.extra["class_after_1"] == mesh.extra["class_before"]).all()
    other = mesh.extra["class_after_2"] != mesh.extra["class_before"]
    assert content["classes"] == [*LIBRARY]
    assert np.mean(mesh.extra["class_after_2"][other] == LIBRARY.index("bruise")) > 0.9
    assert changed[other].mean() > 0.8
    with av.open(str(written / "change.mp4")) as film:
        assert sum(1 for _ in film.decode(video=0)) == 75
    page = (written / "change.md").read_text()
    assert all((written / name).is_file() for name in ("wi_1.png", "spectrum_2.png", "classes_2.png"))
    assert "![Spectrum, 3 friday](spectrum_2.png)" in page
    assert "![Classes, 3 friday](classes_2.png)" in page
    assert "and repeat repeat is no change" in page


@pytest.mark.slow
def test_a_trained_run_without_a_cloud_is_sampled_and_left_as_it_is(tmp_path, monkeypatch):
    config = ball_run.write_untrained_run(ball_run.write_ball_dataset(tmp_path / "data"), tmp_path / "runs")
    opened = trained_run.open_trained_run

    def open_ball(path):
        run = opened(path)
        ball_run.fill_with_ball(run)
        return run

    monkeypatch.setattr(trained_run, "open_trained_run", open_ball)
    monkeypatch.setattr(change, "POINTS", 3000)
    for drawn in ("draw_change", "write_film"):  # `written` has them
        monkeypatch.setattr(change_pictures, drawn, lambda *_: None)
    before = sorted(config.parent.rglob("*"))
    cloud = change._read(change._file_of(config.parent))
    radius_m = np.linalg.norm(cloud.points - factory.SPHERE_CENTRE_M, axis=1)
    assert np.median(radius_m) == pytest.approx(factory.SPHERE_RADIUS_M, rel=0.03)
    assert np.abs(cloud.spectra - factory.PLANT).max() < 0.02
    (tmp_path / "later").mkdir()
    later = replace(cloud, points=cloud.points + np.float32(1e-5))
    write_spectral_ply(tmp_path / "later" / "point_cloud.ply", later)
    ChangeCommand((config.parent, tmp_path / "later"), tmp_path / "out", MeshConfig(octree_depth=5)).main()
    rows = rows_of(tmp_path / "out", before="1 ball/hsi-sc-nerf/run", after="2 later")
    assert rows
    assert {row["region"] for row in rows} == {"whole surface"}
    assert sorted(config.parent.rglob("*")) == before
    (config.parent / "point_cloud.ply").write_text("")
    assert change._file_of(config) == change._file_of(config.parent) == config.parent / "point_cloud.ply"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["brightness", "Surface", "spectrum", "Classes", "r670", "mine"])
def test_an_index_with_the_name_of_another_quantity_is_one_sentence(clouds, tmp_path, name):
    """One of the two would silently take the place of the other."""
    days, indices = (clouds / "monday", clouds / "friday"), (f"{name} = R800 / R600", "Mine = R900 / R600")
    with pytest.raises(InputError, match="name of another quantity") as refused:
        ChangeCommand(days, tmp_path / "out", band_nm=(670.0,), index=indices).main()
    assert f"{name} = " in str(refused.value) or name == "mine"
    assert not (tmp_path / "out").exists()


def test_bad_input_is_one_sentence_and_nothing_is_written(clouds, tmp_path):
    first, out = clouds / "monday", tmp_path / "out"
    with pytest.raises(InputError, match="two clouds or more"):
        ChangeCommand((first,), out).main()
    with pytest.raises(InputError, match=r"holds no point_cloud\.ply and no config"):
        ChangeCommand((first, clouds), out).main()
    cloud = read_spectral_ply(first / "point_cloud.ply").select(slice(0, 500))
    other = tmp_path / "other.ply"
    write_spectral_ply(other, type(cloud)(*list(vars(cloud).values())[:3], cloud.spectra[:, :4], NM[:4]))
    with pytest.raises(InputError, match="2 other: has other bands than 1 monday"):
        ChangeCommand((first, other), out).main()
    with pytest.raises(InputError, match=r"repeat point_cloud is .* 1 monday"):
        ChangeCommand((first, clouds / "friday"), out, repeat=first / "point_cloud.ply").main()
    copied = tmp_path / "tuesday.ply"
    copied.write_bytes((first / "point_cloud.ply").read_bytes())
    with pytest.raises(InputError, match=r"2 tuesday is .* 1 monday"):
        ChangeCommand((first, copied), out).main()
    with pytest.raises(InputError, match=r"--piece has 3 numbers.* or 2"):
        ChangeCommand((first, clouds / "friday"), out, piece=(1, 2, 1)).main()
    with pytest.raises(InputError, match=r"2 friday: --piece is 2.* holds 1"):
        ChangeCommand((first, clouds / "friday"), out, piece=(1, 2)).main()
    with pytest.raises(InputError, match="session-std"):
        ChangeCommand((first, other), out, session_std=-1.0).main()
    assert not out.exists()


def test_clouds_that_do_not_tell_their_angles_are_named(clouds, tmp_path, capfd):
    """CloudCompare leaves the column out, and then oblique spectra count."""
    cloud = read_spectral_ply(clouds / "monday" / "point_cloud.ply")
    write_spectral_ply(tmp_path / "monday.ply", replace(cloud, extra={INCIDENCE: np.zeros(len(cloud))}))
    write_spectral_ply(tmp_path / "copy.ply", replace(cloud, points=cloud.points + np.float32(0.01)))
    days = (tmp_path / "monday.ply", tmp_path / "copy.ply")
    with pytest.raises(InputError, match="--piece is 2"):
        ChangeCommand(days, tmp_path / "out", piece=(2,)).main()
    (told,) = (line for line in capfd.readouterr().err.splitlines() if INCIDENCE in line)
    assert told.startswith("2 copy has no ")


def test_days_whose_files_have_one_name_are_named_by_their_folders(tmp_path):
    files = [tmp_path / day / "export" / "point_cloud.ply" for day in ("mo", "fr")]
    assert change._day_names(files) == ["mo", "fr"]
    assert change._day_names([files[0], tmp_path / "fr.ply"]) == ["point_cloud", "fr"]
    assert change._day_names([files[0], files[0]]) == ["point_cloud", "point_cloud"]
