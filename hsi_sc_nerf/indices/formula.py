"""Formulas of reflectances, such as ``1/R510 - 1/R550``: parsed into a few operations, never run as code."""

from __future__ import annotations

import ast
import math
import operator
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.spectra import Spectra, require_bands

MAX_LETTERS = 200
"""Length of a formula, which bounds the depth of its tree as well."""
_OPERATORS: dict[type, Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}
_FUNCTIONS = ("sqrt", "log10")
_PRINTED = str.maketrans({"^": "**", "\N{MINUS SIGN}": "-", "\N{EN DASH}": "-", "\N{MULTIPLICATION SIGN}": "*"})
"""Signs of formulas in print, which people copy."""
_BAND = re.compile(r"R(\d{3,5})")


@dataclass(frozen=True)
class SpectralIndex:
    """A spectral index, a number without a unit.

    Attributes:
        name: short name.
        expression: formula; R800 is the reflectance at 800 nm.
        drawn_range: values at the two ends of a colour map; NaN where only what is drawn tells.
        tells: what it follows.
        reference: where it was published.

    Raises:
        ValueError: the expression is no formula.
    """

    name: str
    expression: str
    drawn_range: tuple[float, float] = (math.nan, math.nan)
    tells: str = "own formula"
    reference: str = ""

    def __post_init__(self) -> None:
        if not self.wavelengths_nm:
            raise ValueError("it names no reflectance such as R800")

    @cached_property
    def tree(self) -> ast.expr:
        """The parsed expression."""
        if len(self.expression) > MAX_LETTERS:
            raise ValueError(f"it is longer than {MAX_LETTERS} characters")
        try:
            return ast.parse(self.expression.strip().translate(_PRINTED), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
            raise ValueError("it is no formula") from error

    @cached_property
    def wavelengths_nm(self) -> tuple[float, ...]:
        """The wavelengths that it needs, in the order in which it names them."""
        named: dict[float, None] = {}

        def reflectance(nm: float) -> np.float64:
            named[nm] = None
            return np.float64(0.5)

        with np.errstate(all="ignore"):
            _value(self.tree, reflectance, np.float64, np)
        return tuple(named)

    @property
    def has_range(self) -> bool:
        """Whether the ends of its colours are known."""
        return math.isfinite(self.drawn_range[0])

    @property
    def definition(self) -> str:
        """NAME = FORMULA [LOW, HIGH], as `find_indices` reads it."""
        drawn = " [{:g}, {:g}]".format(*self.drawn_range) if self.has_range else ""
        return f"{self.name} = {self.expression}{drawn}"


def index_values(
    index: SpectralIndex, spectra: Float[Spectra, "*shape bands"], wavelengths_nm: Float[np.ndarray, "bands"]
) -> Float[Spectra, "*shape"]:
    """The index of each spectrum, from the bands nearest to its wavelengths.

    NaN where it is not defined (a division by zero, the root of a negative number) and where a reflectance that it
    needs is negative, which only noise can be.

    Raises:
        InputError: a wavelength of the index has no band near it.

    Example:
        >>> spectra = np.array([[0.05, 0.45]])
        >>> index_values(SpectralIndex("ND", "(R800 - R670) / (R800 + R670)"), spectra, np.array([670.0, 800.0]))
        array([0.8])
    """
    bands = require_bands(wavelengths_nm, index.wavelengths_nm, index.name)
    of = {nm: spectra[..., int(band)] for nm, band in zip(index.wavelengths_nm, bands, strict=True)}
    library: Any = np
    constant: Callable[[float], Any] = spectra.dtype.type if isinstance(spectra, np.ndarray) else spectra.new_tensor
    if not isinstance(spectra, np.ndarray):
        import torch as library  # takes seconds, and the commands' help does without it
    with np.errstate(all="ignore"):
        values = _value(index.tree, of.__getitem__, constant, library)
    known = library.isfinite(values)
    for reflectance in of.values():
        known = known & (reflectance >= 0.0)
    return library.where(known, values, constant(np.nan))


def _value(
    node: ast.expr, reflectance: Callable[[float], Any], constant: Callable[[float], Any], library: Any
) -> Any:
    """Value of a tree.

    Args:
        constant: turns a number of the formula into one of the values' type, whose division by zero raises nothing.
        library: numpy or torch, for the functions.

    Raises:
        ValueError: it holds something else than numbers, reflectances, `_OPERATORS` and `_FUNCTIONS`.
    """

    def of(part: ast.expr) -> Any:
        return _value(part, reflectance, constant, library)

    match node:
        case ast.BinOp(left, operation, right) if type(operation) in _OPERATORS:
            return _OPERATORS[type(operation)](of(left), of(right))
        case ast.UnaryOp(operation, operand) if type(operation) in _OPERATORS:
            return _OPERATORS[type(operation)](of(operand))
        case ast.Call(ast.Name(name), [argument], []) if name in _FUNCTIONS:
            return getattr(library, name)(of(argument))
        case ast.Name(name) if band := _BAND.fullmatch(name):
            return reflectance(float(band[1]))
        case ast.Constant(int() | float() as number) if not isinstance(number, bool):
            return constant(float(number))
    shown = ast.unparse(node)[:40]
    raise ValueError(f"'{shown}' is no number, reflectance such as R800, + - * / **, sqrt() or log10()")
