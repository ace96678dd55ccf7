"""The list of sessions that a batch works on: a folder of sessions, or a table of the user."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from hsi_sc_nerf.errors import InputError, shown
from hsi_sc_nerf.number_table import without_empty_columns

OBJECT, SESSION = "object", "session"
SETTINGS = ("preset", "process", "train")
"""Columns of a session's own settings."""
_NAME = re.compile(r"[^\W_][\w.-]*")
_NAME_RULE = "a name is of letters, digits, dots, dashes and underscores and begins with a letter or a digit"
_DECIMAL_COMMA = re.compile(r"[+-]?\d+(,\d+)?")
Row = dict[str, str]
"""Cells by column: the object, its session, and the user's own."""


def read_sessions(path: Path, may_be_gone: bool = False) -> list[Row]:
    """The objects and their sessions, in order; the sessions as absolute paths.

    Args:
        path: a folder whose folders are sessions, or a CSV with the columns ``object`` and ``session`` and any
            others, as a spreadsheet writes it (commas, semicolons or tabs; UTF-8; decimal commas become points).
            There, a session's folder is relative to the file's own.
        may_be_gone: whether folders of sessions may be missing by now.

    Raises:
        InputError: a column or a folder is missing, a name is no folder's or comes twice, a session comes twice with
            the same settings, or it is no table.

    Example:
        >>> rows = read_sessions(Path("season.csv"))
        >>> rows[0]["object"]
        'pear_01'
    """
    if path.is_dir():
        # Deferred because it takes a second to import: each step of each object would wait for it.
        from hsi_sc_nerf.capture.session import is_session

        folders = sorted(one for one in path.iterdir() if one.is_dir() and is_session(one))
        if not folders:
            raise InputError(f"{path}: holds no sessions; give the folder that the folders of the sessions lie in.")
        rows = [(str(one), {OBJECT: one.name, SESSION: str(one.resolve())}) for one in folders]
    else:
        rows = [(f"{path}, line {line}", row) for line, row in _read_table(path)]
        if not rows:
            raise InputError(f"{path}: lists no sessions; write a line for each below its titles.")
    names: set[str] = set()
    settings: dict[tuple[str, ...], str] = {}
    for where, row in rows:
        name = row[OBJECT]
        if not _NAME.fullmatch(name) or len(name) > 100:
            rename = "rename it, or name it in a CSV" if path.is_dir() else "choose another"
            raise InputError(f"{where}: {shown(name)} cannot be the name of a folder; {rename}: {_NAME_RULE}.")
        # Some file systems take names for the same that differ in case only.
        if name.casefold() in names:
            raise InputError(f"{where}: the object {shown(name)} comes twice; give each session a name of its own.")
        names.add(name.casefold())
        if not row[SESSION]:
            raise InputError(f"{where}: names no session; write its folder in the column '{SESSION}'.")
        folder = path.parent / row[SESSION]
        try:
            there, row[SESSION] = folder.is_dir(), str(folder.resolve())
        except (OSError, ValueError) as error:  # a name that is too long, or that no system takes
            raise InputError(f"{where}: {shown(row[SESSION])} is no path ({error}); mend it.") from error
        if may_be_gone:
            continue
        if not there:
            raise InputError(f"{where}: there is no folder {folder}; mend the path or leave out the line.")
        same = (row[SESSION], *(row.get(title, "") for title in SETTINGS))
        if same in settings:
            raise InputError(
                f"{where}: its session is also that of {settings[same]}, with the same settings; mend the path or "
                "leave out the line."
            )
        settings[same] = name
    return [row for _, row in rows]


def sessions_table(rows: Sequence[Row]) -> str:
    """The list as CSV text, object and session first."""
    text = io.StringIO()
    titles = [OBJECT, SESSION, *(title for title in rows[0] if title not in (OBJECT, SESSION))]
    writer = csv.DictWriter(text, titles, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _read_table(path: Path) -> Iterator[tuple[int, Row]]:
    """Line and cells of each row of a CSV."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); give a folder of sessions or a CSV.") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is no UTF-8 text; save it as 'CSV UTF-8' in the spreadsheet.") from error
    first = re.sub('"[^"]*"', "", next((line for line in text.splitlines() if line.strip()), ""))
    reader = csv.reader(io.StringIO(text, newline=""), delimiter=max(",;\t", key=first.count), strict=True)
    try:
        lines = [(reader.line_num, stripped) for cells in reader if any(stripped := [cell.strip() for cell in cells])]
    except csv.Error as error:
        raise InputError(f"{path}: is no table after line {reader.line_num} ({error}); save it as CSV.") from error
    kept = without_empty_columns([cells for _, cells in lines])
    titles = [_own_title(title) for title in kept[0]] if kept else []
    rows = [(line, cells) for (line, _), cells in zip(lines[1:], kept[1:], strict=True)]
    for title in (OBJECT, SESSION):
        if title not in titles:
            raise InputError(
                f"{path}: has no column '{title}' but {', '.join(titles[:6]) or 'none'}; its first line names "
                f"{OBJECT}, {SESSION} and others."
            )
    if "" in titles or len(set(titles)) < len(titles):
        raise InputError(f"{path}: a column has no title, or two have the same; give each a title of its own.")
    for line, cells in rows:
        if len(cells) != len(titles):
            mend = "put quotation marks around a cell that holds the separator"
            mend = mend if len(cells) > len(titles) else "add the cells that are missing, which may be empty"
            raise InputError(f"{path}, line {line}: has {len(cells)} cells and not {len(titles)}; {mend}.")
    columns: list[Sequence[str]] = list(zip(*(cells for _, cells in rows), strict=True))
    if reader.dialect.delimiter != ",":
        columns = [
            column if title in (OBJECT, SESSION, *SETTINGS) else _with_points(column)
            for title, column in zip(titles, columns, strict=False)
        ]
    for (line, _), row in zip(rows, zip(*columns, strict=True), strict=True):
        yield line, dict(zip(titles, row, strict=True))


def _own_title(title: str) -> str:
    """A title that means something here in lower case; one of the user's as it is."""
    return title.lower() if title.lower() in (OBJECT, SESSION, *SETTINGS) else title


def _with_points(column: Sequence[str]) -> Sequence[str]:
    """A column of numbers with decimal points in place of commas; any other as it is."""
    numbers = all(not cell or _DECIMAL_COMMA.fullmatch(cell) for cell in column)
    return [cell.replace(",", ".") for cell in column] if numbers else column
