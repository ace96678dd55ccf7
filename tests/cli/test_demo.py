"""What the demo does to folders that are not its own."""

import pytest

from hsi_sc_nerf.cli.workflows import DemoCommand
from hsi_sc_nerf.errors import InputError


def test_somebody_elses_runs_are_left_alone(tmp_path):
    """A folder of nerfstudio's looks like a demo's, but for the mark."""
    for name in ("logs", "runs", "renders"):
        (tmp_path / name).mkdir()
    kept = tmp_path / "runs" / "config.yml"
    kept.write_text("months of work")
    with pytest.raises(InputError, match="other than a demo"):
        DemoCommand(output_dir=tmp_path).main()
    assert kept.read_text() == "months of work"


def test_a_file_is_no_folder(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(InputError, match="out: cannot be made a folder"):
        DemoCommand(output_dir=tmp_path / "out").main()
