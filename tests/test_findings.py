import pytest

from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.findings import Finding, refuse_red

FINDINGS = [Finding("white", "red", "No white."), Finding("turn", "amber", "A gap."), Finding("dates", "red", "Old.")]


def test_all_red_findings_are_named_at_once() -> None:
    with pytest.raises(InputError, match=r"No white\. Old\..*--accept white --accept dates"):
        refuse_red(FINDINGS)


def test_accepted_findings_stop_nothing() -> None:
    refuse_red(FINDINGS, accepted=["white", "dates"])
    with pytest.raises(InputError, match=r"^No white"):
        refuse_red(FINDINGS, accepted=["dates"])
