"""Run: the folder of one training, with everything that is needed to repeat, resume or use it.

config.toml          every setting, resolved
format.json          which layout the folder has; see `reenact.folder`
rigs/0-man.npz ...   the rigs as they were; the first is a pair's source, and its layout is shared by all others
clips/0-man.npz ...  training motion of the rigs that were given some
layouts.safetensors  sampling grid of each other rig
correspondences/     pairs of places of the first rig's surface and each other's, where geometry teaches
base.safetensors     networks of the run that this one adds rigs to
pairs.json           which shapes of the rigs were found to do the same
metrics.jsonl        losses by stage and step, and at saves what the networks were worth; see `reenact.holdout`
checkpoints/         networks, optimizer, position; see `reenact.checkpoint`
previews/            pictures drawn at each save
"""

from __future__ import annotations

import errno
import glob
import itertools
import os
import re
import shutil
import socket
import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from reenact.checkpoint import Checkpoint, load_checkpoint, load_tensors, save_tensors
from reenact.config import Config, PairsConfig, save_config
from reenact.data import Studio
from reenact.errors import ReenactError
from reenact.folder import load_run_config, write_format
from reenact.layout import find_layout, lay_out
from reenact.lock import alive
from reenact.models import Networks
from reenact.nudges import Nudges, labels, load_nudges, save_nudges
from reenact.pairs import Teacher, find_teacher
from reenact.retargeting.correspondence import (
    Correspondence,
    find_correspondence,
    load_correspondence,
    save_correspondence,
)
from reenact.rigs.files import load_clip, load_rig, save_clip, save_rig
from reenact.rigs.formats.pieces import Choice
from reenact.rigs.rig import Rig

_LAYOUT_RESOLUTION = 64
"""Pixels at which layouts are found; a studio enlarges them to the resolution of its pictures."""
_TAUGHT = "taught.json"
"""Corrections that the networks learn from, in the run folder; nudges.json there is the viewer's."""
_BASE = "base.safetensors"
"""Networks of the run that rigs are added to, in the run folder."""
_FILE = re.compile(r"(\d+)-(.+)\.npz")


