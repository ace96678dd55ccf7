import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.poses.marker_detection import detect_markers
from hsi_sc_nerf.poses.marker_sheet import PAPER_MM, RULER_MM, marker_sheets, write_marker_sheets

DPI = 150


def rendered(figure) -> np.ndarray:
    figure.set_dpi(DPI)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., 1])


@pytest.mark.parametrize(
    ("paper", "side_m", "dictionary", "count"), [("a4", 0.02, "DICT_5X5_50", 24), ("letter", 0.08, "DICT_4X4_100", 5)]
)
def test_printed_markers_are_detected_at_their_size(paper, side_m, dictionary, count) -> None:
    sheets = marker_sheets(side_m, dictionary, range(count), paper)
    found = {}
    for image in map(rendered, sheets):
        np.testing.assert_allclose(np.multiply(image.shape, 25.4 / DPI)[::-1], PAPER_MM[paper], atol=0.3)
        found |= detect_markers(image, dictionary)
        ruler = np.flatnonzero(image[-round(23.0 / 25.4 * DPI)] < 128)
        assert len(ruler) / DPI * 25.4 == pytest.approx(RULER_MM, rel=0.005)
    assert sorted(found) == list(range(count))
    sides = np.stack([np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1) for corners in found.values()])
    np.testing.assert_allclose(sides / DPI * 0.0254, side_m, rtol=0.005)
    for corners in found.values():
        assert corners[0, 0] < corners[1, 0]  # upright
        assert corners[0, 1] < corners[3, 1]


def test_the_command_writes_pages_of_the_papers_size(tmp_path, command, capsys) -> None:
    path = tmp_path / "new" / "markers.pdf"
    words = ["markers", "--output", path, "--marker-side-m", "0.08", "--count", "5"]
    assert command(*words) == 0
    content = path.read_bytes()
    assert content.startswith(b"%PDF")
    assert content.count(b"/MediaBox [ 0 0 595.27") == 3
    assert '"marker_side_m": 0.08' in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ids": range(51)}, "markers 0 to 49"),
        ({"marker_side_m": 0.2}, "does not fit on a4 paper"),
        ({"dictionary": "DICT_9X9"}, "DICT_9X9"),
    ],
)
def test_what_cannot_be_printed_is_refused_in_a_sentence(options, message) -> None:
    with pytest.raises(InputError, match=message):
        marker_sheets(**{"marker_side_m": 0.02, "dictionary": "DICT_5X5_50", "ids": range(4)} | options)


def test_a_full_disk_is_one_sentence(tmp_path, limit_of_files) -> None:
    sheets = marker_sheets(0.02, "DICT_5X5_50", range(4))
    told = r"markers\.pdf: cannot be written .*free some space"
    with limit_of_files(100), pytest.raises(InputError, match=told):
        write_marker_sheets(tmp_path / "markers.pdf", sheets)
    assert not list(tmp_path.iterdir())


def test_another_file_format_is_refused(tmp_path, command, capsys) -> None:
    assert command("markers", "--output", tmp_path / "markers.png") == 2
    assert "ends with .pdf" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
