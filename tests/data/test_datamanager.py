"""Settings of the data manager."""

import pytest

from hsi_sc_nerf.data.datamanager import SpectralDataManagerConfig


@pytest.mark.parametrize("rays", [0, -5])
def test_a_step_without_rays_is_refused(rays):
    with pytest.raises(SystemExit, match="train-num-rays-per-batch"):
        SpectralDataManagerConfig(train_num_rays_per_batch=rays)
