"""Cubes written by hand, byte by byte, and read back through headers in every variation that ENVI allows."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hsi_sc_nerf.capture.envi import open_cube, write_cube

TYPES = {1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8", 12: "u2", 13: "u4", 14: "i8", 15: "u8"}
# Where (lines, samples, bands) are in the file, outermost first.
ORDER = {"bil": (0, 2, 1), "bip": (0, 1, 2), "bsq": (2, 0, 1)}
SUFFIXES = ["", ".raw", ".dat", ".img", ".bil", ".bip", ".bsq", ".bin", ".hyspex", ".RAW", ".DAT"]
UNITS = {"nm": 1.0, "Nanometers": 1.0, "Micrometers": 1e-3, "um": 1e-3, "µm": 1e-3, "Unknown": 1e-3, None: 1.0}


def random_cube(shape: tuple[int, int, int], dtype: str, seed: int) -> np.ndarray:
    """Any numbers that the type can hold, up to its ends."""
    kind = np.dtype(dtype)
    rng = np.random.default_rng(seed)
    if kind.kind == "f":
        return rng.normal(scale=1e3, size=shape).astype(kind)
    info = np.iinfo(kind)
    cube = rng.integers(info.min, info.max, size=shape, dtype=kind, endpoint=True)
    cube.flat[0] = info.max
    return cube


shapes = st.tuples(st.integers(1, 4), st.integers(1, 4), st.integers(1, 5))


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(
    shape=shapes,
    envi_type=st.sampled_from(sorted(TYPES)),
    interleave=st.sampled_from(["bil", "bip", "bsq", "BIL", "Bsq"]),
    byte_order=st.sampled_from([0, 1, None]),
    offset=st.sampled_from([0, 1, 7, 64, None]),
    suffix=st.sampled_from(SUFFIXES),
    header_name=st.sampled_from(["{data}.hdr", "{stem}.hdr", "{stem}.HDR"]),
    unit=st.sampled_from(list(UNITS)),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "latin-1"]),
    line_end=st.sampled_from(["\n", "\r\n"]),
    seed=st.integers(0, 2**32 - 1),
)
def test_every_variation_of_header_and_data(
    tmp_path_factory,
    shape,
    envi_type,
    interleave,
    byte_order,
    offset,
    suffix,
    header_name,
    unit,
    encoding,
    line_end,
    seed,
):
    folder: Path = tmp_path_factory.mktemp("cube")
    cube = random_cube(shape, TYPES[envi_type], seed)
    stored = cube.transpose(ORDER[interleave.lower()]).astype(cube.dtype.newbyteorder(">" if byte_order else "<"))
    data = folder / f"scan.1{suffix}"
    data.write_bytes(b"\xff" * (offset or 0) + stored.tobytes())
    wavelengths_nm = 400.25 + 10.0 * np.arange(shape[2])
    fields = [
        "; a comment = 3",
        f"Samples = {shape[1]}",
        f"lines   = {shape[0]}",
        f"bands = {shape[2]}",
        f"data type = {envi_type}",
        f"interleave = {interleave}",
        None if byte_order is None else f"byte order = {byte_order}",
        None if offset is None else f"header offset = {offset}",
        None if unit is None else f"wavelength units = {unit}",
        "  ; an indented comment = {",
        "wavelength = {",
        *(f" {w * UNITS[unit]:.8g}," for w in wavelengths_nm),
        "}",
        "fwhm = {" + ", ".join(f"{3.0 * UNITS[unit]:g}" for _ in wavelengths_nm) + "}",
    ]
    text = line_end.join(["ENVI", *(field for field in fields if field is not None), ""])
    header = folder / header_name.format(data=data.name, stem="scan.1")
    header.write_bytes(text.encode(encoding))

    opened = open_cube(header)
    assert opened.data_path == data
    assert opened.shape == shape
    np.testing.assert_allclose(opened.wavelengths_nm, wavelengths_nm)
    np.testing.assert_allclose(opened.fwhm_nm, 3.0)
    np.testing.assert_array_equal(opened.memmap(), cube)
    read = opened.read()
    assert read.dtype == cube.dtype
    assert read.flags.c_contiguous
    np.testing.assert_array_equal(read, cube)


@settings(max_examples=40, deadline=None)
@given(
    shape=shapes,
    envi_type=st.sampled_from(sorted(TYPES)),
    interleave=st.sampled_from(sorted(ORDER)),
    suffix=st.sampled_from([".raw", ".dat", ".img", ".bip", ""]),
    seed=st.integers(0, 2**32 - 1),
)
def test_what_is_written_is_read(tmp_path_factory, shape, envi_type, interleave, suffix, seed):
    path = tmp_path_factory.mktemp("cube") / "a.b.hdr"
    cube = random_cube(shape, TYPES[envi_type], seed)
    wavelengths_nm = 400.0 + np.arange(shape[2])
    write_cube(
        path,
        cube,
        wavelengths_nm=wavelengths_nm,
        interleave=interleave,
        data_suffix=suffix,
        extra_header={
            "tint": 12.5,
            "data ignore value": 3,
            "reflectance scale factor": 200,
            "bbl": [int(i > 0) for i in range(shape[2])],
        },
    )
    opened = open_cube(path)
    assert (opened.shape, opened.interleave) == (shape, interleave)
    assert opened.dtype == cube.dtype.newbyteorder("<")
    assert (opened.integration_time_ms, opened.ignore_value, opened.reflectance_scale) == (12.5, 3.0, 200.0)
    assert opened.good_bands.tolist() == [i > 0 for i in range(shape[2])]
    assert opened.fwhm_nm is None
    np.testing.assert_array_equal(opened.read(), cube)
    np.testing.assert_array_equal(opened.wavelengths_nm, wavelengths_nm)
    assert sorted(p.name for p in path.parent.iterdir()) == sorted([path.name, f"a.b{suffix}"])
