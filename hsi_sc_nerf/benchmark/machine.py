"""What a timing was taken on."""

from __future__ import annotations

import os
import platform
import sys
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from resource import struct_rusage

_PACKAGES = ("hsi-sc-nerf", "nerfstudio", "torch", "numpy")
_RSS_UNIT_BYTES = 1 if sys.platform == "darwin" else 1024


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def peak_memory_mib(usage: struct_rusage | None = None) -> float:
    """The most memory that a process held at once; without its ``usage``, of this one."""
    import resource  # not on Windows, where the commands that measure no memory run

    usage = usage or resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_maxrss * _RSS_UNIT_BYTES / 2**20


def describe_machine() -> dict[str, str]:
    """System, processor, cores, accelerator and versions, in words."""
    import torch

    machine = {
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "cores": str(available_cores()),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else "none",
        "python": platform.python_version(),
    }
    return machine | {package: version(package) for package in _PACKAGES}


def _processor() -> str:
    """Model name of the processor where the system tells it (Linux), otherwise what Python calls it."""
    facts = Path("/proc/cpuinfo")
    if facts.is_file():
        for line in facts.read_text(encoding="utf-8").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return value.strip()
    return platform.processor() or "unknown"
