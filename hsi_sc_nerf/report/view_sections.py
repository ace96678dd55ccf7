"""Sections on held-out views: pictures, tables, curves by band, spectra with their uncertainty."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from string import ascii_uppercase

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from hsi_sc_nerf import paper
from hsi_sc_nerf.evaluation.chosen_views import spread_of_views
from hsi_sc_nerf.findings import Finding, judged
from hsi_sc_nerf.plotting import ANGLE_COLOURS, ANGLE_DRAWN_RAD, ERROR_DRAWN, coloured
from hsi_sc_nerf.report.charts import Curve, line_chart
from hsi_sc_nerf.report.held_out_views import (
    HeldOutView,
    PixelSpectra,
    ViewScores,
    object_angles,
    sample_mean_and_sd,
)
from hsi_sc_nerf.report.page import Block, Figure, Section, Table, embedded_array
from hsi_sc_nerf.spectra import to_8_bit

PICTURED_VIEWS = 4
_ERROR_COLOURS = "viridis"
_MARGIN = 0.12
_HISTOGRAM_BINS = 60
_PERCENTILE_DRAWN = 99.5
# The paper's table (section "Spectral Evaluation"), in its order and with its units, then other readings.
_METRICS = {
    "sam": ("SAM (rad)", "{:.4f}"),
    "rmse": ("RMSE", "{:.4f}"),
    "ssim": ("SSIM", "{:.3f}"),
    "psnr": ("PSNR (dB)", "{:.1f}"),
    "rmse_pixel_mean": ("RMSE, mean over pixels", "{:.4f}"),
    "ssim_windowed": ("SSIM, 11 px windows", "{:.3f}"),
}
_NO_SCORE = "no score"
"""Text in place of the score of a view without a measured pixel of the object."""
_MARK_RGB = (213, 94, 0)
_MARKED_PX = 480
# Half of the angle that tells two materials apart, and that angle.
_SAM_RAD = (paper.CLASSIFICATION_ANGLE_RAD / 2.0, paper.CLASSIFICATION_ANGLE_RAD)
# The paper prints 0.03 to 0.044 for real fruit.
_RMSE = (0.05, 0.1)
_SPECTRUM_ERROR = (0.05, 0.15)


def metric_key_figures(views: Sequence[ViewScores]) -> dict[str, str]:
    """The paper's four metrics of the object, for the head of the page."""
    return {_METRICS[metric][0]: _over_views(views, metric)[0] for metric in ("sam", "rmse", "ssim", "psnr")}


def _over_views(views: Sequence[ViewScores], metric: str) -> tuple[str, str]:
    """Mean with standard deviation, and range, of a metric of `ViewScores.metrics` over the views that have it."""
    _, pattern = _METRICS[metric.removeprefix("full_")]
    values = np.array([[view.metrics[metric]] for view in views if np.isfinite(view.metrics[metric])])
    if not len(values):
        return _NO_SCORE, _NO_SCORE
    mean, sd, low, high = (
        pattern.format(float(v[0])) for v in (*sample_mean_and_sd(values), values.min(0), values.max(0))
    )
    return f"{mean} ± {sd}", f"{low} to {high}"


def views_section(views: Sequence[HeldOutView], held_out: int, white: float) -> Section:
    """Measured and rendered views, and maps of their differences.

    Args:
        views: those that were rendered.
        held_out: how many were held out.
        white: reflectance in full brightness of the pictures (`white_of`).
    """
    header = ("", "object: mean ± SD", "object: range", "whole frame: mean ± SD", "whole frame: range")
    scores = [view.scores for view in views]
    rows = [
        (name, *_over_views(scores, key), *_over_views(scores, f"full_{key}")) for key, (name, _) in _METRICS.items()
    ]
    number = f"all {held_out}" if held_out == len(views) else f"{len(views)} of the {held_out}"
    blocks: list[Block] = [
        f"The model has not seen these views. Scores are of {number} held-out views.",
        Table("The paper's four metrics over the held-out views, and other readings of two.", header, rows),
        f"In the maps the spectral angle goes from {ANGLE_DRAWN_RAD[0]:g} (dark) to {ANGLE_DRAWN_RAD[1]:g} rad "
        f"(light), the error, root mean square over bands, from {ERROR_DRAWN[0]:g} (dark) to "
        f"{ERROR_DRAWN[1]:g} of reflectance (yellow); grey is what is not the object. All pseudo-RGB pictures have "
        f"one scale, at whose full brightness reflectance is {white:.2f}.",
    ]
    for index in spread_of_views(len(views), PICTURED_VIEWS):
        view = views[index]
        crop = crop_around(view.scores.mask)
        inside = torch.from_numpy(view.scores.mask[crop])
        pictures = {
            how: embedded_array(to_8_bit(rgb[crop] / white), f"{view.scores.name} as {how}, pseudo-RGB")
            for rgb, how in ((view.measured_rgb, "measured"), (view.rendered_rgb, "rendered"))
        }
        for title, values, drawn, colours in (
            ("spectral angle", view.scores.angle_rad, ANGLE_DRAWN_RAD, ANGLE_COLOURS),
            ("error", view.scores.error, ERROR_DRAWN, _ERROR_COLOURS),
        ):
            shown = torch.from_numpy(values[crop]).float().masked_fill(~inside, torch.nan)
            picture = to_8_bit(coloured(shown, drawn, colours).numpy())
            pictures[title] = embedded_array(picture, f"Map of the {title} of {view.scores.name}")
        sam, rmse = (view.scores.metrics[key] for key in ("sam", "rmse"))
        scored = f"RMSE {rmse:.4f}" if np.isfinite(rmse) else _NO_SCORE
        if np.isfinite(sam):
            scored = f"SAM {sam:.4f} rad, {scored}"
        blocks.append(Figure(pictures, f"{view.scores.name}: {scored}.", columns=4))
    return Section("views", "Held-out views", blocks, judge_views(scores))


