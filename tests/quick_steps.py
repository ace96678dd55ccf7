"""The workflow of `batch` with commands that take no time: they leave empty results, and note that they ran.

    python tests/quick_steps.py OBJECT STEP COPY      (in the folder of the batch, as the workflow starts its steps)

A session with a file `broken` cannot be processed. Where a file `wait` lies beside the batch's list, a training does
not come to its end.
"""

import os
import sys
import time
from pathlib import Path

from hsi_sc_nerf.batch.plan import read_plan
from hsi_sc_nerf.batch.recorded_step import copy_record, record_step
from hsi_sc_nerf.benchmark.steps import StepCost, end_with_parent
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import write_json


def quick_run(one, name, argv, log):
    with (Path.cwd() / "ran.txt").open("a") as ran:
        ran.write(f"{one.folder.name} {name}\n")
    log.parent.mkdir(parents=True, exist_ok=True)
    if name == "process" and (one.session / "broken").exists():
        log.write_text("7 frames\nError: the white reference is missing; capture it.\n")
        raise InputError("the step 'process' failed with status 2.")
    if name == "train":
        write_json(one.folder / "training/hsi-sc-nerf/run/nerfstudio_models/step-10.ckpt", {})
        while Path("wait").exists():
            time.sleep(0.05)
    for path in one.step(name).outputs:
        write_json(path, {})
    return StepCost(name, 1.0, 100.0)


def quick_snakefile(folder):
    """The shipped workflow with these commands."""
    from hsi_sc_nerf.cli.batch import SNAKEFILE

    text = SNAKEFILE.read_text()
    assert "-m hsi_sc_nerf.batch.recorded_step" in text
    path = folder / "Snakefile"
    path.write_text(text.replace("-m hsi_sc_nerf.batch.recorded_step", __file__))
    return path


if __name__ == "__main__":
    end_with_parent()
    planned = read_plan(Path.cwd())[sys.argv[1]]
    # As with the real commands, a training that goes on is told where from.
    record_step(planned, sys.argv[2], lambda *words: quick_run(planned, *words))
    copy_record(planned, sys.argv[2], Path(sys.argv[3]))
    os._exit(0)
