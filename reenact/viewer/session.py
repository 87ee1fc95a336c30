"""Session: what one viewer shows. Rigs as bytes for the page, and the clip on each of them by any method.

Numbers cross to the page as they lie in memory: geometry once per rig as safetensors, weights as rows of float32. The
page bends the meshes itself, so that a frame costs no request.
"""

from __future__ import annotations

import io
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from safetensors.numpy import save
from torch import Tensor

from reenact.checkpoint import load_checkpoint, newest_step
from reenact.data import check_device
from reenact.errors import ReenactError
from reenact.geometry import outward_faces
from reenact.nudges import Nudges, load_nudges, parse_nudges, save_nudges
from reenact.portrait import CAMERA_DISTANCE, HALF_HEIGHT, Portrait
from reenact.progress import preview_file, read_progress
from reenact.retargeting import METHODS
from reenact.retargeting.correspondence import Correspondence, find_correspondence
from reenact.rigs.clip import Clip
from reenact.rigs.files import RIG_SUFFIXES, load_clip, load_rig, read_clip, save_clip
from reenact.rigs.matching import conform
from reenact.rigs.rig import Rig
from reenact.rigs.timeline import resampled
from reenact.run import Run

DEFAULT_CLIP = "synthetic:7:10"
"""Plays where no clip is given and no file holds one."""
EXPORTS = {"csv": "text/csv", "glb": "model/gltf-binary", "json": "application/json", "npz": "application/octet-stream"}
"""Suffixes of `Session.export`, with what the web calls them."""
TRAINED = ("networks", "pairs")
"""Methods of a run, which ask for a checkpoint; a newer one replaces it while the page is open, unless one was
chosen."""

_MARKERS = 300
"""Pairs of places that correspondences are found at, as in `infer --method`."""
_CHUNK = 256
"""Frames that are retargeted between two deliveries, where frames do not depend on each other."""
_FRAME_BY_FRAME = ("networks", "pairs", "copy", "neutral")
_STILL = 1e-6
"""Metres of an adult's face; what a shape moves less does not cross to the page."""
_NEUTRAL_HEIGHT = 0.24
"""Metres that a rig without a face to be found is scaled to."""


