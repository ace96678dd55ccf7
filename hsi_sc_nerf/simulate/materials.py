"""Reflectance spectra of the materials from 397 to 1003 nm, and reading materials of a scene file.

A plant surface is a spectrally flat scatterer with absorbers: reflectance = plateau * 10 ** -(absorbance of the
pigments + water). Band positions after Merzlyak et al. (2003), "Reflectance spectral features and
non-destructive estimation of chlorophyll, carotenoid and anthocyanin content in apple fruit", and the 970 nm
overtone of water after Peñuelas et al. (1993).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf import paper
from hsi_sc_nerf.errors import InputError, shown
from hsi_sc_nerf.number_table import read_number_table
from hsi_sc_nerf.settings_file import between, check_ranges, read_dataclass

Spectrum = Float[np.ndarray, "bands"]


@dataclass(frozen=True)
class PlantTissue:
    """Pigment amounts of a plant surface, as absorbance at each pigment's strongest peak."""

    plateau: float = between(0.0, 1.0)
    """Reflectance of the near-infrared plateau, about 800-900 nm."""
    chlorophyll: float = between(0.0, 5.0, default=0.0)
    carotenoid: float = between(0.0, 5.0, default=0.0)
    anthocyanin: float = between(0.0, 5.0, default=0.0)
    brown: float = between(0.0, 5.0, default=0.0)
    """Oxidised phenols: absorbance at 400 nm, decreasing exponentially towards the red."""
    water: float = between(0.0, 5.0, default=0.0)


@dataclass(frozen=True)
class Plain:
    """A non-plant material with a nearly flat spectrum."""

    level: float = between(0.0, 1.0)
    """Reflectance at 700 nm."""
    slope_per_um: float = between(-3.0, 3.0, default=0.0)
    """Relative change of reflectance over 1000 nm."""
    blue_loss: float = between(0.0, 1.0, default=0.0)
    """Relative loss at 400 nm due to binders and whiteners; it vanishes by 450 nm."""


@dataclass(frozen=True)
class Measured:
    """A measured spectrum with linear interpolation."""

    wavelengths_nm: tuple[float, ...]
    """Increasing."""
    reflectance: tuple[float, ...]
    """Reflectance, in [0, 1]."""


Material: TypeAlias = PlantTissue | Plain | Measured
MATERIALS: dict[str, Material] = {
    "pear_skin": PlantTissue(0.66, chlorophyll=0.62, carotenoid=0.62, brown=0.10, water=0.075),
    "pear_blush": PlantTissue(0.64, chlorophyll=0.30, carotenoid=0.52, anthocyanin=0.55, brown=0.12, water=0.075),
    "apple_skin": PlantTissue(0.68, chlorophyll=0.34, carotenoid=0.55, brown=0.06, water=0.080),
    "apple_blush": PlantTissue(0.64, chlorophyll=0.26, carotenoid=0.60, anthocyanin=1.05, brown=0.10, water=0.080),
    "bruise": PlantTissue(0.44, chlorophyll=0.08, carotenoid=0.25, anthocyanin=0.16, brown=0.85, water=0.125),
    "lenticel": PlantTissue(0.72, chlorophyll=0.12, carotenoid=0.26, brown=0.14, water=0.055),
    "stem": PlantTissue(0.42, chlorophyll=0.10, carotenoid=0.12, brown=0.80, water=0.030),
    "kernel_yellow": PlantTissue(0.82, carotenoid=0.85, anthocyanin=0.05, brown=0.22, water=0.040),
    "kernel_white": PlantTissue(0.84, carotenoid=0.16, brown=0.07, water=0.040),
    "kernel_purple": PlantTissue(0.60, carotenoid=0.30, anthocyanin=1.3, brown=0.55, water=0.040),
    "cob": PlantTissue(0.58, carotenoid=0.25, anthocyanin=0.10, brown=0.50, water=0.035),
    "husk": PlantTissue(0.62, chlorophyll=0.28, carotenoid=0.34, brown=0.22, water=0.055),
    # Lycopene, a carotenoid, absorbs further into the green than the others; its place is taken by a red pigment's.
    "tomato_red": PlantTissue(0.66, chlorophyll=0.05, carotenoid=0.95, anthocyanin=1.00, brown=0.05, water=0.095),
    "tomato_green": PlantTissue(0.58, chlorophyll=0.60, carotenoid=0.70, brown=0.08, water=0.095),
    "container_plastic": Plain(0.62, slope_per_um=0.05, blue_loss=0.12),
    "paper": Plain(0.86, slope_per_um=0.04, blue_loss=0.25),
    "marker_ink": Plain(0.045, slope_per_um=0.03),
    "disc": Plain(0.78, slope_per_um=0.03, blue_loss=0.10),
    # Sintered PTFE: 0.95-0.97, nearly flat.
    "chamber": Plain(0.96, slope_per_um=0.01),
    # Materials of a textured chamber wall.
    "plywood": PlantTissue(0.66, carotenoid=0.18, brown=0.55, water=0.02),
    "blue_paint": Measured(
        (380.0, 420.0, 460.0, 500.0, 540.0, 580.0, 640.0, 700.0, 740.0, 800.0, 1010.0),
        (0.14, 0.30, 0.46, 0.38, 0.20, 0.09, 0.07, 0.12, 0.30, 0.42, 0.45),
    ),
    "black_paint": Plain(0.06, slope_per_um=0.05),
    # Calibration is relative to the tarp; an ideal tarp makes calibrated reflectance equal to the true one.
    "white_tarp": Plain(1.0),
    "tarp_surround": Plain(0.12, slope_per_um=0.05),
    # Exactly flat spectra for tests.
    "matte_white": Plain(1.0),
    "matte_grey": Plain(0.5),
}


