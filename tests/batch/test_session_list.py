"""The list of sessions as people have it, and one sentence for each that cannot be used."""

import pytest

from hsi_sc_nerf.batch.session_list import read_sessions, sessions_table
from hsi_sc_nerf.errors import InputError


@pytest.fixture
def table(tmp_path):
    """Writes a table beside two sessions; the second has a name that a spreadsheet quotes."""
    for name in ("a", "b, c"):
        (tmp_path / name / "one" / "capture").mkdir(parents=True)

    def write(content):
        path = tmp_path / "list.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return path

    return write


@pytest.mark.parametrize(
    "content",
    [
        'object,session,day\np1,a,3\np2,"b, c",\n',
        "object;session;day\r\np1;a;3\r\n;;\r\np2;b, c;\r\n",
        "\ufeffsession\tobject\tday\na\tp1\t3\nb, c\tp2\t\n",
        "Object;SESSION;day;;\n;;;;\np1;a;3;;\np2;b, c;;;\n;;;;\n",
    ],
    ids=[
        "commas",
        "semicolons of Excel",
        "tabs with a byte order mark",
        "capitals, and empty columns and lines",
    ],
)
def test_tables_of_spreadsheets_are_read(table, content):
    path = table(content)
    rows = read_sessions(path)
    assert [(row["object"], row["session"], row["day"]) for row in rows] == [
        ("p1", str(path.parent / "a"), "3"),
        ("p2", str(path.parent / "b, c"), ""),
    ]
    # The normalised copy says the same, wherever it lies.
    copy = path.parent / "elsewhere" / "copy.csv"
    copy.parent.mkdir()
    copy.write_text(sessions_table(rows))
    assert copy.read_text().startswith("object,session,day\n")
    assert read_sessions(copy) == rows


@pytest.mark.parametrize("start", ['object;session;"mass, g, dry"\n', "\n\nobject;session;mass\n"])
def test_the_separator_is_told_though_titles_hold_others_or_lines_are_empty(table, start):
    assert read_sessions(table(f"{start}p1;a;3\n"))[0]["object"] == "p1"


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("", "no column 'object'"),
        ("object,folder\np,a\n", "no column 'session'"),
        ("object,session\n", "lists no sessions"),
        ("object,session,day,day\np,a,1,2\n", "two have the same"),
        ("object,session,\np,a,1\n", "has no title"),
        ("object,session,day,note\np,a,1\n", "line 2: has 3 cells and not 4; add the cells that are missing"),
        ("sep=;\nobject;session\np;a\n", "no column 'object' but sep="),
        ("object,session\np,a\nP,a\n", "line 3: the object 'P' comes twice"),
        ("object,session\n../p,a\n", "line 2: '../p' cannot be the name of a folder"),
        ("object,session\n,a\n", "'' cannot be the name"),
        ("object,session\n" + "p" * 101 + ",a\n", "cannot be the name"),
        ("object,session\np,\n", "line 2: names no session"),
        ("object,session\np,nowhere\n", "line 2: there is no folder .*nowhere"),
        ("object,session\np,a\nq,./a/\n", "line 3: its session is also that of p, with the same settings"),
        ("object,session\np,b, c\n", "line 2: has 3 cells and not 2"),
        ('object,session\np,"a\n', "is no table after line 2"),
        ("object,session\nÄ,a\n".encode("latin-1"), "is no UTF-8"),
        ("object,session\np,a\n".encode("utf-16"), "is no UTF-8"),
    ],
)
def test_a_table_that_cannot_be_used_is_one_sentence(table, content, told):
    with pytest.raises(InputError, match=told) as raised:
        read_sessions(table(content))
    assert "\n" not in str(raised.value)


def test_tables_of_other_languages_are_read(table, tmp_path):
    """Umlauts, spaces, and a day that is no date, which is the user's own."""
    (tmp_path / "Äpfel, grün").mkdir()
    row, _ = read_sessions(table('object;session;day;Sorte\r\nÄpfel_1;"Äpfel, grün";31.02.;Boskop\r\np;a;;\r\n'))
    assert row == {"object": "Äpfel_1", "session": str(tmp_path / "Äpfel, grün"), "day": "31.02.", "Sorte": "Boskop"}


def test_numbers_with_decimal_commas_are_read_where_commas_do_not_separate(table):
    """Not those of a column that holds something else as well."""
    p, q = read_sessions(table("object;session;g;mL;plot\np;a;12,5;3;1,2\nq;b, c;;-0,5;none\n"))
    assert [p["g"], p["mL"], p["plot"], q["g"], q["mL"]] == ["12.5", "3", "1,2", "", "-0.5"]


def test_a_session_may_come_twice_with_other_settings(table):
    rows = read_sessions(table("object,session,preset\np,a,fast\nq,a,best\n"))
    assert [row["preset"] for row in rows] == ["fast", "best"]


def test_a_folder_of_sessions_is_a_list(table, tmp_path):
    (tmp_path / "notes").mkdir()
    with pytest.raises(InputError, match=r"'b, c' cannot be .* name it in a CSV"):
        read_sessions(tmp_path)
    (tmp_path / "b, c").rename(tmp_path / "b-c")
    assert [row["object"] for row in read_sessions(tmp_path)] == ["a", "b-c"]
    with pytest.raises(InputError, match="holds no sessions"):
        read_sessions(tmp_path / "notes")
    with pytest.raises(InputError, match="cannot be read"):
        read_sessions(tmp_path / "nowhere.csv")


@pytest.mark.parametrize("may_be_gone", [False, True])
def test_a_path_that_is_too_long_is_refused(tmp_path, may_be_gone):
    path = tmp_path / "list.csv"
    path.write_text(f"object,session\none,{'a' * 5000}\n")
    with pytest.raises(InputError, match=r"line 2: .* is no path"):
        read_sessions(path, may_be_gone)
