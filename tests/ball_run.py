"""A run whose model is a ball of one spectrum before a flat background: what it renders is known.

The ball is `capture_factory`'s; everything but the field is the model that training would have.
"""

from copy import deepcopy
from pathlib import Path

import capture_factory as factory
import numpy as np
import torch
import yaml
from capture_factory import packed_frame
from nerfstudio.field_components.field_heads import FieldHeadNames

from hsi_sc_nerf.export.cloud import LIGHT_COLUMNS, SpectralCloud, band_property_names, write_spectral_ply
from hsi_sc_nerf.files import write_png
from hsi_sc_nerf.models.checkpoints import checkpoint_path, write_checkpoint
from hsi_sc_nerf.packed.cube import pack, write_packed_cube
from hsi_sc_nerf.packed.dataset import PackedDataset, write_transforms
from hsi_sc_nerf.processing.painted_masks import note_masks

ANGLES_DEG = np.arange(0.0, 360.0, 36.0)
DENSITY = 400.0  # opaque within some hundredths of the scene's unit


def write_ball_dataset(root: Path) -> Path:
    frames = []
    for i, angle_deg in enumerate(ANGLES_DEG):
        pose = factory.true_pose(angle_deg)
        mask = factory.sphere_mask(pose)
        reflectance = np.where(mask[..., None], factory.PLANT, factory.BACKGROUND)
        frame = packed_frame(root, f"ball_{i}", pose, angle_deg=angle_deg)
        write_packed_cube(frame.cube_path, pack(reflectance), factory.WAVELENGTHS_NM)
        write_png(frame.image_path, np.rint(255 * reflectance[..., [5, 3, 1]]).astype(np.uint8))
        write_png(frame.mask_path, 255 * mask.astype(np.uint8))
        write_png(frame.flags_path, np.zeros_like(mask, np.uint8))
        frames.append(frame)
    reach = np.full(3, factory.SPHERE_RADIUS_M)
    box = np.stack([factory.SPHERE_CENTRE_M - reach, factory.SPHERE_CENTRE_M + reach])
    dataset = PackedDataset(
        root=root,
        intrinsics=factory.INTRINSICS,
        distortion=np.zeros(4),
        wavelengths_nm=factory.WAVELENGTHS_NM,
        pseudo_rgb_nm=factory.WAVELENGTHS_NM[[5, 3, 1]],
        object_name="ball",
        scene_box_m=np.array([[-0.06, -0.06, 0.0], [0.06, 0.06, 0.16]]),
        object_box_m=box,
        background_reflectance=np.full(factory.BANDS, factory.BACKGROUND),
        container=None,
        fwhm_nm=np.full(factory.BANDS, 7.0),
        frames=tuple(frames),
    )
    note_masks(dataset)
    write_transforms(dataset)
    return root


def write_untrained_run(data: Path, output_dir: Path) -> Path:
    """The config.yml of a run with one checkpoint."""
    from hsi_sc_nerf.config import hsi_sc_nerf

    config = deepcopy(hsi_sc_nerf.config)
    config.output_dir, config.experiment_name, config.timestamp = output_dir, "ball", "run"
    config.pipeline.datamanager.data = config.pipeline.datamanager.dataparser.data = data
    config.pipeline.model.head, config.pipeline.model.effects = "direct", "view_dependence"
    torch.manual_seed(0)
    pipeline = config.pipeline.setup(device="cpu", test_mode="test")
    state = {"step": 0, "pipeline": pipeline.state_dict()}
    write_checkpoint(checkpoint_path(config.get_checkpoint_dir(), 0), state)
    path = config.get_base_dir() / "config.yml"
    path.write_text(yaml.dump(config))
    return path


def fill_with_ball(run, solid=None) -> None:
    """Put the ball, or what is ``solid`` at points in metres, in the place of the model's densities and spectra."""
    model = run.model
    centre = torch.from_numpy(run.to_scene(factory.SPHERE_CENTRE_M)).float().to(model.device)
    radius = factory.SPHERE_RADIUS_M * run.scale
    spectrum = torch.from_numpy(factory.PLANT).float().to(model.device)

    def density(positions, times=None):
        if solid is not None:
            return DENSITY * solid(torch.from_numpy(run.to_metres(positions.numpy(force=True))).float())[..., None]
        return DENSITY * ((positions - centre).norm(dim=-1, keepdim=True) < radius)

    def field(samples, compute_normals=False):
        densities = density(samples.frustums.get_positions())
        return {FieldHeadNames.DENSITY: densities, FieldHeadNames.RGB: spectrum.expand(*densities.shape[:-1], -1)}

    def density_and_features(samples):
        return density(samples.frustums.get_positions()), None

    model.field.forward, model.field.density_fn, model.field.get_density = field, density, density_and_features
    model.occupancy.refresh_all(density)


def write_material_cloud(path: Path, material, relative_std=0.05) -> Path:
    """A cloud by `hsi-sc-nerf material`: points all over the ball, of that material in half the light at the top."""
    directions = np.random.default_rng(0).normal(size=(30_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    count = len(directions)
    irradiance = np.where(directions[:, 2] > 0.0, 0.5, 1.0)
    spectra = np.broadcast_to(material, (count, factory.BANDS))
    names = [*band_property_names(factory.WAVELENGTHS_NM, "material"), *LIGHT_COLUMNS]
    columns = [*spectra.T, irradiance, relative_std * irradiance]
    cloud = SpectralCloud(
        points=factory.SPHERE_CENTRE_M + factory.SPHERE_RADIUS_M * directions,
        normals=directions,
        colours=np.zeros((count, 3), np.uint8),
        spectra=spectra * irradiance[:, None],
        wavelengths_nm=factory.WAVELENGTHS_NM,
        extra=dict(zip(names, columns, strict=True)),
    )
    write_spectral_ply(path, cloud)
    return path