KINDS = {"plant": PlantTissue, "plain": Plain}
COLUMNS = ("wavelength_nm", "reflectance")


def endmembers(
    names: Sequence[str], wavelengths_nm: Spectrum, own: Mapping[str, Material] | None = None
) -> Float[np.ndarray, "materials bands"]:
    """Reflectance of the named materials at the given wavelengths, each in [0, 1].

    ``own`` materials of the scene replace built-in ones of the same name.

    Raises:
        KeyError: a name is neither in ``own`` nor in `MATERIALS`.
    """
    known = {**MATERIALS, **(own or {})}
    return np.stack([reflectance(known[name], np.asarray(wavelengths_nm, float)) for name in names])


def reflectance(material: Material, wavelengths_nm: Spectrum) -> Spectrum:
    """Reflectance of one material, in [0, 1]."""
    if isinstance(material, Measured):
        return np.interp(wavelengths_nm, material.wavelengths_nm, material.reflectance)
    if isinstance(material, Plain):
        tilt = 1.0 + material.slope_per_um * (wavelengths_nm - 700.0) / 1000.0
        violet = 1.0 - material.blue_loss / (1.0 + np.exp((wavelengths_nm - 415.0) / 7.0))
        return np.clip(material.level * tilt * violet, 0.0, 1.0)
    absorbance = (
        material.chlorophyll * _chlorophyll(wavelengths_nm)
        + material.carotenoid * _carotenoid(wavelengths_nm)
        + material.anthocyanin * _peak(wavelengths_nm, 550.0, 33.0)
        + material.brown * np.exp(-(wavelengths_nm - 400.0) / 170.0)
        + material.water * water_absorbance(wavelengths_nm)
    )
    return np.clip(material.plateau * 10.0**-absorbance, 0.0, 1.0)


def _peak(wavelengths_nm: Spectrum, centre_nm: float, width_nm: float) -> Spectrum:
    return np.exp(-0.5 * ((wavelengths_nm - centre_nm) / width_nm) ** 2)


def _chlorophyll(w: Spectrum) -> Spectrum:
    """Chlorophyll a and b in tissue: Soret bands, a low plateau in the green, the red band and its shoulder."""
    return (
        1.1 * _peak(w, 418.0, 38.0)
        + 0.45 * _peak(w, 480.0, 20.0)
        + 0.28 * _peak(w, 590.0, 36.0)
        + 0.50 * _peak(w, 642.0, 17.0)
        + 0.92 * _peak(w, 677.0, 14.0)
    )


def _carotenoid(w: Spectrum) -> Spectrum:
    """Carotenoids: three overlapping bands in the blue that end sharply by about 530 nm."""
    return 0.8 * _peak(w, 412.0, 32.0) + 0.85 * _peak(w, 452.0, 16.0) + 0.75 * _peak(w, 482.0, 17.0)


