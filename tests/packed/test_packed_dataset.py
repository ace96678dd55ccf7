import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from capture_factory import packed_frame
from spectral import get_rgb
from spectral.io import envi as spy

from hsi_sc_nerf import paper
from hsi_sc_nerf.capture.envi import write_cube
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import write_png
from hsi_sc_nerf.geometry.camera import PinholeIntrinsics, look_at
from hsi_sc_nerf.packed.cube import (
    FLAGGED,
    LARGEST_REFLECTANCE,
    REFLECTANCE_SCALE,
    PixelFlag,
    ReflectanceUncertainty,
    pack,
    unpack,
    write_packed_cube,
)
from hsi_sc_nerf.packed.dataset import (
    Container,
    PackedDataset,
    is_packed,
    open_packed,
    write_transforms,
)

WAVELENGTHS_NM = np.array([450.5, 550.25, 650.125])


@pytest.fixture
def dataset(tmp_path) -> PackedDataset:
    rng = np.random.default_rng(0)
    frames = []
    for name in ("a", "b"):
        pose = look_at([0.4, 0.1, 0.3], [0.0, 0.0, 0.1])
        frame = packed_frame(tmp_path, name, pose, angle_deg=12.5, reprojection_error_px=0.25)
        write_packed_cube(frame.cube_path, pack(rng.random((4, 5, 3))), WAVELENGTHS_NM)
        write_png(frame.image_path, rng.integers(0, 256, (4, 5, 3), dtype=np.uint8))
        write_png(frame.mask_path, np.eye(4, 5, dtype=np.uint8) * 255)
        write_png(frame.flags_path, np.eye(4, 5, dtype=np.uint8) * PixelFlag.SATURATED)
        frames.append(frame)
    return PackedDataset(
        root=tmp_path,
        intrinsics=PinholeIntrinsics(5, 4, 10.0, 11.0, 2.5, 2.0),
        distortion=np.array([0.1, 0.2, 0.3, 0.4]),
        wavelengths_nm=WAVELENGTHS_NM,
        pseudo_rgb_nm=WAVELENGTHS_NM[::-1],
        object_name="pear",
        scene_box_m=np.array([[-0.1, -0.1, 0.0], [0.1, 0.1, 0.2]]),
        object_box_m=np.array([[-0.05, -0.05, 0.07], [0.05, 0.05, 0.2]]),
        background_reflectance=np.array([0.9, 0.91, 0.92]),
        container=Container(0.09, 0.07),
        frames=tuple(frames),
        flagged_values=7,
        bad_bands_nm=np.array([397.5, 1003.5]),
        fwhm_nm=np.array([7.0, 7.1, 7.2]),
        uncertainty=ReflectanceUncertainty(*np.array([[1e-6, 2e-6, 3e-6], [1e-5, 2e-5, 3e-5], [1e-4, 2e-4, 3e-4]])),
        typical_uncertainty=np.array([0.004, 0.005, 0.006]),
        fingerprint="f00",
    )


def edit(root: Path, change) -> None:
    content = json.loads((root / "transforms.json").read_text())
    change(content)
    (root / "transforms.json").write_text(json.dumps(content))


@pytest.mark.parametrize("known", [True, False])
def test_round_trip(dataset, known):
    if not known:
        unknown = dict.fromkeys(("container", "fwhm_nm", "uncertainty", "typical_uncertainty", "fingerprint"))
        dataset = replace(dataset, bad_bands_nm=np.zeros(0), metric=False, **unknown)
    write_transforms(dataset)
    for path in (dataset.root, dataset.root / "transforms.json"):
        opened = open_packed(path)
        for field in fields(dataset):
            value = getattr(dataset, field.name)
            if isinstance(value, np.ndarray):
                np.testing.assert_array_equal(getattr(opened, field.name), value)
            elif field.name not in ("frames", "uncertainty"):
                assert getattr(opened, field.name) == value
        for name in ("constant", "linear", "quadratic") if known else ():
            np.testing.assert_array_equal(getattr(opened.uncertainty, name), getattr(dataset.uncertainty, name))
        assert (opened.uncertainty is None) != known
        np.testing.assert_array_equal(opened.camera_to_worlds, dataset.camera_to_worlds)
        kept = ("capture", "angle_deg", "reprojection_error_px", "flags_path", "image_path")
        for mine, theirs in zip(opened.frames, dataset.frames, strict=True):
            assert [getattr(mine, name) for name in kept] == [getattr(theirs, name) for name in kept]


def test_datasets_of_older_versions_are_metric(dataset):
    write_transforms(replace(dataset, metric=False))
    edit(dataset.root, lambda content: content.pop("metric"))
    assert open_packed(dataset.root).metric


