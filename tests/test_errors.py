from hsi_sc_nerf.errors import LONGEST_MESSAGE, InputError, shown


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
