"""Sections on the run (training curves, settings, versions) and on its results (`hsi-sc-nerf compare`, `traits`)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from hsi_sc_nerf.analysis.report import MM_PER_M, each_object, trait_tables
from hsi_sc_nerf.evaluation.comparison_report import comparison_tables
from hsi_sc_nerf.files import content_of
from hsi_sc_nerf.findings import Finding, judged
from hsi_sc_nerf.report.charts import Curve, line_chart
from hsi_sc_nerf.report.page import Block, Figure, Folded, Missing, Section, Table, embedded_file

_LOSSES, _RATES = "Train Loss Dict/", "learning_rate/"
_CORRECTIONS = {
    "Train Metrics Dict/camera_opt_rotation_deg": "rotation of the camera",
    "Train Metrics Dict/camera_opt_angle_max_deg": "largest of the table's angles",
}
# Terms of the loss that never reach this fraction of the largest are not drawn.
_SMALLEST_FRACTION = 1e-5
_PSNR = {
    "Train Metrics Dict/psnr": "training rays",
    "Eval Images Metrics Dict (all images)/psnr": "all held-out views",
    "Eval Images Metrics/psnr": "one held-out view",
}
Scalars = dict[str, tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]]
"""Steps and values by TensorBoard's tag."""
_CHECKPOINT = re.compile(r"step-(\d+)\.ckpt")
MOST_POINTS = 400
"""Longer curves are averaged to this many points."""
_PSNR_RISE_DB = 0.5
_CURVES = {"precision": "precision", "recall": "recall", "f_score": "F-score"}
_F_SCORE_MISSING_PERCENT = (10.0, 30.0)
_UNSEEN_FRACTION = 0.15
_DRAWN_THRESHOLDS = 2.0
"""Curves end at this many times the largest threshold of interest."""


def training_section(scalars: Scalars, stage_ends: Mapping[str, int]) -> Section:
    """Curves of the logged scalars, with the ends of the stages.

    Args:
        scalars: `read_scalars` of the run.
        stage_ends: steps done at the end of each stage, by name.
    """
    if not scalars:
        missing = Missing("The run has no TensorBoard events.", "ns-train hsi-sc-nerf --vis viewer+tensorboard")
        return Section("training", "Training", [missing])
    marks = {f"end of {name}": float(end) for name, end in stage_ends.items()}

    def named(prefix: str) -> dict[str, str]:
        return {tag: tag.removeprefix(prefix).replace("_", " ") for tag in scalars if tag.startswith(prefix)}

    charts = {}
    for title, y_label, tags, logarithmic in (
        ("Loss of training batches", "weighted loss", {"Train Loss": "sum"} | named(_LOSSES), True),
        ("Peak signal-to-noise ratio", "PSNR (dB)", _PSNR, False),
        ("Learning rates", "learning rate", named(_RATES), True),
        ("Corrections of the poses", "correction (degrees)", _CORRECTIONS, False),
    ):
        curves = _curves(scalars, tags)
        if curves:
            charts[title] = line_chart(
                curves,
                x_label="step",
                y_label=y_label,
                alt=f"{title} over the training steps",
                logarithmic=logarithmic,
                marks=marks,
            )
    caption = (
        "Terms of the loss are weighted and have no unit; those that stay tiny are left out. In the masked stage "
        "most training rays are the object's: its loss and PSNR do not compare with those of whole frames."
    )
    steps, psnr_db = scalars.get("Train Metrics Dict/psnr", (np.zeros(0), np.zeros(0)))
    last_stage_from = ([0.0, 0.0, *marks.values()])[-2] if marks else 0.0
    findings = judge_training(psnr_db[(steps >= last_stage_from) & np.isfinite(psnr_db)])
    return Section("training", "Training", [Figure(charts, caption, columns=2)], findings)