class Session:
    """Rigs, the first of them the source, and one clip of it; everything else is made when the page asks.

    Safe to use from several threads: what needs PyTorch runs one at a time.
    """

    def __init__(
        self,
        rigs: dict[str, Rig],
        clip: Clip,
        clip_name: str,
        files: dict[str, Path] | None = None,
        run: Run | None = None,
        method: str | None = None,
        audio: Path | None = None,
        nudges_path: Path | None = None,
        checkpoint: int | None = None,
        device: str = "cpu",
    ) -> None:
        """
        Args:
            rigs: By key; the source first.
            clip: With the source's shapes, in its order.
            clip_name: As the user named it.
            files: Of the rigs that came from one, by key: exports animate the avatar itself, and what animation it
                holds is a method of its own.
            run: Trained on the first two rigs, or in training.
            method: Shown first on every target; the run's networks, or names, or shapes, unless said.
            audio: A .wav that plays along.
            nudges_path: Where corrections are kept, and read from if there are any.
            checkpoint: Step of the run's networks; None follows the newest.
            device: Where they look at pictures.

        Raises:
            ReenactError: An empty clip, an unknown method, or a file of nudges of other rigs.
        """
        if len(clip) == 0:
            raise ReenactError(f"{clip_name}: expected frames to play, got none")
        if audio is not None and (audio.suffix.lower() != ".wav" or not audio.is_file()):
            raise ReenactError(
                f"{audio}: expected a .wav file, got {'none' if not audio.exists() else 'something else'}"
            )
        self.rigs, self.clip, self.clip_name = rigs, clip, clip_name
        self.files, self.run, self.audio, self.nudges_path = files or {}, run, audio, nudges_path
        self.checkpoint, self.device = checkpoint, device
        self.source, *self.targets = rigs
        self._lock, self._made, self._trained_until = threading.RLock(), {}, None
        self._geometry_lock, self._geometry = threading.Lock(), {}
        self.methods = {key: self._methods(key) for key in self.targets}
        for key, known in self.methods.items():
            if method is not None and method not in known:
                raise ReenactError(f"--method: expected one of {', '.join(known)} for {key}, got {method}")
        self.first_method = {key: method or self._first(key) for key in self.targets}
        self.nudges = Nudges({key: rig.names for key, rig in rigs.items()})
        if nudges_path is not None and nudges_path.exists():
            self.nudges = self._checked(load_nudges(nudges_path), str(nudges_path))

    @classmethod
    def open(
        cls,
        inputs: Sequence[str],
        clip: str | None = None,
        method: str | None = None,
        audio: Path | None = None,
        nudges: Path | None = None,
        fps: float | None = None,
        source: str | None = None,
        target: str | None = None,
        checkpoint: str = "newest",
        device: str = "cpu",
    ) -> Session:
        """The session of a run folder, or of rigs by name or file.

        Args:
            inputs: A run, or rigs, the source first.
            clip: Of the source; what its file holds, or `DEFAULT_CLIP`, unless said.
            method: As in the constructor.
            audio: As in the constructor.
            nudges: Where corrections are kept: RUN/nudges.json, or nowhere, unless said.
            fps: Frames per second to play at; the clip's unless said.
            source: Of a run of a cast, by any of its names; the first rig unless said.
            target: Another; the second unless said.
            checkpoint: Of the run; see `load_checkpoint`. Any but the "newest" stays when others come.
            device: As in the constructor.

        Raises:
            ReenactError: Nothing to show, something of it cannot be read, or the device is not there.
            FileNotFoundError: As `Run.open`.
        """
        if not inputs:
            raise ReenactError("view: expected a run folder, or rigs by name or file, got nothing to show")
        check_device(device)
        folders = [each for each in inputs if (Path(each) / "config.toml").is_file()]
        if folders and len(inputs) > 1:
            raise ReenactError(f"view: expected one run folder or some rigs, got {len(inputs)} with {folders[0]}")
        if checkpoint != "newest" and not folders:
            raise ReenactError(f"view: expected a run beside --checkpoint, got {inputs[0]}; leave one of them out")
        run, files, chosen = None, {}, None
        if folders:
            run = Run.open(folders[0])
            rigs = {key: run.rigs[key] for key in run.pair(source, target)}
            named = dict(zip(run.keys, run.config.rigs))
            origins = {key: named[key] for key in rigs}
            nudges = nudges or run.folder / "nudges.json"
            chosen = None if checkpoint == "newest" else load_checkpoint(run.folder, checkpoint).step
        else:
            rigs, origins = {}, {}
            for name in inputs:
                rig = load_rig(name)
                key = rig.name if rig.name not in rigs else f"{rig.name} ({len(rigs) + 1})"
                rigs[key], origins[key] = rig, name
        files = {key: Path(name) for key, name in origins.items() if Path(name).is_file()}
        first = next(iter(rigs))
        if clip is None:
            clip = str(files[first]) if first in files and _own_clip(files[first]) is not None else DEFAULT_CLIP
        played = load_clip(clip, rigs[first])
        played = played if fps is None else resampled(played, fps)
        return cls(rigs, played, clip, files, run, method, audio, nudges, chosen, device)

    @property
    def older(self) -> int | None:
        """Step of the networks that were chosen, where they are not the newest."""
        return None if self.run is None or self.checkpoint == newest_step(self.run.folder) else self.checkpoint

    def describe(self) -> dict[str, Any]:
        """What the page has to know before it asks for numbers."""
        clip, run = self.clip, None
        if self.run is not None:
            run = {"folder": str(self.run.folder), "checkpoint": self.checkpoint or newest_step(self.run.folder)}
            run |= {} if self.checkpoint is None else {"chosen": True}
        return {
            "clip": {"name": self.clip_name, "frames": len(clip), "fps": clip.fps},
            "source": self.source,
            "camera": {"distance": CAMERA_DISTANCE, "half_height": HALF_HEIGHT},
            "rigs": [
                {
                    "key": key,
                    "name": rig.name,
                    "shapes": list(rig.names),
                    "vertices": len(rig.neutral),
                    "faces": len(rig.faces),
                    "textured": rig.texture is not None,
                    "methods": self.methods.get(key, []),
                    "method": self.first_method.get(key, "clip"),
                }
                for key, rig in self.rigs.items()
            ],
            "run": run,
            "audio": self.audio is not None,
            "exports": list(EXPORTS),
            "kept": None if self.nudges_path is None else str(self.nudges_path),
            "nudges": [vars(nudge) for nudge in self.nudges.items if nudge.clip == self.clip_name],
        }

    def geometry(self, key: str) -> bytes:
        """A rig as safetensors, framed as its portrait frames it, so that a metre is one of an adult's face.

        `neutral` (V, 3), `faces` (F, 3), `outward` (F,) 1 where backs cannot be seen, `colors` (V, 3) bytes of sRGB;
        shape k moves the vertices `shape_vertices[shape_starts[k]:shape_starts[k + 1]]` by the same rows of
        `shape_offsets`. With a texture, which cuts the surface along seams, `corners` are the vertices of what is
        drawn, `uv` where they lie in the texture, and `triangles` index both.
        """
        with self._geometry_lock:  # not the other: a page opens while a method is prepared
            if key not in self._geometry:
                self._geometry[key] = _packed(self.rigs[key])
            return self._geometry[key]

    def progress(self) -> dict[str, Any]:
        """How far the training of the run is, as `Progress` has it.

        Raises:
            ReenactError: There is no run.
        """
        return asdict(read_progress(self._opened_run()))

    def preview(self, step: int) -> bytes:
        """The picture of a step of the training, as PNG.

        Raises:
            ReenactError: There is no run, or no picture of that step.
        """
        path = preview_file(self._opened_run(), step)
        if not path.is_file():
            raise ReenactError(f"preview: expected a step with a picture, got {step}")
        return path.read_bytes()

    def texture(self, key: str) -> bytes:
        """The rig's texture as PNG.

        Raises:
            ReenactError: It has none.
        """
        texture = self.rigs[key].texture
        if texture is None:
            raise ReenactError(f"{key}: expected a rig with a texture, got one without")
        packed = io.BytesIO()
        pixels = (texture.detach().cpu().numpy() * 255).round().clip(0, 255).astype(np.uint8)
        Image.fromarray(pixels).save(packed, format="PNG", compress_level=1)
        return packed.getvalue()

    def track(
        self, key: str, method: str, weights: Float[Tensor, "T Ks"] | None = None
    ) -> Iterator[Float[Tensor, "_frames K"]]:
        """The clip on one rig, in pieces as they are ready.

        Args:
            key: Of the rig.
            method: Of `methods`; "clip" for the source.
            weights: Play these of the source instead of the clip.

        Raises:
            ReenactError: No such method for this rig, or it cannot work on it.
        """
        clip = self.clip if weights is None else Clip(self.clip.names, weights, self.clip.fps)
        clip = replace(clip, rotations=None)  # the page does not turn heads
        if key == self.source and method == "clip":
            yield clip.weights.float()
            return
        if method not in self.methods.get(key, ()):
            raise ReenactError(
                f"{key}: expected a method of {', '.join(self.methods.get(key, ('clip',)))}, got {method}"
            )
        if method == "file" and weights is not None:
            raise ReenactError(f"{key}: expected a method that follows the source, got the animation of a file")
        with self._lock, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # which shapes have no partner is to be seen
            if method in TRAINED:
                self._forget_older_networks()
            retarget = self._once((key, method), lambda: self._retargeter(key, method))
        size = _CHUNK if method in _FRAME_BY_FRAME else max(1, len(clip))
        for rows in clip.weights.split(size):
            with self._lock:
                made = retarget(replace(clip, weights=rows))
            yield made.weights.detach().float()

    def export(self, key: str, weights: Float[Tensor, "T K"], suffix: str) -> bytes:
        """A file of `EXPORTS` with the weights as the rig's clip: a table or take, or the rig itself, animated.

        Raises:
            ReenactError: Another suffix, or weights that are no clip.
        """
        if suffix not in EXPORTS:
            raise ReenactError(f"export: expected one of {', '.join(EXPORTS)}, got {suffix[:20]}")
        rig = self.rigs[key]
        rotations = self.clip.rotations
        rotations = rotations if rotations is not None and len(rotations) == len(weights) else None
        clip = Clip(rig.names, weights, self.clip.fps, rotations)
        avatar = self.files.get(key)
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            path = Path(folder) / f"clip.{suffix}"
            save_clip(clip, path, rig, None if avatar is None else str(avatar))
            return path.read_bytes()

    def keep(self, document: Any) -> None:
        """Nudges of this clip that the page sends, written where they are kept; those of other clips stay.

        Raises:
            ReenactError: They are not nudges of these rigs and this clip, or are kept nowhere.
            OSError: The file cannot be written.
        """
        if self.nudges_path is None:
            raise ReenactError("nudges: expected a file to keep them in, got none; start the viewer with --nudges FILE")
        sent = self._checked(parse_nudges(document, "nudges"), "nudges")
        strange = [nudge for nudge in sent.items if nudge.clip != self.clip_name or nudge.frame >= len(self.clip)]
        if strange:
            raise ReenactError(
                f"nudges: expected frames 0..{len(self.clip) - 1} of {self.clip_name}, got frame {strange[0].frame} of "
                f"{strange[0].clip[:200]}"
            )
        with self._lock:
            others = tuple(nudge for nudge in self.nudges.items if nudge.clip != self.clip_name)
            self.nudges = replace(self.nudges, items=(*others, *sent.items))
            save_nudges(self.nudges, self.nudges_path)

    def _checked(self, nudges: Nudges, where: str) -> Nudges:
        own = {key: rig.names for key, rig in self.rigs.items()}
        if any(own.get(key, names) != names for key, names in nudges.rigs.items()):
            raise ReenactError(
                f"{where}: expected nudges of these rigs, got other shapes; name another file by --nudges"
            )
        return replace(nudges, rigs={**nudges.rigs, **own})

    def _methods(self, key: str) -> list[str]:
        """What can move a target, the most useful first."""
        target, known = self.rigs[key], []
        if self.run is not None and key == self.targets[0]:
            known += [each for each in TRAINED if each != "pairs" or self.run.config.pairs.method != "none"]
        known += ["file"] if key in self.files and _own_clip(self.files[key]) is not None else []
        known += ["truth"] if self._true(target, torch.zeros(1, len(self.clip.names))) is not None else []
        return known + list(METHODS)

    def _first(self, key: str) -> str:
        return next(name for name in ("networks", "file", "truth", "shape-matching") if name in self.methods[key])

    def _true(self, target: Rig, weights: Tensor) -> Tensor | None:
        """What the target should do as far as names tell; None where they tell nothing."""
        from reenact.truth import true_weights

        _, truth, shapes = true_weights(self.rigs[self.source], target, weights)
        return truth if shapes else None

    def _retargeter(self, key: str, method: str) -> Callable[[Clip], Clip]:
        source, target = self.rigs[self.source], self.rigs[key]
        if method == "networks":
            return self._networks()
        if method == "pairs":
            networks = self._networks()
            return lambda clip: replace(clip, names=target.names, weights=networks.paired(clip.weights))
        if method == "file":
            clip = _own_clip(self.files[key])
            return lambda played: _fitted(resampled(conform(clip, target), self.clip.fps), len(played))
        if method == "truth":
            return lambda clip: replace(clip, names=target.names, weights=self._true(target, clip.weights))
        found = None
        if method not in ("copy", "neutral"):
            found = self._once(("correspondence", key), lambda: self._correspondence(key))
        return METHODS[method](source, target, found, None)

    def _correspondence(self, key: str) -> Correspondence:
        """From the source to a target: that of the run, or found now, which takes seconds."""
        known = None if self.run is None else self.run.correspondence(self.source, key)
        return find_correspondence(self.rigs[self.source], self.rigs[key], _MARKERS) if known is None else known

    def _opened_run(self) -> Run:
        if self.run is None:
            raise ReenactError("run: expected the folder of one, got rigs alone; name it to `reenact view`")
        return self.run

    def _forget_older_networks(self) -> None:
        """Drop what was made of another checkpoint than the newest one.

        Raises:
            ReenactError: There is none yet.
        """
        if self.checkpoint is not None:
            return
        newest = newest_step(self.run.folder)
        if newest is None:
            due = read_progress(self.run).next_checkpoint
            raise ReenactError(f"{self.run.folder}: no checkpoint yet; the first is due at step {due:,}")
        if newest != self._trained_until:
            self._made = {name: made for name, made in self._made.items() if name[-1] not in TRAINED}
            self._trained_until = newest

    def _networks(self) -> Any:
        from reenact.inference import ImageRetargeter

        source, target = self.rigs
        which = "newest" if self.checkpoint is None else str(self.checkpoint)
        named = {"source": source, "target": target, "checkpoint": which, "device": self.device}
        return self._once(("networks",), lambda: ImageRetargeter.load(self.run.folder, **named))

    def _once(self, name: tuple[str, ...], make: Callable[[], Any]) -> Any:
        """What was made under this name before, or now."""
        with self._lock:
            if name not in self._made:
                self._made[name] = make()
            return self._made[name]


