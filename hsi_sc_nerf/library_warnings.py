"""Libraries' warnings about each other's versions, which a user can do nothing about and which bury our lines."""

from __future__ import annotations

import warnings

# Category, module that warns, start of the message; both are regular expressions.
_KNOWN: tuple[tuple[type[Warning], str, str], ...] = (
    (FutureWarning, r"nerfstudio\.", r"`torch\.cuda\.amp\."),
    (FutureWarning, r"torch\.jit", r"`torch\.jit\.script` is deprecated"),
    (UserWarning, r"nerfstudio\.cameras\.cameras", r"Using a non-tuple sequence for multidimensional indexing"),
    (UserWarning, r"nerfstudio\.utils\.writer", r"Converting a tensor with requires_grad=True to a scalar"),
    (UserWarning, r"nerfstudio\.pipelines\.base_pipeline", r"std_mean\(\): degrees of freedom is <= 0"),
    (UserWarning, r"tyro\.", r"The field `pipeline\._target` is annotated with type"),
    (UserWarning, r"torchmetrics\.|lightning_utilities\.", r"pkg_resources is deprecated"),
)


def ignore_library_warnings() -> None:
    """Ignore these warnings, and no others, from here on."""
    for category, module, message in _KNOWN:
        warnings.filterwarnings("ignore", message=message, category=category, module=module)
