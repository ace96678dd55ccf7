"""Configuration of the spectral model."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from nerfstudio.models.nerfacto import NerfactoModelConfig

from hsi_sc_nerf import paper
from hsi_sc_nerf.models.from_dataset import BackgroundKind
from hsi_sc_nerf.models.pose_refinement import PoseRefinementConfig


def _model() -> type:
    # The model's module imports this one.
    from hsi_sc_nerf.models.spectral_model import SpectralModel

    return SpectralModel


@dataclass
class SpectralModelConfig(NerfactoModelConfig):
    """Configuration of the spectral model. Where a default differs from nerfacto's, a turntable scene is why."""

    _target: type = field(default_factory=_model)
    head: Literal["direct", "basis"] = "basis"
    """What a sample of the field emits. direct: the reflectance in every band. basis: a few coefficients, which a
    basis of spectra found in the training pixels turns into all bands, once a pixel."""
    basis_rank: int | None = None
    """Coefficients of the basis head. None: as many as stand out of the noise of the training pixels."""
    learn_basis: bool = False
    """Let training improve the basis, which gained nothing on the sessions tried."""
    background: BackgroundKind = "image"
    """What is seen where the object lets light through. spectrum: the chamber's median spectrum. image: a picture of
    the chamber that stands still with the camera, taken from the frames. learned-image: the same, improved in the
    first stage. last-sample: nothing but what the ray met last, as nerfacto does."""
    hsi_loss: Literal["squared", "charbonnier"] = "squared"
    """How errors of reflectance count: their squares (the paper), or linearly where they are large."""
    angular_loss: Literal["cosine", "angle"] = "angle"
    """How spectral angles count: one minus their cosine (the paper), which hardly pulls at small angles, or the
    angles themselves, in radians, which want a weight some ten times smaller."""
    weigh_bands: bool = False
    """Let bands count by how well they were measured."""
    angular_loss_mult: float = 0.03
    """Weight of the spectral angle's loss."""
    hsi_loss_mult: float = paper.HSI_LOSS_WEIGHT
    """Weight of the reflectance errors over pixels and bands."""
    interlevel_loss_mult: float = paper.INTERLEVEL_LOSS_WEIGHT
    """Weight of the proposal loss."""
    distortion_loss_mult: float = 0.02
    """Weight of the distortion loss, which draws what a ray meets together. nerfacto's 0.002 leaves a shell whose
    opacity rises over 4 mm where the surface is (docs/accuracy_and_time.md); with 0.2 nothing comes into being."""
    orientation_loss_mult: float = paper.ORIENTATION_LOSS_WEIGHT
    """Weight of the orientation loss on computed normals."""
    pred_normal_loss_mult: float = paper.PREDICTED_NORMAL_LOSS_WEIGHT
    """Weight of the predicted-normal loss."""
    view_dependent: bool = True
    """Let a point's spectrum depend on the direction from which it is seen: it holds gloss, and the shading of lamps
    that stand still while the object turns."""
    predict_normals: bool = False
    """Predict normals, as the paper does. A step takes half again as long, and the cloud's normals are those of
    the density in any case."""
    near_plane: float = 0.01
    """Rays start no nearer to the camera than this (scene units)."""
    disable_scene_contraction: bool = True
    """The scene is the box that holds everything that turns: nothing lies outside it to contract. False: a scene
    without bounds, whose rays end at the far plane; it goes with the data parser's --scene cameras."""
    proposal_initial_sampler: Literal["piecewise", "uniform"] = "uniform"
    """Rays are sampled between where they enter and leave the box."""
    num_proposal_samples_per_ray: tuple[int, ...] = (48, 24)
    """Samples a ray for each proposal network: a box of 0.2 m needs far fewer than an unbounded scene, and the steps
    that a third fewer save bring more than the samples (docs/accuracy_and_time.md)."""
    num_nerf_samples_per_ray: int = 24
    """Samples a ray for the spectral field."""
    proposal_net_args_list: list[dict] = field(
        default_factory=lambda: [
            {"hidden_dim": 16, "log2_hashmap_size": 15, "num_levels": 5, "max_res": max_res, "use_linear": False}
            for max_res in (64, 128)
        ]
    )
    """The proposal networks: a scene of 0.2 m fits into smaller tables than nerfacto's."""
    match_resolution: bool = True
    """Size the spectral field's hash grid by what a pixel of the camera resolves in the scene box. False: take
    num-levels, max-res and log2-hashmap-size."""
    average_init_density: float = 0.1
    """The box starts nearly empty."""
    use_appearance_embedding: bool = False
    """Reflectance is calibrated and the lamps stand still: views need no appearance of their own."""
    implementation: Literal["tcnn", "torch"] = "torch"
    """"torch" trains and loads everywhere, with or without a GPU."""
    eval_num_rays_per_chunk: int = 4096
    """Rays rendered at a time."""
    density_groups: int = 1
    """Groups of neighbouring bands that have a density of their own, for translucent objects whose light passes at
    some wavelengths only (direct head). 1: one density for all."""
    camera_optimizer: PoseRefinementConfig = field(default_factory=PoseRefinementConfig)
    """Refinement of the measured poses."""

    def __post_init__(self) -> None:
        if self.density_groups < 1:
            raise SystemExit(
                f"hsi-sc-nerf: --pipeline.model.density-groups is {self.density_groups}; take 1 at least."
            )
        if self.head == "basis" and (self.background == "last-sample" or self.density_groups > 1):
            raise SystemExit(
                "hsi-sc-nerf: --pipeline.model.head basis goes neither with the background last-sample nor with "
                "density groups, which need a value in every band at each sample; take --pipeline.model.head direct."
            )
