import pytest
from reported_run import write_page, write_run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("report"))


@pytest.fixture(scope="module")
def report(run):
    return write_page(run)
