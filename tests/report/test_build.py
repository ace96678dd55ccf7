"""The report as a page: complete, without anything to fetch, with every text escaped."""

import re
from html.parser import HTMLParser
from types import SimpleNamespace

import ball_run
import pytest

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import write_json
from hsi_sc_nerf.findings import Finding
from hsi_sc_nerf.packed.dataset import open_packed
from hsi_sc_nerf.report.build import write_report
from hsi_sc_nerf.report.dataset_sections import (
    calibration_section,
    inspection_section,
    masks_section,
    poses_section,
)
from hsi_sc_nerf.report.page import Section, html_page
from hsi_sc_nerf.report.run_sections import comparison_section, traits_section

SECTIONS = ["inspection", "object", "views", "bands", "spectra", "comparison", "traits", "training"]
SECTIONS += ["calibration", "masks", "poses", "settings"]


class Page(HTMLParser):
    """What a browser would make of the page: its elements and what they refer to."""

    def __init__(self, text):
        super().__init__()
        self.elements = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.elements.append((tag, dict(attrs)))

    def all(self, tag):
        return [attrs for name, attrs in self.elements if name == tag]


@pytest.mark.slow
def test_the_page_is_complete_and_names_from_outside_stay_text(report, tmp_path_factory):
    text = report.read_text(encoding="utf-8")
    page = Page(text)
    assert [section["id"] for section in page.all("section")] == SECTIONS
    for tag, attrs in page.elements:
        assert not any(name.startswith("on") and name != "onsubmit" for name in attrs), (tag, attrs)
        for name in ("src", "href", "srcset", "data", "action", "poster"):
            assert attrs.get(name, "#").startswith(("#", "data:")), (tag, attrs)
    assert all(image["alt"] for image in page.all("img"))
    assert all(svg["aria-label"] for svg in page.all("svg"))
    assert not re.search(r"url\(|@import|fetch\(|XMLHttpRequest|WebSocket", text)
    addresses = re.findall(r"[a-z]+://[^\s\"'<]+", re.sub(r"base64,[\w+/=]+", "", text))
    assert set(addresses) <= {"http://www.w3.org/2000/svg"}  # a name, which nothing fetches

    assert str(tmp_path_factory.getbasetemp()) not in text  # folders of this machine
    assert "session: " in text
    assert "<img src=x" not in text
    assert text.count("{{ 7 * 7 }}") > 5
    assert len(page.all("script")) == 2
    assert '"name": "own"' in text
    assert '"tells": "R550 / R670: own formula"' in text
    for shown in ("96.2 %", "F-score at 2.0 mm", "1.230", "229.0 ± 1.0", "250.0 ± 2.0", "cm²", "mL"):
        assert shown in text
    assert "run <code>ns-train" in text  # it has no log
    assert not list(report.parent.glob(".*")) + list(report.parent.glob("*.tmp"))


def test_many_good_findings_are_folded_and_none_other():
    """What is to be looked at does not drown in what is good."""
    found = [Finding(str(i), "green", f"Check {i} is good.") for i in range(5)]
    odd = Finding("odd", "amber", "Look here.")
    page = html_page("a", "b", {}, [Section("few", "Few", [], found[:2]), Section("many", "Many", [], [*found, odd])])
    many = page.split('id="many"')[1]
    assert "Good:</strong> 5 checks" in many
    assert many.index("Look here.") < many.index("<details") < many.index("Check 4 is good.")
    assert "<details" not in page.split('id="few"')[1].split("</section>")[0]


@pytest.mark.slow
def test_sections_on_a_processed_session(flagged_dataset):
    dataset = open_packed(flagged_dataset)
    sections = [make(dataset) for make in (calibration_section, masks_section, poses_section)]
    text = html_page("a", "b", {}, sections)
    assert "is nothing known" not in text
    for shown in ("read noise", "values that are no measurement", "median over frames", "median step", "All frames"):
        assert shown in text
    assert len(Page(text).all("svg")) >= 4


@pytest.mark.parametrize(("read", "photon"), [(True, True), (True, False), (False, False)])
def test_noise_that_was_not_measured_has_no_figure(tmp_path, read, photon):
    dataset = open_packed(ball_run.write_ball_dataset(tmp_path / "ball"))
    noise = {"read_noise_counts": [0.29], "counts_per_electron": 0.0}
    measured = {"read_noise_measured": read, "photon_noise_measured": photon}
    write_json(dataset.root / "calibration.json", {"noise": noise | measured})
    rows = dict(calibration_section(dataset).blocks[0].rows)
    for name, known in (("read noise, median over bands", read), ("counts per photo-electron", photon)):
        assert any(letter.isdigit() for letter in rows[name]) == known


def test_files_that_are_something_else_are_refused_and_nothing_is_written(run, tmp_path):
    (tmp_path / "report").mkdir()
    (tmp_path / "report" / "inspection.json").write_text('{"findings": ["white"]}')
    with pytest.raises(InputError, match=r"inspection\.json: holds no findings"):
        inspection_section(SimpleNamespace(root=tmp_path))
    dataset = open_packed(ball_run.write_ball_dataset(tmp_path / "ball"))
    for name, content, section in (
        ("calibration", {"dead": [[1], [1, 2]]}, calibration_section),
        ("calibration", {"noise": {"read_noise_counts": [10**400]}}, calibration_section),
        ("calibration", {"lamp_drift": [1]}, calibration_section),
        ("poses", {"reprojection_error_px": {"overall": "1"}}, poses_section),
        ("poses", {"frames": 3}, poses_section),
    ):
        write_json(dataset.root / f"{name}.json", content)
        with pytest.raises(InputError, match=rf"{name}\.json: holds no"):
            section(dataset)
    with pytest.raises(InputError, match=r"comparison\.json: holds no comparison"):
        comparison_section({"curves": {"thresholds_m": [1.0]}}, run / "comparison.json")
    with pytest.raises(InputError, match="holds no traits"):
        traits_section({"settings": {}}, run / "traits.json")
    (tmp_path / "broken.json").write_text("{")
    for sources, sentence in (
        ({"traits": tmp_path / "broken.json"}, r"broken\.json: is not a JSON object"),
        ({"comparison": run / "no.json"}, r"no\.json: there is no such file"),
        ({"views": 0}, "at least 1"),
        ({"points": 0}, "at least 1"),
        ({"indices": ("own = R1240",)}, "1240 nm"),
        ({"calibrations": (run / "no.csv",)}, r"no\.csv: cannot be read"),
    ):
        with pytest.raises(InputError, match=sentence):
            write_report(run, tmp_path / "report.html", **sources)
    with pytest.raises(InputError, match=r"config\.yml"):
        write_report(tmp_path, tmp_path / "report.html")
    assert not (tmp_path / "report.html").exists()
