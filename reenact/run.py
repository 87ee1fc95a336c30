"""Run: the folder of one training, with everything that is needed to repeat, resume or use it.

config.toml          every setting, resolved
rigs/0-man.npz ...   the rigs as they were; the first is the source, whose layout all others share
layouts.safetensors  sampling grid of each other rig
metrics.jsonl        losses by stage and step
checkpoints/         networks, optimizer, position; see `reenact.checkpoint`
previews/            pictures drawn at each save
"""

from __future__ import annotations

import re
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from reenact.checkpoint import load_checkpoint, load_tensors, save_tensors
from reenact.config import Config, load_config, save_config
from reenact.data import Studio
from reenact.errors import ReenactError
from reenact.layout import find_layout
from reenact.models import Networks
from reenact.rigs.files import load_clip, load_rig, save_rig
from reenact.rigs.rig import Rig

_LAYOUT_RESOLUTION = 64
"""Pixels at which layouts are found; a studio enlarges them to the resolution of its pictures."""


@dataclass(frozen=True)
class Run:
    """An opened run folder. Rigs, layouts and networks are keyed alike; the first key is the source."""

    folder: Path
    config: Config
    rigs: dict[str, Rig]
    layouts: dict[str, Tensor]

    @classmethod
    def create(cls, config: Config) -> Run:
        """A new run folder with the rigs and their layouts in it.

        Raises:
            ReenactError: The folder already exists, a rig cannot be read or photographed.
        """
        rigs = [load_rig(name) for name in (config.source, config.target)]
        folder = Path(config.run) if config.run else _new_folder(rigs)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise ReenactError(
                f"{folder}: already holds something and a run never overwrites; add --resume to go on with it, "
                "or name another folder with --run"
            )
        keyed = dict(zip(_keys(rigs), rigs))
        layouts = {}
        reference, *others = keyed
        if config.layout.method == "found":
            for key in others:
                layouts[key] = find_layout(
                    keyed[reference], keyed[key], _LAYOUT_RESOLUTION, config.layout, config.training.seed
                )
        config = replace(config, run=str(folder))
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as unfinished:
            whole = Path(unfinished) / "run"
            (whole / "rigs").mkdir(parents=True)
            for index, (key, rig) in enumerate(keyed.items()):
                save_rig(rig, whole / "rigs" / f"{index}-{key}.npz")
            save_tensors(layouts, whole / "layouts.safetensors")
            save_config(config, whole / "config.toml")
            whole.replace(folder)  # a run folder appears whole or not at all; an empty one is taken over
        return cls(folder, config, keyed, layouts)

    @classmethod
    def open(cls, folder: Path) -> Run:
        """The run in a folder.

        Raises:
            FileNotFoundError: There is no run.
        """
        folder = Path(folder)
        if not (folder / "config.toml").is_file():
            raise FileNotFoundError(f"{folder}: expected a run folder with config.toml; train one with `reenact train`")
        files = sorted((folder / "rigs").glob("*.npz"), key=lambda path: int(path.name.split("-", 1)[0]))
        rigs = {path.stem.split("-", 1)[1]: load_rig(str(path)) for path in files}
        config = replace(load_config(folder / "config.toml"), run=str(folder))
        return cls(folder, config, rigs, load_tensors(folder / "layouts.safetensors"))

    @property
    def keys(self) -> list[str]:
        """Keys of the rigs, the source first."""
        return list(self.rigs)

    def studio(self, key: str) -> Studio:
        """The studio that photographs one rig for this run's networks."""
        index, config = self.keys.index(key), self.config
        clip_name = (config.source_clip, config.target_clip)[index] if index < 2 else None
        clip = None if clip_name is None else load_clip(clip_name, self.rigs[key])
        return Studio(
            self.rigs[key],
            config.images,
            self.layouts.get(key),
            clip,
            config.training.fixed_frames,
            seed=1000 * config.training.seed + index,
        )

    def networks(self) -> Networks:
        """Untrained networks of the run's shape, initialised from its seed."""
        torch.manual_seed(self.config.training.seed)
        return Networks({key: len(rig.names) for key, rig in self.rigs.items()}, self.config)

    def trained_networks(self) -> Networks:
        """The networks of the newest checkpoint, in evaluation mode.

        Raises:
            FileNotFoundError: Nothing was saved yet.
        """
        networks = self.networks()
        networks.load_state_dict(networks_state(load_checkpoint(self.folder).tensors))
        return networks.eval()


def networks_state(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The networks' part of a checkpoint."""
    prefix = "networks."
    return {name[len(prefix) :]: tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def _keys(rigs: list[Rig]) -> list[str]:
    """A file-safe key per rig; equal names are numbered."""
    keys: list[str] = []
    for rig in rigs:
        key = re.sub(r"[^A-Za-z0-9_-]+", "-", rig.name).strip("-") or "rig"
        count = sum(other == key or other.startswith(f"{key}-") for other in keys)
        keys.append(f"{key}-{count + 1}" if key in keys else key)
    return keys


def _new_folder(rigs: list[Rig]) -> Path:
    base = "-to-".join(_keys(rigs)[:2])
    number = 1
    while (Path("runs") / f"{base}-{number}").exists():
        number += 1
    return Path("runs") / f"{base}-{number}"