def test_a_frames_files(dataset):
    frame = open_packed(write_transforms(dataset)).frames[0]
    assert isinstance(frame.cube(), np.memmap)
    reread = np.random.default_rng(0).random((4, 5, 3))
    assert np.abs(frame.cube() / REFLECTANCE_SCALE - reread).max() <= 0.5 / REFLECTANCE_SCALE + 1e-12
    np.testing.assert_array_equal(frame.mask(), np.eye(4, 5, dtype=bool))
    assert frame.flags().dtype == np.uint8
    np.testing.assert_array_equal(frame.flags() == PixelFlag.SATURATED, np.eye(4, 5, dtype=bool))
    image = np.zeros((4, 5, 3), np.uint8)
    image[..., 0], image[..., 2] = 200, 30
    write_png(frame.image_path, image)
    np.testing.assert_array_equal(frame.pseudo_rgb(), image)
    frame.flags_path.write_bytes(b"")
    with pytest.raises(InputError, match=r"flags.a\.png: is not a readable picture"):
        frame.flags()


def test_nerfstudio_keys(dataset):
    content = json.loads(write_transforms(dataset).read_text())
    assert content["camera_model"] == "OPENCV"
    assert [content[k] for k in ("w", "h", "fl_x", "fl_y", "cx", "cy")] == [5, 4, 10.0, 11.0, 2.5, 2.0]
    assert [content[k] for k in ("k1", "k2", "p1", "p2")] == [0.1, 0.2, 0.3, 0.4]
    assert content["frames"][1]["file_path"] == "images/b.png"
    assert content["frames"][1]["mask_path"] == "masks/b.png"
    assert content["frames"][1]["cube_path"] == "cubes/b.hdr"


@pytest.mark.parametrize(("interleave", "dtype"), [("bil", np.uint16), ("bip", np.int16), ("bip", np.float32)])
def test_another_cube_is_not_taken_for_a_packed_one(dataset, interleave, dtype):
    frame = dataset.frames[0]
    cube = np.ones((4, 5, 3), dtype)
    write_cube(frame.cube_path, cube, wavelengths_nm=WAVELENGTHS_NM, interleave=interleave, data_suffix=".bip")
    with pytest.raises(InputError, match=r"a\.hdr: .* BIP cube of 16-bit numbers"):
        frame.cube()


def test_cubes_open_in_spy_as_reflectance(dataset):
    header = dataset.frames[0].cube_path
    cube = spy.open(str(header))
    assert cube.metadata["interleave"] == "bip"
    assert header.with_suffix(".bip").is_file()
    assert float(cube.metadata["reflectance scale factor"]) == REFLECTANCE_SCALE
    assert int(cube.metadata["data ignore value"]) == FLAGGED
    assert "fwhm" not in cube.metadata
    expected = np.random.default_rng(0).random((4, 5, 3))
    np.testing.assert_allclose(np.asarray(cube.load()), expected, atol=1e-5)


def test_spy_shows_a_red_thing_red(tmp_path):
    wavelengths_nm = np.arange(400.0, 1000.0, 5.0)
    red = np.where(wavelengths_nm > 580.0, 0.9, 0.1)
    write_packed_cube(tmp_path / "c.hdr", pack(np.tile(red, (4, 4, 1))), wavelengths_nm)
    cube = spy.open(str(tmp_path / "c.hdr"))
    shown_nm = [wavelengths_nm[int(band) - 1] for band in cube.metadata["default bands"]]
    np.testing.assert_allclose(shown_nm, paper.PSEUDO_RGB_NM, atol=2.5)
    # SPy counts from 0, and takes the header's default bands.
    np.testing.assert_allclose(get_rgb(cube, stretch_all=False, bounds=(0.0, 1.0))[0, 0], [0.9, 0.1, 0.1], atol=1e-4)
    write_packed_cube(tmp_path / "swir.hdr", pack(np.ones((4, 4, 3))), np.array([1000.0, 1300.0, 1600.0]))
    assert "default bands" not in spy.open(str(tmp_path / "swir.hdr")).metadata


def test_packing_clips_and_flags(tmp_path):
    packed = pack(np.array([-0.5, 0.5, 7.0, np.nan]))
    assert packed.tolist() == [0, 25_000, 65_534, FLAGGED]
    reflectance, valid = unpack(packed)
    np.testing.assert_allclose(reflectance, [0.0, 0.5, LARGEST_REFLECTANCE, 0.0], rtol=1e-6)
    assert valid.tolist() == [True, True, True, False]