@dataclass(frozen=True)
class Run:
    """An opened run folder. Rigs, layouts and networks are keyed alike; the first key is the source of a pair."""

    folder: Path
    config: Config
    rigs: dict[str, Rig]
    layouts: dict[str, Tensor]
    """(R, R, 2) sampling grid of each rig but the first; empty where the settings ask for none."""
    correspondences: dict[tuple[str, str], Correspondence]
    """By the key of the first rig and that of another; empty where the settings ask for none. Those of a cast are
    dense: what lies between two others is told by their places on the first."""
    base: dict[str, Tensor] = field(default_factory=dict)
    """Networks of the run that this one adds rigs to; empty where it begins anew."""

    @classmethod
    def create(cls, config: Config) -> Run:
        """A new run folder with the rigs, their layouts and their training clips in it.

        Raises:
            ReenactError: The folder already holds something, a rig or clip cannot be read or photographed, or the run
                to add to has saved nothing yet, or has other settings.
            OSError: The folder cannot be made.
        """
        if config.run:  # before the work, whose result it should hold
            folder = Path(config.run)
            if folder.is_dir():
                _sweep(folder, folder.resolve().name)
            _check_new(folder)
        base = None if config.base is None else _base(config)
        rigs = [] if base is None else list(base.rigs.values())
        choices = [Choice()] * len(config.cast) or [
            Choice(config.source_parts, config.source_shapes),
            Choice(config.target_parts, config.target_shapes),
        ]
        rigs += [load_rig(name, choice) for name, choice in list(zip(config.rigs, choices))[len(rigs) :]]
        folder = Path(config.run) if config.run else _new_folder(rigs)
        keyed = dict(zip(_keys(rigs), rigs))
        clip_names = [None] * len(config.cast) or [config.source_clip, config.target_clip]
        clips = [None if name is None else load_clip(name, rig) for name, rig in zip(clip_names, rigs)]
        named, config = bool(config.run), replace(config, run=str(folder))
        place = folder.resolve()
        place.parent.mkdir(parents=True, exist_ok=True)
        # An empty folder is filled, not replaced: it may be a link, a mounted disk, or where the user stands.
        beside = place if place.exists() else place.parent
        _sweep(beside, place.name)
        with tempfile.TemporaryDirectory(prefix=f"{_mark(place.name)}{os.getpid()}-", dir=beside) as unfinished:
            whole = Path(unfinished) / "run"
            (whole / "rigs").mkdir(parents=True)
            for index, (key, rig, clip) in enumerate(zip(keyed, rigs, clips)):
                save_rig(rig, whole / "rigs" / f"{index}-{key}.npz")
                if clip is not None:
                    (whole / "clips").mkdir(exist_ok=True)
                    save_clip(clip, whole / "clips" / f"{index}-{key}.npz")
            if config.pairs.nudges is not None:
                save_nudges(_usable_nudges(config.pairs.nudges, keyed), whole / _TAUGHT)
            correspondences = _find_correspondences(keyed, config, base)
            for (first, second), correspondence in correspondences.items():
                (whole / "correspondences").mkdir(exist_ok=True)
                save_correspondence(correspondence, whole / "correspondences" / _pair_file(list(keyed), first, second))
            run = cls(folder, config, keyed, {}, correspondences, {} if base is None else base.trained())
            layouts = _find_layouts(run, base)
            save_tensors(layouts, whole / "layouts.safetensors")
            if run.base:
                save_tensors(run.base, whole / _BASE)
            write_format(whole)
            save_config(config, whole / "config.toml")
            # A run appears whole or not at all: by one rename, or with its config, without which it is none, last.
            if beside is place:
                _check_new(folder, apart_from=Path(unfinished).name)  # others may have come first
                for part in sorted(whole.iterdir(), key=lambda part: part.name == "config.toml"):
                    part.replace(place / part.name)
            else:
                while True:
                    try:
                        whole.replace(place)
                        break
                    except OSError as error:
                        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                            raise
                    if named:
                        _check_new(folder)
                    folder = _new_folder(rigs)
                    place = folder.resolve()
        return replace(run, folder=folder, config=config, layouts=layouts)

    @classmethod
    def open(cls, folder: Path | str) -> Run:
        """The run in a folder.

        Raises:
            MissingError: There is no run.
            ReenactError: It is of a format that this version does not open, or settings, rigs or layouts are missing or
                damaged.
        """
        folder = Path(folder)
        config = load_run_config(folder)
        rigs = _load_rigs(folder / "rigs")
        layouts = _load_layouts(folder / "layouts.safetensors", config, list(rigs))
        correspondences = _load_correspondences(folder / "correspondences", config, rigs)
        base = {} if config.base is None else load_tensors(folder / _BASE)
        return cls(folder, config, rigs, layouts, correspondences, base)

    @property
    def keys(self) -> list[str]:
        """Keys of the rigs, the source of a pair first."""
        return list(self.rigs)

    @property
    def new_keys(self) -> list[str]:
        """Keys of the rigs that the run trains: all, or those that its base lacks."""
        known = {name.split(".")[1] for name in self.base if name.startswith("bpnets.")}
        return [key for key in self.rigs if key not in known]

    def partners(self, key: str) -> list[str]:
        """Keys of the rigs that one is compared with: the first, and those that follow it; see `pairs.partners`.

        A rig of the base is compared with new ones alone, and only with those that are compared with it.
        """
        if key not in self.new_keys:
            return [new for new in self.new_keys if key in self.partners(new)]
        place = self.keys.index(key)
        following = self.keys[place + 1 :] + self.keys[:place]
        return sorted(following, key=lambda other: other != self.keys[0])[: self.config.pairs.partners]

    def pair(self, source: str | None = None, target: str | None = None) -> tuple[str, str]:
        """Keys of the rigs to move motion between: those that were named, or the run's first two.

        Args:
            source: A key, a rig's name, or what the settings call it; the first rig unless said, or the second where
                that is the target.
            target: Likewise; the second unless said, or the first where that is the source.

        Raises:
            ReenactError: There is no such rig, or both are the same.
        """
        first, second = (name and self._key(name) for name in (source, target))
        first = first or next(key for key in self.keys if key != second)
        second = second or next(key for key in self.keys if key != first)
        if first == second:
            raise ReenactError(f"{self.folder}: expected two rigs, got {first} twice; it has {', '.join(self.keys)}")
        return first, second

    def _key(self, name: str) -> str:
        """The key of a rig by any of its names."""
        for key, rig, origin in zip(self.rigs, self.rigs.values(), self.config.rigs):
            if name in (key, rig.name, origin):
                return key
        raise ReenactError(f"{self.folder}: expected a rig of the run, {', '.join(self.keys)}, got {name}")

    def studio(self, key: str, device: str = "cpu") -> Studio:
        """The studio that photographs one rig for this run's networks, on a device.

        Raises:
            ReenactError: The rig cannot be photographed, or its training clip is damaged.
        """
        index, config = self.keys.index(key), self.config
        clip_name = None if config.cast else (config.source_clip, config.target_clip)[index]
        kept = self.folder / "clips" / f"{index}-{key}.npz"  # the file that was named may have moved since
        clip = None if clip_name is None else load_clip(str(kept) if kept.is_file() else clip_name, self.rigs[key])
        return Studio(
            self.rigs[key],
            config.images,
            self.layouts.get(key),
            clip,
            seed=1000 * config.training.seed + index,
            crowded=config.training.crowded,
            uneven=config.training.uneven,
            device=device,
        )

    def correspondence(self, source: str, target: str) -> Correspondence | None:
        """Pairs of places from one rig to another, by their keys, as many as the settings say; None for no geometry."""
        if not self.correspondences:
            return None
        pairs = self.config.pairs
        if not self.config.cast:
            (first, second), known = next(iter(self.correspondences.items()))
            if pairs.correspondence is None and len(known) > pairs.markers:  # a given file is taken as it is
                known = known.sample(self.rigs[first], pairs.markers)
            return known if (source, target) == (first, second) else known.reversed()
        return self._dense(source, target).sample(self.rigs[source], pairs.markers)

    def _dense(self, source: str, target: str) -> Correspondence:
        """All pairs of places that are known, between two rigs of a cast by way of its first."""
        known, back = (self.correspondences.get(pair) for pair in ((source, target), (target, source)))
        if known is not None:
            return known
        if back is not None:
            return back.reversed()
        first = self.keys[0]
        return self.correspondences[first, source].reversed().then(self.correspondences[first, target])

    def teacher(self, source: Studio, target: Studio, source_key: str, target_key: str) -> Teacher:
        """What is known of one rig's expressions on another; the settings must ask for pairs.

        Args:
            source: Studio of `source_key`.
            target: Studio of `target_key`.
            source_key: Where motion comes from.
            target_key: Where it goes to.
        """
        corrected = None
        if self.config.pairs.nudges is not None:
            corrected = labels(load_nudges(self.folder / _TAUGHT), source_key, target_key)[:2]
        known = self.correspondence(source_key, target_key)
        return find_teacher(source, target, self.config.pairs, known, corrected)

    def networks(self) -> Networks:
        """Untrained networks of the run's shape, initialised from its seed."""
        torch.manual_seed(self.config.training.seed)
        return Networks({key: len(rig.names) for key, rig in self.rigs.items()}, self.config)

    def trained_networks(self, saved: Checkpoint | None = None) -> Networks:
        """The networks of a checkpoint, the newest unless one is given, in evaluation mode.

        Raises:
            MissingError: Nothing was saved yet.
            ReenactError: No checkpoint is whole, or they are of other networks.
        """
        networks = self.networks()
        saved = load_checkpoint(self.folder) if saved is None else saved
        restore_networks(networks, saved.tensors, self.folder)
        return networks.eval()

    def trained(self) -> dict[str, Tensor]:
        """The tensors of `trained_networks`."""
        return dict(self.trained_networks().state_dict())


