"""Effects found in sessions, and what modelling them or leaving them out costs.

    uv run python benchmarks/effects.py --output-dir /tmp/effects
    uv run python benchmarks/effects.py --output-dir /tmp/effects --parts decisions

Decisions: sessions with each effect, from clear to below the noise, and without it. Models: scenes that have one
effect of the model, or for none, trained with what is decided, with everything, and without the effect; held-out
views are compared with noise-free ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from accuracy_and_time import step_seconds
from paper_tables import PaperTable, judged_once, mean_and_deviation, rendered_views
from results_table import write_results
from scipy.spatial.transform import Rotation

from hsi_sc_nerf.benchmark.configurations import own_configuration
from hsi_sc_nerf.evaluation.spectral_metrics import spectral_metrics
from hsi_sc_nerf.files import read_json, write_json
from hsi_sc_nerf.findings import EffectEvidence
from hsi_sc_nerf.geometry.camera import rotation_about_z
from hsi_sc_nerf.models.chosen_effects import MODEL_EFFECTS, chosen_effects, effects_setting
from hsi_sc_nerf.models.trained_run import open_trained_run
from hsi_sc_nerf.packed.dataset import open_packed
from hsi_sc_nerf.poses.pose_methods import find_poses
from hsi_sc_nerf.poses.result import TurntablePoses
from hsi_sc_nerf.simulate.truth import load_truth

NOISE = ("photon_noise", "read_noise")


@dataclass(frozen=True)
class Case:
    """A session: what it has beside noise, and what is known to be so."""

    name: str
    effects: tuple[str, ...] = ()
    present: tuple[str, ...] = ()
    """Effects that are clearly there."""
    weak: tuple[str, ...] = ()
    """Effects that may be decided either way."""
    scene: str = "pear"
    pose_error_deg: float = 0.0
    """The poses are disturbed by this much and state it."""


CASES = (
    Case("nothing but noise"),
    Case("lamp, 40 % of the light", ("lamp",), ("view_dependence", "uneven_light")),
    Case("wooden boards", ("textured_background",), ("still_chamber",)),
    Case("poses wrong by 0.6 degrees", (), ("pose_refinement",), pose_error_deg=0.6),
    Case("lamp, 3 %", ("{lamp: {fraction: 0.03}}",), weak=("view_dependence", "uneven_light")),
    Case("lamp, 0.3 %", ("{lamp: {fraction: 0.003}}",)),
    Case("lamp and gloss", ("lamp", "gloss"), ("view_dependence", "uneven_light")),
    Case("gloss in an even chamber", ("gloss",), weak=("view_dependence", "uneven_light")),
    Case("wooden boards, a fifth of the contrast", ("{textured_background: {contrast: 0.2}}",), ("still_chamber",)),
    Case("wooden boards, 1 % of the contrast", ("{textured_background: {contrast: 0.01}}",), weak=("still_chamber",)),
    Case("shade of the chamber", ("chamber_shading",), ("uneven_light",)),
    Case("lamps drift by 5 %", ("lamp_drift",), ("lamp_drift",)),
    Case("lamps drift by 0.02 %", ("{lamp_drift: {percent: -0.02}}",)),
    Case("lens, k1 -0.1", ("{lens_distortion: {k1: -0.1}}",), ("lens_distortion",)),
    Case("lens, k1 -0.0005", ("{lens_distortion: {k1: -0.0005}}",)),
    Case("table wobbles by 0.3 degrees", ("wobble",), ("wobble",)),
    Case("table wobbles by 0.001 degrees", ("{wobble: {amplitude_deg: 0.001}}",)),
    Case(
        "highlights beyond the detector's range",
        (
            "{lamp: {fraction: 0.8}}",
            "{gloss: {roughness: 0.05}}",
            "{saturation: {exposure_factor: 1.25}}",
            "{tarp_exposure: {exposure_factor: 0.5}}",
        ),
        ("view_dependence", "uneven_light", "saturated_highlights"),
    ),
    Case("poses wrong by 0.05 degrees", pose_error_deg=0.05),
    Case("nothing but noise, apple", scene="apple"),
    Case("tomato, its own gloss", weak=("view_dependence", "uneven_light"), scene="tomato"),
)
TRAINED = {
    "nothing but noise": (),
    "lamp, 40 % of the light": ("view_dependence",),
    "wooden boards": ("still_chamber",),
    "poses wrong by 0.6 degrees": ("pose_refinement",),
    "gloss in an even chamber": ("view_dependence",),
}
"""Cases that models are trained on, and effects that are left out in turn, or added where they are not chosen."""
DECISIONS = ("effect", "session", "simulated", "evidence", "noise", "threshold", "unit", "decided", "right")
MODELS = ("session", "model", "effects", "SAM, rad", "RMSE", "RMSE beside the object", "a step", "a step, ms")


@dataclass(frozen=True)
class Effects(PaperTable):
    """Simulate, process, train and judge what is missing; print and write the tables."""

    common: str = "--pipeline.datamanager.train-num-rays-per-batch 1024"
    """Words that every run gets, as in `hsi-sc-nerf benchmark`."""
    iterations: int | None = 400
    """Steps of each run."""
    threads: int | None = 1
    """CPU threads."""
    frames: int = 24
    """Frames of a session."""
    size: int = 96
    """Width and height of the images, pixels."""
    bands: int = 24
    """Spectral bands."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the networks and of the drawn pixels, a run each."""
    parts: tuple[Literal["decisions", "models"], ...] = ("decisions", "models")
    """Which tables to make."""
    only: str = ""
    """Sessions whose names contain this."""

    def main(self) -> None:
        """Make the tables."""
        for case in CASES:
            if self.only not in case.name:
                continue
            if "decisions" in self.parts:
                rows = decision_rows(case, open_packed(self.processed(case)).effects)
                write_results("effects", DECISIONS, rows, keys=2, folder=self.results)
            if "models" in self.parts and case.name in TRAINED:
                seeds = f"scene, runs {' '.join(map(str, self.seeds))}"
                rows = self.model_rows(case)
                write_results("effects_of_models", MODELS, rows, keys=2, seed=seeds, folder=self.results)

    def processed(self, case: Case) -> Path:
        """Dataset of a case."""
        session = self.output_dir / case.name.replace(",", "").replace("%", "percent").replace(" ", "-")
        poses = partial(disturbed_poses, case.pose_error_deg) if case.pose_error_deg else find_poses
        return self.simulated(case.scene, session, (*NOISE, *case.effects), poses)

    def model_rows(self, case: Case) -> list[list[str]]:
        """A row for each model that is trained on a case: as decided, all effects, and each one changed."""
        data = self.processed(case)
        auto = chosen_effects("auto", open_packed(data))
        models = {"all effects": MODEL_EFFECTS, "as decided": auto}
        for effect in TRAINED[case.name]:
            if effect in auto:
                models[f"without {effect}"] = tuple(name for name in auto if name != effect)
            else:
                models[f"with {effect}"] = tuple(name for name in MODEL_EFFECTS if name in (*auto, effect))
        settings = {title: effects_setting(effects) for title, effects in models.items()}
        seconds = self.step_seconds(data, settings)
        rows = []
        for title, setting in settings.items():
            found = [self.judged(setting, data, seed) for seed in self.seeds]
            scores = (mean_and_deviation([one[name] for one in found], 4) for name in ("sam", "rmse", "beside"))
            step = (f"{seconds[title] / seconds['all effects']:.2f}", f"{1000.0 * seconds[title]:.0f}")
            rows.append([case.name, title, setting.replace(",", ", "), *scores, *step])
        return rows

    def step_seconds(self, data: Path, settings: Mapping[str, str]) -> dict[str, float]:
        """Processor seconds of a step of each model, measured in turns; what was measured before is not again."""
        kept = data.with_name(f"{data.name}-step-seconds.json")
        if not kept.is_file():
            runs = {name: (data, f"--pipeline.model.effects {setting}") for name, setting in settings.items()}
            write_json(kept, step_seconds(runs, self.common))
        return read_json(kept, "delete it to measure again")

    def judged(self, setting: str, data: Path, seed: int) -> dict[str, float]:
        """Scores of one run against noise-free and measured views, and its processor time."""
        name = setting.replace(",", "-").replace("_", "-")
        runs = data.with_name(f"{data.name}-runs-{seed}")
        (run,) = self.trained([own_configuration(f"{name}=--pipeline.model.effects {setting}")], data, runs, seed)
        session = data.with_name(data.name.removesuffix("-data"))
        return judged_once(runs, run, partial(against_truth, session))


