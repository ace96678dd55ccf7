import sys
import types

import pytest
import yaml
from nerfstudio.engine.trainer import TrainerConfig

from hsi_sc_nerf.config import hsi_sc_nerf
from hsi_sc_nerf.export import ns_export as adapter


def fake_exporter(calls):
    class ExportPointCloud:
        def __init__(self, load_config):
            self.load_config = load_config

        def main(self):
            calls.append("stock")

    module = types.ModuleType(adapter._EXPORTER)
    module.ExportPointCloud = ExportPointCloud
    module.entrypoint = lambda: None
    return module


def config_file(folder, config):
    path = folder / "config.yml"
    path.write_text(yaml.dump(config))
    return path


@pytest.fixture
def calls(monkeypatch):
    made = []
    monkeypatch.setattr(adapter, "_export_spectral_cloud", lambda options: made.append("spectral"))
    return made


def test_other_methods_keep_nerfstudios_export(tmp_path, calls):
    module = fake_exporter(calls)
    adapter._wrap_main(module)
    module.ExportPointCloud(config_file(tmp_path, TrainerConfig(method_name="nerfacto"))).main()
    assert calls == ["stock"]
    module.ExportPointCloud(config_file(tmp_path, hsi_sc_nerf.config)).main()
    assert calls == ["stock", "spectral"]


def test_a_module_under_import_is_wrapped_once_complete(tmp_path, monkeypatch, calls):
    complete = fake_exporter(calls)
    module = types.ModuleType(adapter._EXPORTER)
    monkeypatch.setitem(sys.modules, adapter._EXPORTER, module)
    adapter.extend_export_point_cloud()
    assert not hasattr(module, "entrypoint")
    vars(module).update(ExportPointCloud=complete.ExportPointCloud, entrypoint=complete.entrypoint)
    assert module.entrypoint is complete.entrypoint
    assert type(module) is types.ModuleType
    module.ExportPointCloud(config_file(tmp_path, hsi_sc_nerf.config)).main()
    assert calls == ["spectral"]


def test_bad_input_ends_in_one_sentence(tmp_path):
    with pytest.raises(SystemExit, match=r"hsi-sc-nerf: .*there is no such file"):
        adapter._export_spectral_cloud(types.SimpleNamespace(load_config=tmp_path / "x.yml", output_dir=tmp_path))
