import fcntl
import gc
import os
import resource
import signal
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
from threadpoolctl import threadpool_limits

if sys.dont_write_bytecode:
    # Where no compiled modules may lie beside the sources (as in containers), each process of the tests would compile
    # the tests, this package and often nerfstudio anew. They are kept with pytest's other files.
    sys.dont_write_bytecode = False
    sys.pycache_prefix = str(Path(__file__).parents[1] / ".pytest_cache" / "pycache")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix

if "PYTEST_XDIST_WORKER" in os.environ:
    # Processes side by side, each with all cores' threads, wait for one another.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
# Nothing here is compiled by PyTorch. nerfstudio's import compiles two functions of a method that is not used, for
# which PyTorch loads its compiler: half of the import's time, in each process of the tests.
os.environ.setdefault("TORCHDYNAMO_DISABLE", "1")
# Libraries load gRPC, whose threads may write a line to the standard error of a command that a test has just started.
os.environ.setdefault("GRPC_VERBOSITY", "NONE")

# A long file that comes last is waited for by all other processes.
LONGEST = ["test_batch_sessions.py", "test_end_to_end.py", "test_workflows.py", "test_object_in_browser.py"]
LONGEST += ["test_viewer_in_browser.py", "test_mitsuba.py", "test_nerfstudio_commands.py", "test_pose_methods.py"]
LONGEST += ["test_resume.py"]


def pytest_collection_modifyitems(items):
    """The longest files first, then fast tests before slow ones."""

    def place(item):
        longest = LONGEST.index(item.path.name) if item.path.name in LONGEST else len(LONGEST)
        return longest, item.get_closest_marker("slow") is not None

    items.sort(key=place)


def pytest_collection_finish():
    """What was imported stays, so that the garbage collector need not look through it again and again."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def one_blas_thread():
    """The tests' many small systems of equations are slower, and less alike, with more."""
    with threadpool_limits(limits=1, user_api="blas"):
        yield


@pytest.fixture(autouse=True)
def ctrl_c():
    """Commands that run in this process handle it in their own way."""
    handler = signal.getsignal(signal.SIGINT)
    yield
    signal.signal(signal.SIGINT, handler)


@pytest.fixture
def command(monkeypatch):
    """Runs ``hsi-sc-nerf`` with the words it is given, in this process; the result is the exit status."""
    from hsi_sc_nerf.cli.main import main

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["hsi-sc-nerf", *map(str, words)])
        try:
            main()
        except SystemExit as ended:
            return ended.code
        return 0

    return run


@pytest.fixture
def limit_of_files(monkeypatch):
    """Context of a limit to the size of files in bytes, which stands for a full disk."""

    @contextmanager
    def limited(size):
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        monkeypatch.setattr(sys, "dont_write_bytecode", True)  # Python would keep the beginning of a compiled module
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)

    return limited


@pytest.fixture
def blank_figures(monkeypatch):
    """Figures are written as one black pixel: drawing them takes most of the time of `process` on a small session."""
    from matplotlib.figure import Figure
    from PIL import Image

    monkeypatch.setattr(Figure, "savefig", lambda figure, path: Image.new("RGB", (1, 1)).save(path, "png"))


@pytest.fixture(scope="session", params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request):
    """Devices that tensors are tested on; ``pytest -m gpu`` runs what needs a GPU alone."""
    import torch

    if request.param == "cuda" and not torch.cuda.is_available():
        pytest.skip("no GPU: CUDA is not available here")
    return request.param


@pytest.fixture(scope="module")
def quick_start():
    """Training begins in tenths of a second: with a coarse grid, and a field that is taught to be solid in few steps.

    For tests of what comes after; models/test_occupancy_sampler.py tests how a field begins.
    """
    from hsi_sc_nerf.fields import occupancy_grid
    from hsi_sc_nerf.fields.spectral_field import SpectralField

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(occupancy_grid, "GRID_CELLS", 32)
        patch.setattr(SpectralField.start_solid, "__defaults__", (8,))
        yield


@pytest.fixture(scope="module")
def browser():
    """For the tests that look at pages as users do."""
    from headless_browser import launch

    sync_api = pytest.importorskip("playwright.sync_api", reason="no playwright")
    with sync_api.sync_playwright() as playwright:
        browser = launch(playwright)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def tiny_dataset(tmp_path_factory):
    """A processed session of ten small frames with few bands, and the session that it was made from.

    All test processes share it: the first makes it, the others wait. It must not be written to.
    """
    from hsi_sc_nerf.processing.process import process_session
    from hsi_sc_nerf.simulate.scene import load_scene, override
    from hsi_sc_nerf.simulate.session import simulate_session

    root = tmp_path_factory.getbasetemp()
    folder = (root.parent if "PYTEST_XDIST_WORKER" in os.environ else root) / "tiny"
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "data" / "transforms.json").exists():
            scene = override(load_scene("pear"), frames=10, size_px=112, bands=12, seed=None)
            process_session(
                simulate_session(scene, folder / "session", progress=False), folder / "data", progress=False
            )
    return folder / "data", folder / "session"


@pytest.fixture(scope="session")
def flagged_dataset(tiny_dataset, tmp_path_factory):
    """A copy of the tiny dataset with flagged values: a fifth of two bands, and all bands of some whole lines."""
    import shutil
    from dataclasses import replace

    import numpy as np

    from hsi_sc_nerf.packed.cube import FLAGGED, write_packed_cube
    from hsi_sc_nerf.packed.dataset import open_packed, write_transforms

    data = tmp_path_factory.mktemp("flagged") / "data"
    shutil.copytree(tiny_dataset[0], data)
    dataset = open_packed(data)
    rng = np.random.default_rng(0)
    for frame in dataset.frames:
        counts = np.array(frame.cube())
        counts[..., 3:5][rng.random((*counts.shape[:2], 2)) < 0.2] = FLAGGED
        counts[50:53] = FLAGGED
        write_packed_cube(frame.cube_path, counts, dataset.wavelengths_nm)
    flagged = sum(int((frame.cube() == FLAGGED).sum()) for frame in dataset.frames)
    write_transforms(replace(dataset, flagged_values=flagged))
    return data
