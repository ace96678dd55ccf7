from pathlib import Path

import pytest

from hsi_sc_nerf.cli.clouds import CompareCommand, TraitsCommand
from hsi_sc_nerf.cli.light import MaterialCommand
from hsi_sc_nerf.cli.sessions import InspectCommand, ProcessCommand
from hsi_sc_nerf.cli.trained_runs import RenderCommand, ReportCommand, SampleCommand
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import require_writable

NOTHING = Path("nothing")


@pytest.mark.parametrize(
    "command",
    [
        lambda out: CompareCommand(NOTHING, NOTHING, out),
        lambda out: TraitsCommand(NOTHING, out),
        lambda out: MaterialCommand(NOTHING, NOTHING, output=out / "cloud.ply"),
        lambda out: SampleCommand(NOTHING, NOTHING, output=out / "cloud.ply"),
        lambda out: RenderCommand(NOTHING, out),
        lambda out: ReportCommand(NOTHING, output=out / "report.html"),
        lambda out: InspectCommand(NOTHING, out),
        lambda out: ProcessCommand(NOTHING, out),
    ],
)
def test_commands_refuse_a_place_that_cannot_be_written_to_before_they_read_anything(tmp_path, command):
    (tmp_path / "file").write_text("months of work")
    with pytest.raises(InputError, match=r"^[^\n]*cannot be written to[^\n]*\.$"):
        command(tmp_path / "file" / "out").main()
    assert (tmp_path / "file").read_text() == "months of work"


def test_a_place_that_can_be_made_is_not_made_yet(tmp_path):
    require_writable(tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "link").symlink_to(tmp_path / "gone")
    with pytest.raises(InputError, match="is no folder"):
        require_writable(tmp_path / "link" / "out")
