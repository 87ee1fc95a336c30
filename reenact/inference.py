"""ImageRetargeter: a trained run as a `Retargeter`, clip to clip through pictures.

Kim et al. 2021, "Deep Learning-Based Unsupervised Human Facial Retargeting", doi:10.1111/cgf.14400,
section 3: render the source, redraw it as the target with ReenactNet, read the weights with BPNet.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from reenact.checkpoint import load_checkpoint, newest_step
from reenact.data import Studio, check_device
from reenact.errors import ReenactError
from reenact.models import Networks
from reenact.pairs import Teacher
from reenact.postprocessing import smoothed
from reenact.rigs.clip import Clip
from reenact.run import Run

_CHUNK = 64
"""Frames that are in memory as pictures at once."""
_TREMOR = 0.08
"""How far a weight strays by errors of reading, at most."""


class ImageRetargeter:
    """Moves motion from `source` to `target` through a shared picture space.

    Weights and pictures come from and go to the CPU, wherever networks and renderer work.
    """

    def __init__(
        self,
        run: Run,
        source: Studio,
        target: Studio,
        networks: Networks,
        keys: tuple[str, str],
        older: int | None = None,
    ):
        """`source` and `target` must be studios of the run that trained the networks, `keys` their keys; `older` is the
        step of the networks where they are not the newest; see `load`."""
        self.run, self.older = run, older
        self.source, self.target = source.rig, target.rig
        self.source_studio, self.target_studio = source, target
        self.networks, self.keys = networks, keys

    @classmethod
    def load(
        cls,
        folder: Path | str,
        reverse: bool = False,
        source: str | None = None,
        target: str | None = None,
        device: str = "cpu",
        checkpoint: str = "newest",
    ) -> ImageRetargeter:
        """The retargeter that a run trained.

        Args:
            folder: The run.
            reverse: From its target to its source.
            source: A rig of a cast; see `Run.pair`.
            target: Another.
            device: Where pictures are rendered and networks run; clips and what they become stay on the CPU.
            checkpoint: Whose networks: the "newest", the "best", or a step; see `load_checkpoint`.

        Raises:
            FileNotFoundError: There is no run, or nothing was saved yet.
            ReenactError: The run is damaged, or of another version, or has no such rig or checkpoint; the device is not
                there.
        """
        check_device(device)
        run = Run.open(folder)
        keys = run.pair(source, target)
        keys = keys[::-1] if reverse else keys
        saved = load_checkpoint(run.folder, checkpoint)
        older = saved.step if checkpoint != "newest" and saved.step != newest_step(run.folder) else None
        networks = run.trained_networks(saved).to(device).freeze()
        return cls(run, run.studio(keys[0], device), run.studio(keys[1], device), networks, keys, older)

    @torch.inference_mode()
    def __call__(self, clip: Clip, watch: Callable[[Sequence[Tensor]], Iterable[Tensor]] = iter) -> Clip:
        """The clip on the target, weights in [0, 1]: each frame as it is read, then steadied (`bpnet.steady`).

        Args:
            clip: Of the source.
            watch: Goes through a list and tells someone how far it is, such as `rich.progress.track`.

        Raises:
            ReenactError: The clip's names are not the source's; `reenact.rigs.files.load_clip` puts them in order.
        """
        if clip.names != self.source.names:
            raise ReenactError(
                f"clip: expected the {len(self.source.names)} names of {self.source.name} in their order, got "
                f"{', '.join(clip.names[:3])} and so on; `reenact.rigs.files.conform` gives it those"
            )
        read = torch.cat([self._retarget(chunk) for chunk in watch(clip.weights.split(_CHUNK))])
        steady = smoothed(read, self.run.config.bpnet.steady * clip.fps, _TREMOR)
        return replace(clip, names=self.target.names, weights=steady)

    @torch.inference_mode()
    def step(self, weights: Float[Tensor, "Ks"]) -> Float[Tensor, "Kt"]:
        """Weights of one frame, in [0, 1]; the same as in a clip before it is steadied, which takes later frames."""
        return self._retarget(weights[None])[0]

    def _retarget(self, weights: Float[Tensor, "N Ks"]) -> Float[Tensor, "N Kt"]:
        """As `read` of `reenact` of `source_pictures`, without drawing colours that nobody looks at."""
        return self.networks.retarget(self.source_studio.glance(weights), *self.keys).clamp(0, 1).cpu()

    def source_pictures(self, weights: Float[Tensor, "N Ks"]) -> Float[Tensor, "N C R R"]:
        """The source as the networks see it, before its neutral is subtracted: colours, then the motion pass."""
        return self.source_studio.photograph(weights).cpu()

    def target_pictures(self, weights: Float[Tensor, "N Kt"]) -> Float[Tensor, "N C R R"]:
        """The target in the shared layout: colours, then the motion pass."""
        return self.target_studio.photograph(weights).cpu()

    def source_masks(self, weights: Float[Tensor, "N Ks"]) -> Float[Tensor, "N 1 R R"]:
        """Coverage of the source's pictures."""
        return self.source_studio.photograph(weights, ("mask",)).cpu()

    def target_masks(self, weights: Float[Tensor, "N Kt"]) -> Float[Tensor, "N 1 R R"]:
        """Coverage of the target's pictures in the shared layout."""
        return self.target_studio.photograph(weights, ("mask",)).cpu()

    @torch.inference_mode()
    def reenact(self, pictures: Float[Tensor, "N C R R"]) -> Float[Tensor, "N C R R"]:
        """Pictures of the source redrawn as the target, in the shared layout, colours in [0, 1]."""
        shown = self.source_studio.show(pictures.to(self.source_studio.device))
        return self.target_studio.picture(self.networks.redraw(shown, *self.keys)).cpu()

    @torch.inference_mode()
    def read(self, pictures: Float[Tensor, "N C R R"]) -> Float[Tensor, "N Kt"]:
        """Weights of the target that make the pictures, clamped to [0, 1]."""
        shown = self.target_studio.show(pictures.to(self.target_studio.device))
        return self.networks.read(shown, self.keys[1]).clamp(0, 1).cpu()

    @torch.inference_mode()
    def read_direct(self, pictures: Float[Tensor, "N C R R"]) -> Float[Tensor, "N Kt"]:
        """Weights read from the source's own pictures by the target's BPNet: what ReenactNet has to beat."""
        shown = self.source_studio.show(pictures.to(self.source_studio.device))
        return self.networks.read(shown, self.keys[1]).clamp(0, 1).cpu()

    @torch.inference_mode()
    def paired(self, weights: Float[Tensor, "N Ks"]) -> Float[Tensor, "N Kt"] | None:
        """The target's weights as the networks were taught, without any network; None if nobody taught them.

        Where every shape has its partner this is copying by look, which a network that learns from it cannot beat.
        """
        if self.run.config.pairs.method == "none":
            return None
        return self._teacher.weights(weights)

    @cached_property
    def _teacher(self) -> Teacher:
        return self.run.teacher(self.source_studio, self.target_studio, *self.keys)
