"""Commands look for a run's dataset before they load what takes seconds."""

from pathlib import Path

import pytest
import yaml

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.packed.of_run import find_dataset, require_dataset_of_run


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "outputs" / "pear" / "config.yml"
    path.parent.mkdir(parents=True)
    data = Path("pear-data")
    path.write_text(yaml.dump({"data": data, "pipeline": {"datamanager": {"data": data}}}))
    return path


def test_a_dataset_is_looked_for_from_the_runs_folder_upwards(config, tmp_path):
    with pytest.raises(InputError, match=r"config\.yml: .* dataset pear-data, which is not"):
        require_dataset_of_run(config)
    (tmp_path / "pear-data").mkdir()
    (tmp_path / "pear-data" / "transforms.json").write_text("{}")
    require_dataset_of_run(config)


@pytest.mark.parametrize("data", ["out/data", "data"])
def test_a_dataset_with_a_relative_path_is_that_of_the_run_and_not_of_the_working_folder(tmp_path, monkeypatch, data):
    path = tmp_path / "apple" / "out" / "training" / "hsi-sc-nerf" / "run" / "config.yml"
    path.parent.mkdir(parents=True)
    path.write_text(yaml.dump({"output_dir": Path("out"), "pipeline": {"datamanager": {"data": Path(data)}}}))
    for name in ("pear", "apple"):
        folder = tmp_path / name / data
        folder.mkdir(parents=True)
        (folder / "transforms.json").write_text("{}")
    monkeypatch.chdir(tmp_path / "pear")
    assert find_dataset(Path(data), path).resolve() == folder


@pytest.mark.parametrize("data", ["data", "../data"])
def test_a_dataset_with_an_absolute_path_is_found_where_it_was_moved_with_the_run(tmp_path, data):
    """Of a name alone it is not: another dataset can have it."""
    before, now = tmp_path / "old" / "pear", tmp_path / "new" / "pear_01"
    named = (before / data).resolve()
    path = now / "training" / "hsi-sc-nerf" / "run" / "config.yml"
    path.parent.mkdir(parents=True)
    settings = {"output_dir": before, "pipeline": {"datamanager": {"data": named}}}
    path.write_text(yaml.dump(settings))
    for place in (tmp_path / "data", now / data):
        with pytest.raises(InputError, match="which is not there"):
            require_dataset_of_run(path)
        place.mkdir()
        (place / "transforms.json").write_text("{}")
    require_dataset_of_run(path)
    assert find_dataset(named, path).resolve() == (now / data).resolve()


@pytest.mark.parametrize("text", ["", "[]", "pipeline: 3", "pipeline: {datamanager: {data: null}}", "a: [", "\x00"])
def test_what_tells_of_no_dataset_is_left_to_others(config, text):
    config.write_text(text)
    require_dataset_of_run(config)
    require_dataset_of_run(config.with_name("none.yml"))
