import pytest


def pytest_collection_modifyitems(items):
    """Fast tests first."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is not None)


@pytest.fixture(scope="session")
def tiny_dataset(tmp_path_factory):
    """A processed session of ten small frames with few bands, and the session that it was made from."""
    from hsi_sc_nerf.data.process import process_session
    from hsi_sc_nerf.simulate.scene import load_scene, override
    from hsi_sc_nerf.simulate.session import simulate_session

    folder = tmp_path_factory.mktemp("tiny")
    scene = override(load_scene("pear"), frames=10, size_px=112, bands=12, seed=None)
    session = simulate_session(scene, folder / "session", progress=False)
    return process_session(session, folder / "data", progress=False), session