def judge_views(views: Sequence[ViewScores]) -> list[Finding]:
    """The spectral angle of the held-out views that have one, without the noise of the measurement where known.

    Nothing where a single band was measured, which has no angle.
    """
    measured = [view for view in views if np.isfinite(view.metrics["rmse"])]
    views = [view for view in measured if np.isfinite(view.metrics["sam"])]
    if measured and not views:
        return []
    if not views:
        sentence = "No held-out view shows anything of the object that was measured; look at the masks."
        return [Finding("spectral-angle", "red", sentence)]
    angles = np.array([view.metrics["sam"] for view in views])
    beyond, words = float(angles.mean()), ""
    noise = float(np.mean([view.noise_angle_rad for view in views]))
    if np.isfinite(noise):
        beyond = float(_beyond_noise(angles.mean(), noise))
        words = f", {beyond:.3f} beyond the noise of the measurement"
    sentence = (
        f"The mean spectral angle is {angles.mean():.3f} rad{words} (good up to {_SAM_RAD[0]:g}; {_SAM_RAD[1]:g} is "
        f"another material); it is largest in {views[int(angles.argmax())].name}, {angles.max():.3f} rad"
    )
    advice = "look at the maps, the mask and the pose of that view"
    return [judged("spectral-angle", beyond, _SAM_RAD, sentence, advice)]


def white_of(views: Sequence[HeldOutView]) -> float:
    """Reflectance in full brightness of all pictures: that of the brightest per cent of the measured object."""
    values = np.concatenate([view.measured_rgb[view.scores.mask].ravel() for view in views])
    finite = values[np.isfinite(values)]
    return max(float(np.percentile(finite, 99.0)), 0.05) if len(finite) else 1.0


def crop_around(mask: Bool[np.ndarray, "h w"]) -> tuple[slice, slice]:
    """Lines and samples of the mask with a margin; everything where it is empty."""
    lines, samples = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(lines):
        return slice(None), slice(None)
    margin = round(_MARGIN * max(np.ptp(lines), np.ptp(samples))) + 1
    return tuple(slice(max(0, ends[0] - margin), ends[-1] + margin + 1) for ends in (lines, samples))  # type: ignore[return-value]


def bands_section(
    views: Sequence[ViewScores],
    wavelengths_nm: Float[np.ndarray, "bands"],
    typical_uncertainty: Float[np.ndarray, "bands"] | None,
) -> Section:
    """Curves by band of the object's error, PSNR and SSIM, and the histogram of the spectral angle."""
    caption = (
        "Root mean square error of the object's reflectance, peak signal-to-noise ratio for a peak of 1, and "
        "structural similarity with moments over all of the object's pixels."
    )
    charts, means = {}, {}
    for name, y_label in (("rmse", "RMSE of reflectance"), ("psnr_db", "PSNR (dB)"), ("ssim", "SSIM")):
        means[name], spread = sample_mean_and_sd(np.stack([getattr(view, name) for view in views]))
        curves = [Curve("mean ± SD over views", wavelengths_nm, means[name], spread)]
        if name == "rmse" and typical_uncertainty is not None:
            curves.append(Curve("noise of the measurement", wavelengths_nm, typical_uncertainty, dashed=True))
            caption += " Measured pixels have noise of their own (dashed), which no rendering can repeat."
        alt, from_zero = f"{y_label} by wavelength", name == "rmse"
        charts[y_label] = line_chart(curves, x_label="wavelength (nm)", y_label=y_label, alt=alt, from_zero=from_zero)
    angles = object_angles(views)
    if len(angles):
        middle, high, top = np.percentile(angles, (50.0, 95.0, _PERCENTILE_DRAWN))
        counts, edges = np.histogram(angles, _HISTOGRAM_BINS, (0.0, max(float(top), 1e-6)))
        charts["Spectral angle"] = line_chart(
            [Curve("", (edges[:-1] + edges[1:]) / 2.0, 100.0 * counts / len(angles))],
            x_label="spectral angle (rad)",
            y_label="fraction of pixels (%)",
            alt="Histogram of the spectral angle over the object's pixels",
            from_zero=True,
        )
        caption += (
            f" Spectral angle between measurement and rendering, {len(angles)} pixels of the object: mean "
            f"{angles.mean():.4f}, median {middle:.4f}, 95th percentile {high:.4f} rad. The largest "
            f"{100.0 - _PERCENTILE_DRAWN:g} % are not drawn."
        )
    figure = Figure(charts, caption, columns=2)
    findings = judge_bands(means["rmse"], wavelengths_nm, typical_uncertainty)
    return Section("bands", "Accuracy by band and pixel", [figure], findings)


