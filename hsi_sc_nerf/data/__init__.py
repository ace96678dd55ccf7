"""From raw ENVI cubes to a packed dataset, and from there to training batches."""

from hsi_sc_nerf.interruption import end_nerfstudio_command_at_once

# Of all that nerfstudio discovers this is imported first, and the libraries of all others take seconds.
end_nerfstudio_command_at_once()
