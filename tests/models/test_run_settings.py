from copy import deepcopy
from pathlib import Path

import pytest
import yaml

from hsi_sc_nerf.config import hsi_sc_nerf, hsi_sc_nerf_paper
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.models.run_settings import read_config


@pytest.fixture
def config_path(tmp_path) -> Path:
    path = tmp_path / "config.yml"
    path.write_text(yaml.dump(hsi_sc_nerf.config))
    return path


@pytest.mark.parametrize("method", [hsi_sc_nerf, hsi_sc_nerf_paper])
def test_settings_come_back_as_nerfstudio_reads_them(config_path, method):
    config = deepcopy(method.config)
    config.data = config.pipeline.datamanager.data = Path("/data/apple")
    config_path.write_text(yaml.dump(config))
    assert read_config(config_path) == config
    assert yaml.load(config_path.read_text(), Loader=yaml.Loader) == config


@pytest.mark.parametrize(
    "value",
    [
        "!!python/object/apply:os.system ['touch MARK']",
        "!!python/object/apply:subprocess.Popen [['touch', 'MARK']]",
        "!!python/object/new:subprocess.Popen [['touch', 'MARK']]",
        "!!python/object/apply:nerfstudio.utils.scripts.run_command ['touch MARK']",
        "!!python/object/apply:nerfstudio.utils.writer.Path ['MARK']",
        "!!python/object/apply:pathlib.os.system ['touch MARK']",
        '!!python/object/apply:builtins.eval [\'open("MARK", "w")\']',
        "!!python/object/apply:hsi_sc_nerf.files.make_folder [MARK]",
        "!!python/object/new:nerfstudio.viewer.viewer.Viewer []",
        "!!python/object/new:torch.optim.adam.Adam []",
        "!!python/name:os.system ''",
        "!!python/name:torch.hub.load ''",
        "!!python/name:nerfstudio.utils.scripts.run_command ''",
        "!!python/name:nerfstudio.utils.scripts.subprocess ''",
        "!!python/module:antigravity ''",
    ],
)
def test_what_settings_are_not_made_of_is_refused_before_anything_is_executed(config_path, value):
    mark = config_path.with_name("mark")
    text = config_path.read_text().replace("project_name: nerfstudio-project", f"project_name: {value}")
    assert text != config_path.read_text()
    config_path.write_text(text.replace("MARK", str(mark)))
    with pytest.raises(InputError, match=r"config\.yml: it (names|makes) .*runs that you trust"):
        read_config(config_path)
    assert not mark.exists()


@pytest.mark.parametrize("text", ["", "[", "a: 1", "*b", "!!python/object:hsi_sc_nerf.gone.Away {}", "\0", "&a [*a]"])
def test_what_are_no_settings_is_refused(config_path, text):
    config_path.write_text(text)
    with pytest.raises(InputError, match=r"config\.yml"):
        read_config(config_path)