def restore_networks(networks: Networks, tensors: dict[str, Tensor], folder: Path) -> None:
    """Put the networks' part of a checkpoint back into them.

    Args:
        networks: Filled in place.
        tensors: Of a checkpoint; those of the networks begin with "networks.".
        folder: The run, to begin a message with.

    Raises:
        ReenactError: They are of networks of another shape.
    """
    saved, own = networks_state(tensors), networks.state_dict()
    shapes, own_shapes = ({name: tuple(value.shape) for name, value in each.items()} for each in (saved, own))
    strange = sorted(name for name in shapes.keys() | own_shapes.keys() if shapes.get(name) != own_shapes.get(name))
    if strange:
        first = strange[0]
        raise ReenactError(
            f"{folder}: expected networks as config.toml describes them, got others ({len(strange)} tensors differ; "
            f"{first}: expected {own_shapes.get(first, 'none')}, got {shapes.get(first, 'none')}); the settings or the "
            "version of Reenact changed since: take the old ones, or train again"
        )
    networks.load_state_dict(saved)


def networks_state(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """The networks' part of a checkpoint."""
    prefix = "networks."
    return {name[len(prefix) :]: tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def _base(config: Config) -> Run:
    """The run that a cast adds rigs to.

    Raises:
        ReenactError: Its rigs are not the first of the cast, its training has not ended, or its networks are others.
    """
    base = Run.open(config.base)
    known = config.cast[: len(base.rigs)]
    if len(config.cast) <= len(base.rigs) or any(name != origin for name, origin in zip(known, base.config.rigs)):
        raise ReenactError(
            f"{config.base}: expected its rigs and at least one more as cast, got {', '.join(config.cast)}; it has "
            f"{', '.join(base.config.rigs)}"
        )
    own, new = (replace(each, pairs=PairsConfig(method=each.pairs.method)) for each in (base.config, config))
    for section in ("images", "layout", "pairs", "reenactnet"):
        if getattr(own, section) != getattr(new, section):
            raise ReenactError(f"{config.base}: expected its own settings of {section}, got others; take those")
    if base.config.bpnet.hidden != config.bpnet.hidden or base.config.bpnet.channels != config.bpnet.channels:
        raise ReenactError(f"{config.base}: expected its own sizes of bpnet, got others; take those")
    if base.config.source_clip or base.config.target_clip:
        raise ReenactError(
            f"{config.base}: expected a run that samples expressions, got training clips; train a cast without them"
        )
    return base


def _find_layouts(run: Run, base: Run | None) -> dict[str, Tensor]:
    """A layout for each rig but the first; none at all where the settings say so."""
    config, rigs = run.config.layout, run.rigs
    if config.method == "none":
        return {}
    reference, *others = rigs
    layouts = {} if base is None else dict(base.layouts)
    for key in [key for key in others if key not in layouts]:
        known = run.correspondences.get((reference, key))
        if config.method == "found" and known is not None:
            layouts[key] = lay_out(rigs[reference], rigs[key], known, _LAYOUT_RESOLUTION)
        else:
            seed = run.config.training.seed
            layouts[key] = find_layout(rigs[reference], rigs[key], _LAYOUT_RESOLUTION, config, seed)
    return layouts


def _find_correspondences(
    rigs: dict[str, Rig], config: Config, base: Run | None = None
) -> dict[tuple[str, str], Correspondence]:
    """From the first rig to each other, where the settings let geometry teach; those that are found are dense."""
    found, given = {}, config.pairs.correspondence
    for first, second in _registered(rigs, config):
        if base is not None and base.config.cast and (first, second) in base.correspondences:
            found[first, second] = base.correspondences[first, second]
        elif given is None:
            found[first, second] = find_correspondence(rigs[first], rigs[second], None)
        else:
            found[first, second] = load_correspondence(given, rigs[first], rigs[second])
    return found


def _load_correspondences(folder: Path, config: Config, rigs: dict[str, Rig]) -> dict[tuple[str, str], Correspondence]:
    found = {}
    for first, second in _registered(rigs, config):
        path = folder / _pair_file(list(rigs), first, second)
        if not path.is_file():
            raise ReenactError(f"{path}: expected the pairs of places of the run, got no file; train again")
        found[first, second] = load_correspondence(path, rigs[first], rigs[second])
    return found


def _usable_nudges(path: str, rigs: dict[str, Rig]) -> Nudges:
    """The nudges of these rigs in a file, under the keys of the run; a viewer without a run knows rigs by name."""
    found = load_nudges(path)
    known = {
        name: key
        for key, rig in rigs.items()
        for name, shapes in found.rigs.items()
        if name in (key, rig.name) and shapes == rig.names
    }
    items = tuple(
        replace(nudge, source=known[nudge.source], rig=known[nudge.rig])
        for nudge in found.items
        if nudge.source in known and nudge.rig in known and nudge.source != nudge.rig
    )
    if not items:
        raise ReenactError(
            f"{path}: expected corrected frames of {' or '.join(rigs)} with the shapes of today, got "
            f"{len(found.items)} of {', '.join(found.rigs) or 'no rig'}"
        )
    return Nudges({key: rig.names for key, rig in rigs.items()}, items)


def _registered(rigs: dict[str, Rig], config: Config) -> list[tuple[str, str]]:
    """Keys of the pairs of rigs that have a correspondence: the first, and each other."""
    first, *others = rigs
    return [(first, other) for other in others] if config.pairs.method == "geometry" else []


def _pair_file(keys: list[str], first: str, second: str) -> str:
    return f"{keys.index(first)}-{keys.index(second)}.npz"


def _load_rigs(folder: Path) -> dict[str, Rig]:
    found = {int(match[1]): (match[2], path) for path in folder.glob("*.npz") if (match := _FILE.fullmatch(path.name))}
    if sorted(found) != list(range(max(2, len(found)))):
        raise ReenactError(
            f"{folder}: expected the rigs of a run, 0-NAME.npz, 1-NAME.npz and so on, got {len(found)} files; "
            "restore the folder or train again"
        )
    return {key: load_rig(str(path)) for _, (key, path) in sorted(found.items())}


def _load_layouts(path: Path, config: Config, keys: list[str]) -> dict[str, Tensor]:
    if not path.is_file():
        raise ReenactError(f"{path}: expected the layouts of the run, got no file; restore the folder or train again")
    layouts = load_tensors(path)
    wanted = keys[1:] if config.layout.method != "none" else []
    if sorted(layouts) != sorted(wanted):
        raise ReenactError(
            f"{path}: expected layouts for {', '.join(wanted) or 'no rig'}, got {', '.join(layouts) or 'none'}; "
            "restore the folder or train again"
        )
    for key, grid in layouts.items():
        square = grid.dim() == 3 and grid.shape[0] == grid.shape[1] > 0 and grid.shape[2] == 2
        if not square or grid.dtype != torch.float32 or not bool(torch.isfinite(grid).all()):
            raise ReenactError(
                f"{path}: {key}: expected (R, R, 2) finite float32, got {tuple(grid.shape)} {grid.dtype}; "
                "restore the folder or train again"
            )
    return layouts


def _keys(rigs: list[Rig]) -> list[str]:
    """A key per rig, safe in files and in a ModuleDict; equal names are numbered."""
    keys: list[str] = []
    for rig in rigs:
        key = re.sub(r"[^A-Za-z0-9_-]+", "-", rig.name).strip("-")[:60] or "rig"
        if hasattr(torch.nn.ModuleDict, key) or hasattr(torch.nn.ModuleDict(), key):  # takes no keys such as "train"
            key = f"{key}-rig"
        free = (f"{key}-{number}" for number in itertools.count(2))
        keys.append(next(name for name in free if name not in keys) if key in keys else key)
    return keys


def _mark(name: str) -> str:
    """How the hidden folders begin in which this machine makes a run of that name; the process follows."""
    machine = re.sub(r"[^A-Za-z0-9]+", "", socket.gethostname())[:30]
    return f".{name[:50]}-{machine}-"


def _sweep(place: Path, name: str) -> None:
    """Remove what processes that were killed left of a run of that name."""
    for leftover in place.glob(f"{glob.escape(_mark(name))}*"):
        found = re.fullmatch(r"(\d+)-[^-]+", leftover.name[len(_mark(name)) :])
        if found is not None and not alive(int(found[1])):
            shutil.rmtree(leftover, ignore_errors=True)


def _check_new(folder: Path, apart_from: str = "") -> None:
    """Refuse a folder that holds something, or where nothing can be written."""
    if folder.exists() and (not folder.is_dir() or any(each.name != apart_from for each in folder.iterdir())):
        raise ReenactError(
            f"{folder}: already holds something and a run never overwrites; add --resume to go on with it, "
            "or name another folder with --run"
        )
    try:
        place = folder.resolve()
    except RuntimeError as error:  # Python before 3.13
        raise ReenactError(
            f"{folder}: expected a place for a folder, got links that lead in a circle; {error}"
        ) from error
    with tempfile.TemporaryFile(dir=next(each for each in (place, *place.parents) if each.exists())):
        pass


def _new_folder(rigs: list[Rig]) -> Path:
    keys = _keys(rigs)
    base = "-to-".join(keys) if len(keys) == 2 else f"{keys[0]}-and-{len(keys) - 1}"
    number = 1
    while (Path("runs") / f"{base}-{number}").exists():
        number += 1
    return Path("runs") / f"{base}-{number}"
