"""Reenact: facial expression retargeting between blendshape rigs."""

from importlib import import_module

_HOMES = {
    "Clip": "rigs.clip",
    "Config": "config",
    "ImageRetargeter": "inference",
    "Portrait": "portrait",
    "ReenactError": "errors",
    "Rig": "rigs.rig",
    "evaluate": "evaluation",
    "load_clip": "rigs.files",
    "load_config": "config",
    "load_rig": "rigs.files",
    "save_clip": "rigs.files",
    "save_rig": "rigs.files",
    "train": "training",
}
"""Module of each public name, imported when the name is first used: PyTorch takes seconds to load."""

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'reenact' has no attribute {name!r}")
    value = getattr(import_module(f"reenact.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(globals().keys() | _HOMES.keys())