def _own_clip(path: Path) -> Clip | None:
    """The animation of shapes that a rig's file holds; None without one."""
    if path.suffix.lower() not in RIG_SUFFIXES or path.suffix.lower() in (".npz", ".obj"):
        return None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return read_clip(path)
        except ReenactError:
            return None


def _fitted(clip: Clip, frames: int) -> Clip:
    """As many frames as asked for: cut, or held at the last."""
    rows = torch.arange(frames).clamp(max=len(clip) - 1)
    return replace(clip, weights=clip.weights[rows], rotations=None)


def _framing(rig: Rig) -> tuple[float, Tensor]:
    """Scale and position that put the face where every portrait has it; the whole mesh where no face is found."""
    try:
        portrait = Portrait.of(rig)
        return portrait.scale, portrait.position
    except ReenactError:
        low, high = rig.neutral.amin(0), rig.neutral.amax(0)
        scale = _NEUTRAL_HEIGHT / float((high - low).max().clamp_min(1e-12))
        return scale, -scale * (low + high) / 2


def _packed(rig: Rig) -> bytes:
    scale, position = _framing(rig)
    deltas = (scale * rig.deltas).numpy().astype(np.float32)
    moved = np.abs(deltas).max(-1) > _STILL  # (K, V)
    colors = torch.ones_like(rig.neutral) if rig.colors is None else rig.colors
    arrays = {
        "neutral": (scale * rig.neutral + position).numpy().astype(np.float32),
        "faces": rig.faces.numpy().astype(np.uint32),
        "outward": outward_faces(rig.neutral.double().numpy(), rig.faces.numpy()).astype(np.uint8),
        "colors": (colors.numpy() * 255).round().clip(0, 255).astype(np.uint8),
        "shape_starts": np.concatenate([[0], moved.sum(1).cumsum()]).astype(np.uint32),
        "shape_vertices": np.nonzero(moved)[1].astype(np.uint32),
        "shape_offsets": deltas[moved],
    }
    if rig.texture is not None and rig.uv is not None:
        uv_faces = rig.faces if rig.uv_faces is None else rig.uv_faces
        pairs = np.stack([rig.faces.numpy().ravel(), uv_faces.numpy().ravel()], axis=1)
        pairs, triangles = np.unique(pairs, axis=0, return_inverse=True)
        arrays["corners"] = pairs[:, 0].astype(np.uint32)
        arrays["uv"] = rig.uv.numpy()[pairs[:, 1]].astype(np.float32)
        arrays["triangles"] = triangles.reshape(-1, 3).astype(np.uint32)
    return save({name: np.ascontiguousarray(array) for name, array in arrays.items()})
