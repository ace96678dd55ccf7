"""What a batch keeps of its plan, and one sentence for what it cannot be."""

import pytest

from hsi_sc_nerf.batch.plan import SETTINGS_NAME, read_plan
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.files import write_json


@pytest.mark.parametrize("known", [{"process": 3}, {"train": None}, {"num_points": "9"}, {"max_num_iterations": [1]}])
def test_settings_of_other_types_are_refused(tmp_path, known):
    write_json(tmp_path / SETTINGS_NAME, known)
    with pytest.raises(InputError, match="are no settings of a batch"):
        read_plan(tmp_path)
