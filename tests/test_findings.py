"""What users are told: messages of errors, and findings."""

import pytest

from hsi_sc_nerf.errors import LONGEST_MESSAGE, InputError, shown
from hsi_sc_nerf.findings import Finding, refuse_red


def test_a_message_stays_one_line_of_bounded_length():
    told = str(InputError(f"/data/a\n\x1b[31mb\u2028.hdr: is {'x' * 10_000}; export it \ud800again."))
    assert len(told) <= LONGEST_MESSAGE
    assert told.isprintable()
    assert told.startswith("/data/a ?[31mb .hdr: is xxx")
    assert told.endswith("xxx; export it ?again.")


def test_values_of_damaged_files_are_shown_in_short():
    # As a parameter, the number would be written by pytest, which Python refuses.
    for value in ("a" * 10_000, [[["a"] * 1000] * 1000] * 1000, 1 << 20_000, {"a": {"b": {"c": 1}}}):
        assert len(shown(value)) < 300


FINDINGS = [Finding("white", "red", "No white."), Finding("turn", "amber", "A gap."), Finding("dates", "red", "Old.")]


def test_all_red_findings_are_named_at_once() -> None:
    with pytest.raises(InputError, match=r"No white\. Old\..*--accept white --accept dates"):
        refuse_red(FINDINGS)


def test_accepted_findings_stop_nothing() -> None:
    refuse_red(FINDINGS, accepted=["white", "dates"])
    with pytest.raises(InputError, match=r"^No white"):
        refuse_red(FINDINGS, accepted=["dates"])