def disturbed_poses(error_deg: float, *arguments: Any, **options: Any) -> TurntablePoses:
    """Poses from markers whose angles and camera are turned at random; they state by how much."""
    poses, rng = find_poses(*arguments, **options), np.random.default_rng(0)
    sigma_deg = error_deg / np.sqrt(3.0)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec(sigma_deg * rng.normal(size=3), degrees=True).as_matrix()
    # The camera turns about the object's middle, which stays in the middle of the picture.
    middle = np.array([0.0, 0.0, 0.12])
    turn[:3, 3] = middle - turn[:3, :3] @ middle
    angles = [rotation_about_z(sigma_deg * rng.normal()) for _ in poses.names]
    wrong = np.stack([angle @ pose for angle, pose in zip(angles, poses.camera_to_world, strict=True)])
    # In the chamber's frame the camera's turn is the same in all frames.
    turns = [rotation_about_z(-a) @ turn @ rotation_about_z(a) for a in poses.angles_deg]
    stated = None if poses.uncertainty is None else replace(poses.uncertainty, rotation_deg=error_deg)
    return replace(poses, camera_to_world=np.stack(turns) @ wrong, uncertainty=stated)


def against_truth(session: Path, config: Path) -> dict[str, float]:
    """Held-out views against the noise-free light, means over views: on the object, and RMSE beside it."""
    truth = load_truth(session)
    found: list[dict[str, float]] = []
    for capture, rendered, batch in rendered_views(open_trained_run(config)):
        light = torch.from_numpy(truth.light(capture).radiance()).to(rendered)
        mask = batch["mask"][..., 0].bool()
        metrics = spectral_metrics(rendered, light, mask)
        beside = (rendered - light)[~mask].square().mean().sqrt()
        found.append({"sam": metrics["sam"], "rmse": metrics["rmse"], "beside": float(beside)})
    return {name: float(np.mean([view[name] for view in found])) for name in found[0]}


def decision_rows(case: Case, effects: Sequence[EffectEvidence]) -> list[list[str]]:
    """A row for each effect of a session."""
    rows = []
    for effect in effects:
        if effect.name == "spectral_rank":
            continue
        simulated = "clear" if effect.name in case.present else "weak" if effect.name in case.weak else "no"
        right = "-" if simulated == "weak" else "yes" if effect.present == (simulated == "clear") else "no"
        numbers = ("-" if v is None else f"{v:.3g}" for v in (effect.evidence, effect.noise, effect.threshold))
        decided = "yes" if effect.present else "no"
        rows.append([effect.name, case.name, simulated, *numbers, effect.unit, decided, right])
    return rows


if __name__ == "__main__":
    tyro.cli(Effects).main()
