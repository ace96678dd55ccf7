"""The folder of a batch, with results as the commands write them but of numbers that are known."""

import csv
import json

import numpy as np

from hsi_sc_nerf.analysis.classes import ConnectedRegion
from hsi_sc_nerf.analysis.maps import SurfaceMap
from hsi_sc_nerf.analysis.report import trait_content
from hsi_sc_nerf.analysis.size import Size
from hsi_sc_nerf.analysis.traits import WHOLE, Classes, MapMean, MeanAndSd, RegionTraits, Traits
from hsi_sc_nerf.batch.plan import STEPS
from hsi_sc_nerf.files import write_json, write_png

FINDINGS = [
    {"name": "markers", "level": "green", "sentence": "Markers: in all frames.", "values": {}},
    {"name": "focus", "level": "amber", "sentence": "Frame 7 is blurred.", "values": {}},
]


def traits_of(volume_ml=250.0, ndvi=0.7, regions=("bruise",), watertight=True, calibrated=True):
    """Content of ``traits.json``; a quarter of 200 cm² is bruised by angle, a fifth by mixture."""
    spectrum = MeanAndSd(np.full(3, 0.4), np.zeros(3))
    maps = [
        SurfaceMap(name, unit, np.zeros(4), lambda spectra: spectra[:, 0], definition=definition)
        for name, definition, unit in (("NDVI", "NDVI = 1", ""), ("WI", "WI = 1", ""), ("Brix", "", "%"))
        if definition or calibrated
    ]
    means = {"NDVI": (ndvi, 0.05), "WI": (np.nan, np.nan), "Brix": (12.5, 0.4)}
    of_maps = {name: MapMean(MeanAndSd(*map(np.float64, values)), 0.01, 0.0) for name, values in means.items()}
    parts = [RegionTraits(name, 0.02, spectrum, of_maps, 0.01) for name in (WHOLE, *regions)]
    labels = np.zeros(4, int)
    classes = Classes(
        regions, labels, 0.1, np.full(len(regions), 0.005), 0.015, labels, np.full(len(regions), 0.004), 0.016,
        [ConnectedRegion(0, 0.005, (0.0, 0.0, 0.0))],
    )  # fmt: skip
    size = Size(0.023, volume_ml / 1000.0, 0.09, 0.07, 0.068, 0.078)
    sd = {"scale": Size(0.0001, 0.002, 0.0001, 0.0001, 0.0001, 0.0001)}
    return trait_content(size, sd, watertight, Traits(parts, classes if regions else None, maps), {})


def write_object(folder, traits=None, failed=None, sentence="", picture=True):
    """Results of one object; of one that ``failed`` at a step only those of the steps before it."""
    reached = STEPS[: STEPS.index(failed)] if failed else STEPS
    for number, step in enumerate(reached, start=1):
        cost = {"seconds": float(number), "peak_memory_mib": 100.0 * number}
        write_json(folder / "steps" / f"{step}.json", {"step": step, "status": "done", "sentence": ""} | cost)
    for step in STEPS[len(reached) :]:
        state = (
            {"status": "failed", "sentence": sentence} if step == failed else {"status": "skipped", "sentence": "No."}
        )
        write_json(folder / "steps" / f"{step}.json", {"step": step, "seconds": 0.0, "peak_memory_mib": 0.0} | state)
    write_json(folder / "inspection.json", {"findings": FINDINGS})
    if "process" in reached:
        write_json(folder / "data" / "report" / "inspection.json", {"findings": FINDINGS})
    if "process" in reached and picture:
        y, x = np.mgrid[-32:32, -32:32]
        ball = np.hypot(x, y) < 24
        (folder / "data" / "images").mkdir(parents=True)
        (folder / "data" / "masks").mkdir()
        write_png(folder / "data" / "images" / "f0.png", np.where(ball[..., None], (90, 40, 30), 5).astype(np.uint8))
        write_png(folder / "data" / "masks" / "f0.png", (255 * ball).astype(np.uint8))
    if "evaluate" in reached:
        results = {"sam": 0.03, "rmse": 0.02, "psnr": 34.0, "ssim": 0.95, "full_sam": 0.1}
        write_json(folder / "eval.json", {"results": results})
    if "traits" in reached:
        (folder / "traits").mkdir()
        (folder / "traits" / "traits.json").write_text(json.dumps(traits or traits_of()))
    if "report" in reached:
        (folder / "report.html").write_text(f"<title>report of {folder.name}</title>")


def write_sessions(out, rows, header=("object", "session", "genotype", "day")):
    out.mkdir(parents=True, exist_ok=True)
    with (out / "sessions.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([header, *rows])


def write_season(out, count):
    """Objects of two genotypes on two days; the last one failed, the one before it is far too large."""
    rng = np.random.default_rng(0)
    rows = [(f"pear_{i:03d}", f"captures/{i}", "AB"[i % 2], str(7 * (i // 2 % 2))) for i in range(count)]
    write_sessions(out, rows)
    for number, (name, *_) in enumerate(rows):
        volume_ml = 400.0 if number == count - 2 else 200.0 + 20.0 * (number % 2) + rng.normal(0.0, 5.0)
        sentence = "f_07.raw: is 12 bytes too short; copy it again." if number == count - 1 else ""
        traits = traits_of(volume_ml, rng.normal(0.7, 0.02))
        write_object(out / "objects" / name, traits, "process" if sentence else None, sentence)
    return out