def judge_training(psnr_db: Float[np.ndarray, "n"]) -> list[Finding]:
    """Whether the PSNR of training rays in the last stage still rose at its end; nothing of a short log."""
    if len(psnr_db) < 8:
        return []
    before, end = np.array_split(psnr_db[len(psnr_db) // 2 :], 2)
    rise_db = float(np.mean(end) - np.mean(before))
    sentence = (
        f"The PSNR of training rays changed by {rise_db:+.2f} dB in the last quarter of the last stage (converged up "
        f"to {_PSNR_RISE_DB:+g} dB)"
    )
    return [judged("convergence", rise_db, (_PSNR_RISE_DB, np.inf), sentence, "train longer")]


def _curves(scalars: Scalars, tags: Mapping[str, str]) -> list[Curve]:
    """Curves of the logged tags, without those that are tiny beside the largest."""
    found = {name: scalars[tag] for tag, name in tags.items() if tag in scalars}
    heights = {name: np.abs(values[np.isfinite(values)]).max(initial=0.0) for name, (_, values) in found.items()}
    least = _SMALLEST_FRACTION * max(heights.values(), default=0.0)
    return [Curve(name, *shortened(*curve)) for name, curve in found.items() if heights[name] > least]


def flat_settings(config: Any, prefix: str = "") -> dict[str, str]:
    """Settings of nested dataclasses and mappings as text, by their dotted names; of whole paths the last name."""
    if is_dataclass(config) and not isinstance(config, type):
        parts = {f.name: getattr(config, f.name) for f in fields(config) if f.name != "_target"}
    elif isinstance(config, Mapping) and config:
        parts = {str(key): value for key, value in config.items()}
    elif isinstance(config, Path) and config.is_absolute():
        return {prefix: config.name}
    else:
        return {prefix: str(config)}
    flat: dict[str, str] = {}
    for name, value in parts.items():
        flat |= flat_settings(value, f"{prefix}.{name}" if prefix else name)
    return flat


def settings_section(settings: Mapping[str, str], defaults: Mapping[str, str], machine: Mapping[str, str]) -> Section:
    """Settings of the run, machine and package versions.

    Args:
        settings: settings of the run (`flat_settings`).
        defaults: defaults of its method.
        machine: facts of the machine that makes the report, and versions of its packages.
    """
    changed = [
        (name, value, defaults.get(name, "-")) for name, value in settings.items() if defaults.get(name) != value
    ]
    first: Block = "All settings are the method's defaults."
    if changed:
        first = Table("Settings that are not the method's defaults.", ("", "this run", "default"), changed)
    everything = Table("All settings of the run.", ("", "value"), list(settings.items()))
    caption = "Machine and packages that made this report; the run itself does not record its own."
    return Section(
        "settings",
        "Versions and settings",
        [first, Folded("All settings", [everything]), Table(caption, ("", ""), list(machine.items()))],
    )


def read_scalars(run: Path) -> Scalars:
    """All logged scalars by tag; empty without events. A resumed run has one value a step."""
    if not any(run.glob("events.out.tfevents.*")):
        return {}
    from tensorboard.backend.event_processing.event_accumulator import SCALARS, EventAccumulator

    events = EventAccumulator(str(run), size_guidance={SCALARS: 0})
    events.Reload()
    scalars = {}
    for tag in events.Tags()[SCALARS]:
        last = {event.step: event.value for event in events.Scalars(tag)}
        steps = np.array(sorted(last), dtype=float)
        scalars[tag] = steps, np.array([last[int(step)] for step in steps], dtype=float)
    return scalars


def shortened(
    steps: Float[np.ndarray, "n"], values: Float[np.ndarray, "n"], most: int = MOST_POINTS
) -> tuple[Float[np.ndarray, "m"], Float[np.ndarray, "m"]]:
    """The curve averaged to at most ``most`` points."""
    if len(steps) <= most:
        return steps, values
    starts = np.arange(most) * len(steps) // most
    lengths = np.diff(np.append(starts, len(steps)))
    return np.add.reduceat(steps, starts) / lengths, np.add.reduceat(values, starts) / lengths


def stage_ends(run: Path) -> dict[str, int]:
    """Steps done at the end of each finished stage, by its name, in order."""
    ends = {}
    for folder in run.glob("stage-*"):
        steps = [int(match[1]) for path in folder.iterdir() if (match := _CHECKPOINT.fullmatch(path.name))]
        if steps:
            ends[folder.name.removeprefix("stage-")] = max(steps) + 1
    return dict(sorted(ends.items(), key=lambda item: item[1]))


def comparison_section(comparison: Mapping[str, Any] | None, source: Path) -> Section:
    """Precision, recall and F-score over the distance threshold (paper, section "Spatial Evaluation Metrics").

    Args:
        comparison: content of ``comparison.json``; None if there is none.
        source: that file. The picture ``distances.png`` beside it is shown as well.

    Raises:
        InputError: the file lacks what it should hold.
    """
    title, blocks = "Precision and recall", list[Block]()
    if comparison is None:
        command = "hsi-sc-nerf compare CLOUD.ply REFERENCE --output-dir RUN"
        return Section("comparison", title, [Missing("The geometry was not compared with a reference.", command)])
    with content_of(source, "comparison", "make one with `hsi-sc-nerf compare`"):
        blocks += _comparison_blocks(comparison)
        findings = judge_comparison(comparison)
    picture = source.with_name("distances.png")
    if picture.is_file():
        alt = "The cloud and the reference, coloured by the distance to the other"
        blocks.append(Folded("Where the distances are", [Figure({"": embedded_file(picture, alt)}, f"{alt}.")]))
    return Section("comparison", title, blocks, findings)


def judge_comparison(comparison: Mapping[str, Any]) -> list[Finding]:
    """The F-score at the chosen threshold."""
    score = comparison["scores"]["chosen"]
    missing_percent = 100.0 - float(score["f_score"])
    sentence = (
        f"The F-score at {1000.0 * float(score['threshold_m']):.1f} mm is {100.0 - missing_percent:.1f} % (good from "
        f"{100.0 - _F_SCORE_MISSING_PERCENT[0]:g} %)"
    )
    lower = "precision" if score["precision"] < score["recall"] else "recall"
    return [
        judged("f-score", missing_percent, _F_SCORE_MISSING_PERCENT, sentence, f"{lower} is the lower of the two")
    ]


def comparison_key_figure(comparison: Mapping[str, Any]) -> dict[str, str]:
    """The F-score at the chosen threshold, for the head of the page."""
    score = comparison["scores"]["chosen"]
    return {f"F-score at {MM_PER_M * score['threshold_m']:.1f} mm": f"{score['f_score']:.1f} %"}


def _comparison_blocks(comparison: Mapping[str, Any]) -> list[Block]:
    found, scores = comparison["curves"], comparison["scores"]
    thresholds_mm = MM_PER_M * np.array(found["thresholds_m"], float)
    marks_mm = {key: MM_PER_M * float(scores[key]["threshold_m"]) for key in ("chosen", "knee")}
    drawn = thresholds_mm <= _DRAWN_THRESHOLDS * max(marks_mm.values())
    curves = [
        Curve(name, thresholds_mm[drawn], np.array(found[key], float).reshape(len(thresholds_mm))[drawn])
        for key, name in _CURVES.items()
    ]
    chart = line_chart(
        curves,
        x_label="distance threshold (mm)",
        y_label="per cent",
        alt="Precision, recall and F-score over the distance threshold",
        from_zero=True,
        marks={f"{key} {at:.2f} mm": at for key, at in marks_mm.items()},
    )
    scored, distances = comparison_tables(comparison)
    caption = "Precision: fraction of the cloud within the threshold of the reference. Recall: the converse."
    return [
        Table(caption, *scored),
        Figure({"": chart}, "Precision, recall and F-score over the distance threshold, per cent."),
        Table("Distances, mm.", *distances),
    ]


def traits_section(traits: Mapping[str, Any] | None, source: Path) -> Section:
    """The object's traits, in the tables of ``traits.md``.

    Args:
        traits: content of ``traits.json``; None if there is none.
        source: that file, for the error's text.

    Raises:
        InputError: the file holds no traits.
    """
    if traits is None:
        command = "hsi-sc-nerf traits CLOUD.ply --output-dir RUN"
        return Section("traits", "Traits", [Missing("The object's traits were not measured.", command)])
    with content_of(source, "traits", "make them again with `hsi-sc-nerf traits`"):
        blocks, findings = list[Block](), list[Finding]()
        for one in each_object(traits):
            which = f"Piece {one['piece']}. " if "piece" in one else ""
            tables = trait_tables(one)
            blocks += [Table(f"{which}{table.heading}. {table.note}", table.header, table.rows) for table in tables]
            findings += judge_traits(one, which)
    return Section("traits", "Traits", blocks, findings)


def judge_traits(traits: Mapping[str, Any], which: str = "") -> list[Finding]:
    """Whether the mesh encloses a volume, and how much of it was not seen; ``which`` of several objects it is."""
    if not traits["watertight"]:
        sentence = f"{which}The mesh has holes, so its volume cannot be trusted; mesh it anew."
        return [Finding("watertight", "red", sentence)]
    fraction = 1.0 - traits["seen_area_m2"] / traits["size"]["area_m2"]
    sentence = (
        f"{which}The mesh is closed; {100.0 * fraction:.1f} % of its area was not seen (good up to "
        f"{100.0 * _UNSEEN_FRACTION:.0f} %)"
    )
    advice = "give the container's height (--data), and see which side was not seen"
    return [judged("closed-area", fraction, (_UNSEEN_FRACTION, np.inf), sentence, advice)]