def test_is_packed(tmp_path, dataset):
    assert not is_packed(tmp_path)
    write_transforms(dataset)
    assert is_packed(tmp_path)
    edit(tmp_path, lambda content: content.pop("wavelengths_nm"))
    assert not is_packed(tmp_path)
    (tmp_path / "transforms.json").write_text("[")
    assert not is_packed(tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("fl_x"), "lacks the key 'fl_x'"),
        (lambda c: c["frames"][0].pop("cube_path"), "lacks the key 'cube_path'"),
        (lambda c: c.update(scene_box_m=[1, 2]), r"cannot be read \(scene_box_m is no list of 2 x 3 numbers\)"),
        (lambda c: c.update(flagged_values=None), "cannot be read"),
        (lambda c: c.update(bad_bands_nm=["red"]), r"cannot be read \(bad_bands_nm is no list of numbers"),
        (lambda c: c.update(fwhm_nm=[7.0]), r"cannot be read \(fwhm_nm is no list of 3 numbers\)"),
        (lambda c: c["uncertainty"].pop("linear"), "lacks the key 'linear'"),
        (lambda c: c["uncertainty"].update(linear=[1.0]), r"cannot be read \(linear is no list of 3 numbers\)"),
        (lambda c: c.update(uncertainty=[1.0]), "cannot be read"),
        (lambda c: c["frames"][0].pop("flags_path"), "lacks the key 'flags_path'"),
        (lambda c: c.update(frames=[]), "lists no frames"),
        (lambda c: c["frames"][0].update(angle_deg=None), "cannot be read"),
        (lambda c: c.update(h=c["h"] + 0.5), "h is .* whole number"),
        (lambda c: c.update(w=0), "cannot be read"),
        (lambda c: c.update(fl_x=float("nan")), "fl_x is nan, but must be a number"),
        (lambda c: c.update(cx=10**400), "cx is .*, but must be a number"),
        (lambda c: c.update(container={"diameter_m": "0.09", "height_m": 0.07}), "container.diameter_m is '0.09'"),
        (lambda c: c.update(scene_box_m=[[0, 0, 0], [1, 1, 10**400]]), "scene_box_m is no list of 2 x 3 numbers"),
        (lambda c: c["frames"][0]["transform_matrix"][0].__setitem__(0, float("inf")), "transform_matrix is no list"),
        (lambda c: c["frames"][0].update(cube_path="../elsewhere/a.hdr"), "outside of the dataset"),
        (lambda c: c["frames"][0].update(mask_path="/etc/passwd"), "outside of the dataset"),
        (lambda c: c["frames"][0].update(capture="../../a"), "capture is none of a file"),
        (lambda c: c.update(frames={"a": 1}), "cannot be read"),
        (lambda c: c.update(wavelengths_nm=3), "cannot be read"),
        (lambda c: c.update(scene_box_m=[[1, 1, 1], [0, 0, 0]]), "scene_box_m has no volume"),
        (lambda c: c["object_box_m"].__setitem__(1, c["object_box_m"][0]), "object_box_m has no volume"),
        (lambda c: c["frames"][1].update(transform_matrix=[[0.0] * 4] * 4), "holds no rotation"),
        (lambda c: c["frames"][0]["transform_matrix"][0].__setitem__(0, 9.0), "holds no rotation"),
    ],
)
def test_transforms_that_cannot_be_used(dataset, change, message):
    write_transforms(dataset)
    edit(dataset.root, change)
    with pytest.raises(InputError, match=rf"transforms\.json: .*{message}"):
        open_packed(dataset.root)


@pytest.mark.parametrize(
    "change",
    [lambda c: c.update(w=c["w"] + 1), lambda c: c.update(wavelengths_nm=c["wavelengths_nm"][:-1])],
)
def test_cubes_of_another_size_are_refused(dataset, change):
    fewer = {"background_reflectance", "fwhm_nm", "typical_uncertainty"}

    def shortened(content):
        change(content)
        bands = len(content["wavelengths_nm"])
        content.update({key: content[key] and content[key][:bands] for key in fewer})
        if content["uncertainty"]:
            content["uncertainty"] = {key: terms[:bands] for key, terms in content["uncertainty"].items()}

    write_transforms(dataset)
    assert dataset.cube_of(dataset.frames[0]).shape == (4, 5, 3)
    edit(dataset.root, shortened)
    changed = open_packed(dataset.root)
    with pytest.raises(InputError, match=r"\.hdr: has .* but the dataset"):
        changed.cube_of(changed.frames[0])


def test_a_mask_of_another_size_is_refused(dataset):
    write_png(dataset.frames[1].mask_path, np.zeros((2, 3), np.uint8))
    with pytest.raises(InputError, match=r"masks.*png: has 2 x 3 values"):
        dataset.mask_of(dataset.frames[1])


def test_missing_files(tmp_path, dataset):
    with pytest.raises(InputError, match="no packed dataset here"):
        open_packed(tmp_path)
    write_transforms(dataset)
    for folder in ("masks", "flags"):
        (tmp_path / folder / "b.png").rename(tmp_path / "elsewhere.png")
        with pytest.raises(InputError, match=rf"{folder}.b\.png: is missing"):
            open_packed(tmp_path)
        (tmp_path / "elsewhere.png").rename(tmp_path / folder / "b.png")
