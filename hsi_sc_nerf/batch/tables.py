"""The table of all objects: one row an object, as CSV and Parquet, with a dictionary of its columns."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from hsi_sc_nerf.batch.columns import GROUPS, STANDING, Column, Value
from hsi_sc_nerf.batch.objects import read_objects
from hsi_sc_nerf.batch.plan import LIST_NAME, OBJECTS_NAME
from hsi_sc_nerf.batch.session_list import OBJECT, SESSION, Row, read_sessions
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import atomic_write

CSV_NAME, PARQUET_NAME, DICTIONARY_NAME = "traits.csv", "traits.parquet", "traits_dictionary.csv"
_MEANINGS = {OBJECT: "name of the object, and of its folder", SESSION: "folder of its captures"}
_NUMBER = re.compile(r"[+-]?(0|[1-9]\d{0,14})(\.\d*([eE][+-]?\d{1,2})?|[eE][+-]\d{1,2})?")
"""Numbers, but not names such as 007, 1E2 or 12345678901234567890. Programs write 1e-05, with the exponent's sign."""


@dataclass(frozen=True)
class BatchTable:
    """One row an object.

    Attributes:
        columns: in their order: of the list of sessions, then what was found.
        rows: values in the order of the columns; those of the list of sessions are texts, as they stand there.
        reports: reports of each row, if there is one.
        places: of each standing column and each that was found its number here, whatever name it had to take.
    """

    columns: tuple[Column, ...]
    rows: list[list[Value]]
    reports: list[Path | None]
    places: Mapping[Column, int]

    def values(self, column: Column) -> list[Value]:
        """All values of a column, numbers as numbers."""
        at = self.columns.index(column)
        values = [row[at] for row in self.rows]
        if column.kind != "number":
            return values
        return [None if value is None or value == "" else float(value) for value in values]


def read_table(out: Path, done: Callable[[int], None] | None = None) -> BatchTable:
    """The table of the batch in ``out``.

    Args:
        out: with ``sessions.csv`` and ``objects/``.
        done: called with the number of objects read, of `listed_sessions`.

    Raises:
        InputError: the list of sessions cannot be read. What is wrong with an object stands in its row.

    Example:
        >>> table = read_table(Path("season"))
        >>> [column.name for column in table.columns[:2]]
        ['object', 'session']
    """
    sessions = listed_sessions(out)
    header, found = [*sessions[0]], []
    for number, session in enumerate(sessions, start=1):
        of_session, report = read_objects(out / OBJECTS_NAME / session[OBJECT])
        found += [(session, cells, report) for cells in of_session]
        if done is not None:
            done(number)
    names = named_apart(header, {column for _, cells, _ in found for column in cells})
    given = []
    for name in header:
        meaning, values = _MEANINGS.get(name, "column of the list of sessions"), [one[name] for one in sessions]
        numbers = name not in _MEANINGS and any(values) and all(not v or _NUMBER.fullmatch(v) for v in values)
        given.append(Column(name, "", meaning, "list", "number" if numbers else "text"))
    rows = [[*session.values(), *(cells.get(column) for column in names)] for session, cells, _ in found]
    places = {column: number for number, column in enumerate(names, start=len(given))}
    return BatchTable((*given, *names.values()), rows, [report for *_, report in found], places)


def listed_sessions(out: Path) -> list[Row]:
    """The objects of the batch in ``out``, whose sessions may have been moved since.

    Raises:
        InputError: there is no batch, or its list of sessions cannot be read.
    """
    path = out / LIST_NAME
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; give the --output-dir of `hsi-sc-nerf batch`.")
    return read_sessions(path, may_be_gone=True)


def named_apart(taken: Iterable[str], found: Iterable[Column]) -> dict[Column, Column]:
    """The standing columns and those found, in their order, each with the column that stands for it in the table.

    Names that two columns would share, or that the list of sessions has, get a number: of two classes "soft spot"
    and "soft-spot" the second one's columns end in _2.
    """
    order = {column: number for number, column in enumerate(STANDING)}
    used, names = {name.lower() for name in taken}, {}
    for column in sorted(
        {*STANDING, *found}, key=lambda c: (GROUPS.index(c.group), order.get(c, len(order)), c.name, c.definition)
    ):
        name, number = column.name, 1
        while name.lower() in used:
            number += 1
            name = f"{column.name}_{number}"
        used.add(name.lower())
        names[column] = name

    def renamed(column: Column) -> Column:
        return replace(column, name=names[column], spread=column.spread and renamed(column.spread))

    return {column: renamed(column) for column in names}


def write_tables(table: BatchTable, out: Path) -> bool:
    """Write the table as CSV and Parquet, and the dictionary of its columns.

    Returns:
        Whether Parquet was written, which needs pyarrow.

    Raises:
        InputError: the operating system refused to write.
    """
    _write_csv(out / CSV_NAME, [column.name for column in table.columns], table.rows)
    meanings = [[column.name, column.unit, column.definition] for column in table.columns]
    _write_csv(out / DICTIONARY_NAME, ["name", "unit", "definition"], meanings)
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        # That of an earlier call would be taken for the same table.
        (out / PARQUET_NAME).unlink(missing_ok=True)
        return False
    types = {"number": pyarrow.float64(), "text": pyarrow.string(), "truth": pyarrow.bool_()}
    fields = [
        pyarrow.field(
            column.name, types[column.kind], metadata={"unit": column.unit, "definition": column.definition}
        )
        for column in table.columns
    ]
    arrays = [pyarrow.array(table.values(column), types[column.kind]) for column in table.columns]
    with atomic_write(out / PARQUET_NAME) as (temporary,):
        parquet.write_table(pyarrow.Table.from_arrays(arrays, schema=pyarrow.schema(fields)), temporary)
    return True


def _write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[Value]]) -> None:
    with atomic_write(path) as (temporary,), temporary.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([header, *rows])
