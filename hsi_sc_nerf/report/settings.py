"""What a run was made with: its settings, one line each, and the versions of the packages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from hsi_sc_nerf.report.blocks import Block, Folded, Paragraph, Section, Table

PACKAGES = (
    *("hsi-sc-nerf", "nerfstudio", "torch", "numpy", "scipy", "spectral", "opencv-contrib-python-headless"),
    *("open3d", "pycolmap", "numba", "matplotlib", "tyro"),
)
_NO_SETTINGS = ("_target",)


def flat_settings(config: Any, prefix: str = "") -> dict[str, str]:
    """Settings of nested dataclasses and mappings as text, by their dotted names."""
    if is_dataclass(config) and not isinstance(config, type):
        parts = {f.name: getattr(config, f.name) for f in fields(config) if f.name not in _NO_SETTINGS}
    elif isinstance(config, Mapping) and config:
        parts = {str(key): value for key, value in config.items()}
    else:
        return {prefix: str(config)}
    flat: dict[str, str] = {}
    for name, value in parts.items():
        flat |= flat_settings(value, f"{prefix}.{name}" if prefix else name)
    return flat


def changed_settings(settings: Mapping[str, str], defaults: Mapping[str, str]) -> dict[str, tuple[str, str]]:
    """Settings that differ from the defaults: what they are, and the default (``-`` where there is none)."""
    return {name: (value, defaults.get(name, "-")) for name, value in settings.items() if defaults.get(name) != value}


def package_versions() -> dict[str, str]:
    """Versions of the packages that a result depends on; those that are not installed are left out."""
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


def settings_section(settings: Mapping[str, str], defaults: Mapping[str, str], machine: Mapping[str, str]) -> Section:
    """What the run was made with.

    Args:
        settings: of the run (`flat_settings`).
        defaults: of its method.
        machine: facts of the machine that makes the report, and versions of its packages.
    """
    changed = changed_settings(settings, defaults)
    first: Block = Paragraph("All settings are the method's defaults.")
    if changed:
        rows = [(name, value, default) for name, (value, default) in changed.items()]
        first = Table("Settings that are not the method's defaults.", ("", "this run", "default"), rows)
    everything = Table("All settings of the run.", ("", "value"), list(settings.items()))
    caption = "Machine and packages that made this report; the run itself does not record its own."
    return Section(
        "settings",
        "Versions and settings",
        [first, Folded("All settings", [everything]), Table(caption, ("", ""), list(machine.items()))],
    )
