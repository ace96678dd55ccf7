"""A good session, and a copy of it that a test may spoil."""

import shutil
from pathlib import Path

import pytest
from inspection_session import INFO, write_turntable


@pytest.fixture(scope="session")
def good(tmp_path_factory) -> Path:
    return write_turntable(tmp_path_factory.mktemp("good") / "session", info=INFO)


@pytest.fixture
def session(good, tmp_path) -> Path:
    return Path(shutil.copytree(good, tmp_path / "session"))