def judge_bands(
    rmse: Float[np.ndarray, "bands"],
    wavelengths_nm: Float[np.ndarray, "bands"],
    noise: Float[np.ndarray, "bands"] | None = None,
) -> list[Finding]:
    """The band with the largest error, without the noise of the measurement where that is known, if there is any."""
    if np.isnan(rmse).all():
        return []
    beyond = rmse if noise is None else _beyond_noise(rmse, noise)
    worst = int(np.nanargmax(beyond))
    sentence = (
        f"The RMSE of reflectance is {np.nanmean(rmse):.3f}, and in no band above {beyond[worst]:.3f}"
        f"{'' if noise is None else ' beyond the noise of the measurement'}, at {wavelengths_nm[worst]:.0f} nm (good "
        f"up to {_RMSE[0]:g})"
    )
    return [judged("rmse", float(beyond[worst]), _RMSE, sentence, "train longer, or look at the maps of the error")]


def _beyond_noise(error: np.ndarray, noise: np.ndarray | float) -> np.ndarray:
    """What is left of root mean square errors without the noise in them; 0 where that is all."""
    return np.sqrt(np.maximum(error**2 - noise**2, 0.0))


def spectra_section(view: HeldOutView, wavelengths_nm: Float[np.ndarray, "bands"], white: float) -> Section:
    """Measured and rendered spectra around some points of one view, with how much they vary there.

    ``white`` is the reflectance in full brightness of the picture.
    """
    picture = embedded_array(_marked(view, white), f"{view.scores.name} with the points marked")
    points, charts = dict(zip(ascii_uppercase, view.points, strict=False)), {}
    for letter, point in points.items():
        where = f"line {point.line}, sample {point.sample}"
        charts[f"{letter}: {where}, {point.pixels} pixels"] = line_chart(
            [
                Curve("measured, mean ± SD", wavelengths_nm, point.measured, point.measured_sd),
                Curve("rendered", wavelengths_nm, point.rendered, dashed=True),
            ],
            x_label="wavelength (nm)",
            y_label="reflectance",
            alt=f"Measured and rendered spectrum at {where}",
            from_zero=True,
        )
    caption = (
        "Reflectance over wavelength. Solid with a band: measured, mean and standard deviation over the pixels "
        "around the point, that is noise and texture together. Dashed: rendered, mean over the same pixels."
    )
    marked = Figure({"": picture}, f"Points in {view.scores.name}, as measured.")
    blocks = [marked, Figure(charts, caption, columns=2)]
    return Section("spectra", "Spectra", blocks, judge_spectra(points))


def judge_spectra(points: Mapping[str, PixelSpectra]) -> list[Finding]:
    """How far rendered mean spectra are from the measured ones, by the points' letters.

    A point around which no band was measured does not count.
    """
    errors = {
        letter: float(np.nansum(np.abs(one.rendered - one.measured)) / np.nansum(one.measured))
        for letter, one in points.items()
        if np.nansum(one.measured) > 0.0
    }
    if not errors:
        return []
    worst = max(errors, key=lambda letter: errors[letter])
    sentence = (
        f"Rendered spectra differ from the measured means by {100.0 * np.mean(list(errors.values())):.1f} % of "
        f"reflectance, most at {worst}, {100.0 * errors[worst]:.1f} % (good up to {100.0 * _SPECTRUM_ERROR[0]:.0f} %)"
    )
    return [judged("spectra", errors[worst], _SPECTRUM_ERROR, sentence, "compare its curve with the noise around it")]


def _marked(view: HeldOutView, white: float) -> UInt8[np.ndarray, "h w 3"]:
    """The measured picture round the object, enlarged, with a lettered ring at each point."""
    lines, samples = crop_around(view.scores.mask)
    crop = to_8_bit(np.ascontiguousarray(view.measured_rgb[lines, samples]) / white)
    scale = max(1, round(_MARKED_PX / crop.shape[0]))
    image = cv2.resize(crop, None, fx=scale, fy=scale, interpolation=cv2.INTER_NEAREST)
    first_line, first_sample = lines.start or 0, samples.start or 0
    for letter, point in zip(ascii_uppercase, view.points, strict=False):
        x, y = (int((at + 0.5) * scale) for at in (point.sample - first_sample, point.line - first_line))
        radius = max(6, round(scale * np.sqrt(point.pixels / np.pi)))
        for colour, width in (((255, 255, 255), 4), (_MARK_RGB, 2)):
            cv2.circle(image, (x, y), radius, colour, width, cv2.LINE_AA)
            where = (x + radius + 3, y + 5)
            cv2.putText(image, letter, where, cv2.FONT_HERSHEY_SIMPLEX, 0.6, colour, width, cv2.LINE_AA)
    return image
