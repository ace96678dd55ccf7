"""The materials that a scene file defines: pigments of a plant surface, a plain level, or a measured spectrum."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np

from hsi_sc_nerf import paper
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.simulate.materials import Material, Measured, Plain, PlantTissue
from hsi_sc_nerf.simulate.reading import check_ranges, read_dataclass

KINDS = {"plant": PlantTissue, "plain": Plain}
COLUMNS = ("wavelength_nm", "reflectance")


def read_materials(values: Any, source: str, folder: Path) -> dict[str, Material]:
    """Materials of a scene file's ``materials`` mapping, by name.

    Each is ``plant: {plateau: ...}`` (fields of `PlantTissue`), ``plain: {level: ...}`` (fields of `Plain`), or
    ``csv: FILE`` with a path relative to ``folder``.

    Raises:
        InputError: not such a mapping; an unknown, missing, mistyped or out-of-range value; see `read_spectrum`.
    """
    if not isinstance(values, dict):
        raise InputError(f"{source}: materials must hold `name: definition` lines, not {values!r}.")
    return {str(name): _read_material(value, source, f"materials.{name}", folder) for name, value in values.items()}


def _read_material(value: Any, source: str, where: str, folder: Path) -> Material:
    if not isinstance(value, dict) or len(value) != 1 or not {*value} <= {*KINDS, "csv"}:
        raise InputError(
            f"{source}: {where} is {value!r}, but must be one of `plant: {{plateau: ...}}`, `plain: {{level: ...}}` "
            "and `csv: FILE`."
        )
    ((kind, content),) = value.items()
    if kind == "csv":
        if not isinstance(content, str):
            raise InputError(f"{source}: {where}.csv is {content!r}, but must be the path of a CSV file.")
        return read_spectrum(folder / content)
    material = read_dataclass(KINDS[kind], content, source, f"{where}.{kind}.")
    check_ranges(material, source, f"{where}.{kind}.")
    return material


def read_spectrum(path: Path) -> Measured:
    """A measured reflectance spectrum: a CSV file with the columns wavelength_nm and reflectance.

    Raises:
        InputError: the file is missing or lacks a column; a value is no number; wavelengths do not increase or do
            not cover `paper.WAVELENGTH_RANGE_NM`; a reflectance is outside [0, 1].
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            rows = list(csv.DictReader(file, skipinitialspace=True))
        wavelengths_nm, reflectance = (np.array([float(row[column]) for row in rows]) for column in COLUMNS)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); give the path of a spectrum's CSV file."
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path}: is no table of numbers with the columns {' and '.join(COLUMNS)}; save the spectrum so."
        ) from error
    low_nm, high_nm = paper.WAVELENGTH_RANGE_NM
    if len(rows) == 0 or not wavelengths_nm.min() <= low_nm < high_nm <= wavelengths_nm.max():
        raise InputError(f"{path}: must cover {low_nm:g} to {high_nm:g} nm; extend the spectrum at its ends.")
    if not (np.diff(wavelengths_nm) > 0.0).all():
        raise InputError(f"{path}: wavelengths must increase from line to line; sort the lines and keep each once.")
    if not ((reflectance >= 0.0) & (reflectance <= 1.0)).all():
        raise InputError(f"{path}: reflectances must lie between 0 and 1; divide by 100 if they are percentages.")
    return Measured(tuple(wavelengths_nm.tolist()), tuple(reflectance.tolist()))
