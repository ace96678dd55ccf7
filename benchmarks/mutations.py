"""Functions of training, evaluation and calibration broken on purpose, one at a time: some test must fail each time.

    uv run python benchmarks/mutations.py

mutations.csv lists them: a sign that is flipped, or a bound, guard or small constant that is dropped. Each is done to
a copy of the package, on which the tests named beside it are run; they have passed on it before. "Missed" is one that
no test noticed.
"""

from __future__ import annotations

import csv
import os
import shutil
import sys
import tempfile
from pathlib import Path

# Loaded once for all processes; nothing here loads the package's own models.
import hypothesis  # noqa: F401
import nerfstudio.fields.nerfacto_field
import nerfstudio.model_components.losses  # noqa: F401
import pytest
import tyro
from results_table import RESULTS, write_results

COLUMNS = ["function", "broken by", "noticed"]
ROOT = Path(__file__).resolve().parents[1]


def failed(package: Path, tests: str) -> bool:
    """Whether some of the tests fail with the package in this folder, in a process forked from this one."""
    paths = [str(package / "tests" / test) for test in tests.split()]
    process = os.fork()
    if process == 0:
        os.chdir(package)
        sys.path.insert(0, str(package))
        for name in [name for name in sys.modules if name.partition(".")[0] == "hsi_sc_nerf"]:
            del sys.modules[name]
        with (package / "log").open("w") as log:
            os.dup2(log.fileno(), 1)
            os.dup2(log.fileno(), 2)
            os._exit(pytest.main(["-x", "-q", "-n", "0", "-p", "no:cacheprovider", *paths]))
    status = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
    # 2 is a module that cannot be imported any more, a negative status a process that a signal ended.
    if status > 2:
        raise RuntimeError(f"status {status}: {(package / 'log').read_text()[-2000:]}")
    return status != 0


def main(only: str = "", results: Path = RESULTS) -> None:
    """Break every function, run its tests, and write the table.

    Args:
        only: part of the names of the functions to break; the other rows of the table are kept.
        results: folder of the table.

    Raises:
        RuntimeError: the tests fail before anything is broken, or a mutation's text is not found once in its file.
    """
    with Path(__file__).with_suffix(".csv").open(encoding="utf-8", newline="") as file:
        chosen = [mutation for mutation in list(csv.reader(file))[1:] if only in mutation[0]]
    with tempfile.TemporaryDirectory() as temporary:
        package = Path(temporary)
        for name in ("hsi_sc_nerf", "tests", "pyproject.toml"):
            copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
            copy(ROOT / name, package / name)  # type: ignore[operator]
        if failed(package, " ".join(sorted({test for *_, tests in chosen for test in tests.split()}))):
            raise RuntimeError(f"the tests fail before anything is broken: {(package / 'log').read_text()[-3000:]}")
        for function, broken_by, module, old, new, tests in chosen:
            path = package / "hsi_sc_nerf" / f"{module}.py"
            text = path.read_text()
            old, new = old.replace("\\n", "\n"), new.replace("\\n", "\n")
            if text.count(old) != 1:
                raise RuntimeError(f"{path.name} has {text.count(old)} times {old!r}")
            path.write_text(text.replace(old, new))
            row = [function, broken_by, "yes" if failed(package, tests) else "missed"]
            path.write_text(text)
            write_results("mutations", COLUMNS, [row], keys=2, folder=results)


if __name__ == "__main__":
    tyro.cli(main)