def water_absorbance(wavelengths_nm: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """Shape of liquid water's absorbance, of a tissue with water 1: the overtone at 970 nm and the weak one at
    750-840 nm."""
    w = wavelengths_nm
    return _peak(w, 970.0, 24.0) + 0.30 * _peak(w, 1010.0, 40.0) + 0.06 * _peak(w, 835.0, 18.0)


def read_materials(values: Any, source: str, folder: Path) -> dict[str, Material]:
    """Materials of a scene file's ``materials`` mapping, by name.

    Each is ``plant: {plateau: ...}`` (fields of `PlantTissue`), ``plain: {level: ...}`` (fields of `Plain`), or
    ``csv: FILE`` with a path relative to ``folder``.

    Raises:
        InputError: not such a mapping; an unknown, missing, mistyped or out-of-range value; see `read_spectrum`.
    """
    if not isinstance(values, dict):
        raise InputError(f"{source}: materials must hold `name: definition` lines, not {shown(values)}.")
    return {str(name): _read_material(value, source, f"materials.{name}", folder) for name, value in values.items()}


def _read_material(value: Any, source: str, where: str, folder: Path) -> Material:
    if not isinstance(value, dict) or len(value) != 1 or not {*value} <= {*KINDS, "csv"}:
        raise InputError(
            f"{source}: {where} is {shown(value)}, but must be one of `plant: {{plateau: ...}}`, "
            "`plain: {level: ...}` and `csv: FILE`."
        )
    ((kind, content),) = value.items()
    if kind == "csv":
        if not isinstance(content, str):
            raise InputError(f"{source}: {where}.csv is {shown(content)}, but must be the path of a CSV file.")
        return read_spectrum(folder / content)
    material = read_dataclass(KINDS[kind], content, source, f"{where}.{kind}.")
    check_ranges(material, source, f"{where}.{kind}.")
    return material


def read_spectrum(path: Path) -> Measured:
    """A measured reflectance spectrum: a CSV file with the columns wavelength_nm and reflectance.

    Raises:
        InputError: the file is missing or lacks a column; a value is not a number; wavelengths do not increase or do
            not cover `paper.WAVELENGTH_RANGE_NM`; a reflectance is outside [0, 1].
    """
    try:
        columns = read_number_table(path).by_title()
        wavelengths_nm, reflectance = (columns[name] for name in COLUMNS)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); give the path of a spectrum's CSV file."
        ) from error
    except (ValueError, KeyError) as error:
        raise InputError(
            f"{path}: is not a table of numbers with the columns {' and '.join(COLUMNS)}; save it like that."
        ) from error
    low_nm, high_nm = paper.WAVELENGTH_RANGE_NM
    if len(wavelengths_nm) == 0 or not wavelengths_nm.min() <= low_nm < high_nm <= wavelengths_nm.max():
        raise InputError(f"{path}: must cover {low_nm:g} to {high_nm:g} nm; extend the spectrum at its ends.")
    if not (np.diff(wavelengths_nm) > 0.0).all():
        raise InputError(f"{path}: wavelengths must increase from line to line; sort the lines and keep each once.")
    if not ((reflectance >= 0.0) & (reflectance <= 1.0)).all():
        raise InputError(f"{path}: reflectances must lie between 0 and 1; divide by 100 if they are percentages.")
    return Measured(tuple(wavelengths_nm.tolist()), tuple(reflectance.tolist()))


def over(
    weights: Float[np.ndarray, "v m"], material: Float[np.ndarray, "m"], fraction: Float[np.ndarray, "v"]
) -> Float[np.ndarray, "v m"]:
    """Cover ``fraction`` (clipped to [0, 1]) of each point with a material."""
    fraction = np.clip(fraction, 0.0, 1.0)[:, None]
    return weights * (1.0 - fraction) + material * fraction


def smooth_noise(points: Float[np.ndarray, "v 3"], scale_m: float, rng: np.random.Generator) -> np.ndarray:
    """Smooth random field with mean 0, standard deviation of about 0.7 and features of about ``scale_m``."""
    waves = 24
    directions = rng.normal(size=(waves, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    wave_numbers = np.pi / scale_m * rng.uniform(0.6, 1.4, waves)
    phases = rng.uniform(0.0, 2.0 * np.pi, waves)
    field = np.cos(points @ (directions * wave_numbers[:, None]).T + phases).sum(axis=1)
    return field / np.sqrt(waves)


def smoothstep(x: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Cubic step from 0 at x <= 0 to 1 at x >= 1."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)
