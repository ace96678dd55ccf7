"""Tables of numbers in text files, as people and their programs write them.

A spreadsheet's export depends on its language: cells are separated by commas, semicolons or tabs, decimals follow a
point or a comma, and titles may be quoted and hold units.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

_SEPARATORS = ";\t"
"""A table with neither of them in its last line is separated by commas."""
_COMMAS = "between numbers with decimal commas there must be semicolons or tabs; a single column needs decimal points"
_UNIT = re.compile(r"^(?P<name>.*?)\s*(?:[(\[](?P<brackets>[^)\]]*)[)\]]|/\s*(?P<slash>[^\s/]+))?$")
_MICROMETRES = ("um", "micron", "microns", "micrometer", "micrometers", "micrometre", "micrometres")


@dataclass(frozen=True, eq=False)
class NumberTable:
    """A table of numbers.

    Attributes:
        notes: lines that begin with #, without it.
        titles: titles of the columns, from the first line that is not numbers; empty without such a line.
        numbers: NaN for empty cells and NA.
        lines: lines of the file, by row.
    """

    notes: tuple[str, ...]
    titles: tuple[str, ...]
    numbers: Float[np.ndarray, "rows columns"]
    lines: tuple[int, ...]

    def by_title(self) -> dict[str, Float[np.ndarray, "rows"]]:
        """Columns by their titles in lower case, units left out; a wavelength's becomes ``wavelength_nm``.

        Raises:
            ValueError: the columns have no titles.
        """
        if self.numbers.size and not self.titles:
            raise ValueError("its first line holds numbers and not the columns' titles")
        columns = {}
        for title, column in zip(self.titles, self.numbers.T, strict=True):
            name, nm_per_unit = _name_and_nm(title)
            columns[name] = column * nm_per_unit
        return columns


def read_number_table(path: Path, columns: int | None = None, blanks: Collection[str] = ()) -> NumberTable:
    """Read a table of numbers: UTF-8, UTF-16 or Western European; separated by commas, semicolons or tabs.

    The decimal mark is a point, or a comma where cells are separated otherwise or quoted. Empty lines are skipped,
    and so are empty columns without a title at the right, which spreadsheets leave.

    Args:
        columns: read so many from the left; the others may hold anything and be missing, but not what may be the
            decimals of these: digits after a comma where titles do not tell, if no number of the table has a point.
        blanks: words, in lower case, that stand for no number, as NA does.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no such table; the message says why.

    Example:
        >>> Path("b.csv").write_text('Wavelength (nm);"Coefficient"\\n450,0;0,013\\n')
        >>> read_number_table(Path("b.csv")).by_title()
        {'wavelength_nm': array([450.]), 'coefficient': array([0.013])}
    """
    every = enumerate(_text(path).splitlines(), start=1)
    numbered = [(number, line) for number, line in every if line.strip(';, \t"')]
    notes = tuple(_note(line) for _, line in numbered if _is_note(line))
    numbered = [(number, line) for number, line in numbered if not _is_note(line)]
    if not numbered:
        return NumberTable(notes, (), np.empty((0, 0)), ())
    last = re.sub(r'"[^"]*"', "", numbered[-1][1])
    separator = next((mark for mark in _SEPARATORS if mark in last), ",")
    try:
        rows = [
            next(csv.reader([line], delimiter=separator, skipinitialspace=True, strict=True)) for _, line in numbered
        ]
    except csv.Error as error:
        raise ValueError(f"its quotation marks are not in pairs: {error}") from error
    rows = without_empty_columns([[cell.strip() for cell in row] for row in rows])
    titles = () if all(_is_number(cell) for cell in rows[0][:columns]) else tuple(rows[0])
    rows, lines = rows[bool(titles) :], [number for number, _ in numbered[bool(titles) :]]
    rows = [["" if cell.lower() in blanks else cell for cell in row] for row in rows]
    width = len(titles or rows[0])
    if columns is not None:
        if separator == "," and _may_be_decimals(rows, len(titles) or columns, columns):
            raise ValueError(f"its commas may separate columns or be decimal marks; {_COMMAS}")
        width = min(width, columns)
        titles, rows = titles[:width], [row[:width] for row in rows]
    for number, row in zip(lines, rows, strict=True):
        if len(row) != width:
            raise ValueError(
                f"its lines do not have the same number of columns: line {number} has {len(row)} and not {width}; "
                f"{_COMMAS}"
            )
        for cell in row:
            if not _is_number(cell):
                raise ValueError(f"line {number}: {cell!r} is not a number")
    table = np.array([[number_in(cell) for cell in row] for row in rows], float).reshape(len(rows), width)
    return NumberTable(notes, titles, table, tuple(lines))


def _may_be_decimals(rows: Sequence[list[str]], named: int, columns: int) -> bool:
    """Whether the comma after the first columns may be a decimal mark.

    Rows are longer than what is named, with a digit there, and no number shows how decimals are written.
    """
    longer = any(len(row) > named and row[columns][:1].isdecimal() for row in rows)
    marked = any(mark in cell for row in rows for cell in row if _is_number(cell) for mark in ".,")
    return longer and not marked


def read_notes(path: Path) -> dict[str, str]:
    """What the notes of a table say (`keyed`), without a look at its numbers.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is no text.
    """
    return keyed(_note(line) for line in _text(path).splitlines() if _is_note(line))


def keyed(notes: Iterable[str]) -> dict[str, str]:
    """Values of notes ``key: value`` by their keys in lower case."""
    pairs = (note.partition(":") for note in notes if ":" in note)
    return {key.strip().lower(): value.strip(" ;,\t") for key, _, value in pairs}


def number_in(text: str) -> float:
    """The number in a text, with a decimal point or comma; NaN if it is empty or NA.

    Raises:
        ValueError: it is none.
    """
    text = text.strip().replace("\N{MINUS SIGN}", "-")
    if text in ("", "NA"):
        return math.nan
    return float(text.replace(",", ".") if "." not in text else text)


def numbers_in(text: str) -> list[float]:
    """The numbers of a list, separated by semicolons or, with decimal points, by commas.

    Raises:
        ValueError: something in it is no number.
    """
    return [number_in(part) for part in text.split(";" if ";" in text else ",") if part.strip()]


def without_empty_columns(rows: Sequence[list[str]]) -> list[list[str]]:
    """The rows without the empty cells that a spreadsheet leaves at the right of all; one cell is kept at least."""
    width = max((at for row in rows for at, cell in enumerate(row, start=1) if cell), default=1)
    return [row[:width] for row in rows]


def _text(path: Path) -> str:
    content = path.read_bytes()
    encoding = "utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError:
        text = "\0" if encoding == "utf-16" else content.decode("latin-1")
    if "\0" in text:
        raise ValueError("it is no text")
    return text


def _is_note(line: str) -> bool:
    return line.lstrip(' "').startswith("#")


def _note(line: str) -> str:
    """A note without its marks; spreadsheets quote it and fill its line with separators."""
    line = line.strip().rstrip(";,\t ")
    if line.startswith('"') and line.endswith('"'):
        line = line[1:-1].replace('""', '"')
    return line.lstrip("# ").rstrip(";,\t ")


def _is_number(text: str) -> bool:
    try:
        number_in(text)
    except ValueError:
        return False
    return True


def _name_and_nm(title: str) -> tuple[str, float]:
    """A title in lower case without its unit, and the nanometres of that; 1 if it is no wavelength's."""
    match = _UNIT.match(title.lower())
    assert match is not None  # anything is a name
    name, unit = match["name"].strip(), (match["brackets"] or match["slash"] or "").strip()
    base, _, ending = name.replace(" ", "_").rpartition("_")
    if base in ("wavelength", "wavelengths"):
        base, unit = "wavelength", ending
    elif name in ("wavelength", "wavelengths"):
        base, unit = "wavelength", unit or "nm"
    elif name == "nm" and not unit:
        base, unit = "wavelength", "nm"
    else:
        return name.replace(" ", "_"), 1.0
    unit = re.sub("[\N{MICRO SIGN}\N{GREEK SMALL LETTER MU}]", "u", unit)
    if unit in _MICROMETRES:
        return "wavelength_nm", 1000.0
    return f"wavelength_{'nm' if unit in ('nm', 'nanometer', 'nanometers', 'nanometre', 'nanometres') else unit}", 1.0
