"""AnaConDaR: what a few examples of the target explain, the rest by its anatomy, and a simulation over both.

"Anatomically Constrained Data-Adaptive Facial Retargeting", 2024 (AC24). Of the paper we have the text up to Eq. 1: its
structure and notation are theirs, and nearly all equations in `plbs`, `examples`, `anatomical_transfer` and `physics`
are our reconstruction. Do not take our numbers for those of the paper.

Symbol          Code                     Shape
S_i             vertices                 (T, Vs, 3) frames of the source
T_E, S_E        examples, counterparts   (E, Vt, 3), (E, Vs, 3)
S^P_i, T^P_i    Stages.explained, shown  what the examples say, on the source and on the target
S^M_i           Stages.missing           (T, Vs, 3) S + S_i - S^P_i
T^M_i           Stages.transferred       (T, Vt, 3) S^M_i, transferred
                Stages.combined          (T, Vt, 3) T^P_i + T^M_i - T
T_i             Stages.vertices          (T, Vt, 3) after the simulation
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reenact.errors import ReenactError
from reenact.retargeting.anatomical_transfer import AnatomicalTransfer
from reenact.retargeting.anatomy import Shell, build_shell, carry_shell
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.deformation_transfer import DeformationTransfer, densify
from reenact.retargeting.examples import choose, embed
from reenact.retargeting.inverse_rig import InverseRig
from reenact.retargeting.landmarks import smoothed, smoothing_matrix
from reenact.retargeting.physics import FacePhysics, PhysicsConfig, features
from reenact.retargeting.plbs import PatchConfig, PatchwiseBlendshapes, check_examples
from reenact.retargeting.retargeter import check_names
from reenact.retargeting.shape_matching import ShapeMatching
from reenact.rigs import motion
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig

_CHUNK = 32  # frames at a time: bounds memory, not results
_LEAST_TRUST = 1 / 64  # of the skin's hold, where pairs are unsure


@dataclass(frozen=True)
class AnacondarConfig:
    """Which parts take part, and how."""

    examples: int = 15
    """Expressions of the target that are chosen where none are given."""
    pairing: Literal["shapes", "embedding"] = "shapes"
    """How source expressions are found for examples without any: `shapes` takes an example's weights to the source's
    shapes by `ShapeMatching`, which believes that a full smile means a full smile; `embedding` goes by geometry alone,
    see `examples.embed`. Examples given as meshes are always embedded."""
    patches: PatchConfig = field(default_factory=lambda: PatchConfig(ridge=1e-2))
    """Of the blendshapes; 1 patch leaves patches out. The ridge is higher than alone: what examples only explain by
    mixing them far beyond themselves is better left to the transfer."""
    blendshapes: bool = True
    """Without, everything is transferred, and examples are not looked at."""
    transfer: Literal["anatomical", "surface", "none"] = "anatomical"
    """What carries the part that examples do not explain: tissue, deformation transfer of the surface, or nothing."""
    physics: PhysicsConfig | None = field(default_factory=PhysicsConfig)
    """Weights of the simulation; None leaves it out."""
    characteristics: Literal["source", "target"] = "source"
    """Whose slits, widths and contours the simulation keeps: those of the source's frame, in the target's size, or what
    examples and transfer have made of them. The latter also where the source's cannot be told, see `_trusted`."""

    doubt: float = 4.0
    """Power of the pairs' confidence by which the simulation holds the skin less to its target, down to a 64th: where
    pairs are unsure, its target is noise more often. 0 holds it everywhere alike."""


@dataclass(frozen=True)
class Stages:
    """All that happens to a clip on its way, metres; in the frames of the two rigs."""

    explained: Float[Tensor, "T Vs 3"]
    shown: Float[Tensor, "T Vt 3"]
    missing: Float[Tensor, "T Vs 3"]
    transferred: Float[Tensor, "T Vt 3"]
    combined: Float[Tensor, "T Vt 3"]
    vertices: Float[Tensor, "T Vt 3"]


class Anacondar:
    """Retargets meshes, of the source's topology, with a handful of examples of the target."""

    def __init__(
        self,
        source: Rig,
        target: Rig,
        correspondence: Correspondence | None = None,
        training: Clip | None = None,
        *,
        config: AnacondarConfig | None = None,
        examples: Tensor | None = None,
        counterparts: Tensor | None = None,
        shell: Shell | None = None,
        stiffness: Float[Tensor, "Vt"] | None = None,
    ) -> None:
        """
        Examples and counterparts are meshes, (E, V, 3), or weights of the rig, (E, K). Where examples are not given,
        expressions that tell much are chosen from the target's own shapes. Where counterparts are not given, they rest
        on the found correspondence alone (`AnacondarConfig.pairing`); names of shapes are never compared here.

        Args:
            source: Where motion comes from.
            target: Where it goes to.
            correspondence: Pairs; see `densify`.
            training: Source clip whose frames examples are embedded in; random expressions where None.
            config: Which parts take part.
            examples: Of the target.
            counterparts: The same expressions of the source.
            shell: Tissue of the target, as from `build_shell` with thicknesses of one's own.
            stiffness: Factor of the tissue's stiffness under each vertex of the target; see `FacePhysics`.

        Raises:
            ReenactError: There is no correspondence; the clip, examples or counterparts do not fit the rigs or each
                other; or the target's shapes move no face.
        """
        self.source, self.target, self.config = source, target, config or AnacondarConfig()
        dense = densify(source, target, correspondence)
        self.blendshapes = None
        if self.config.blendshapes:
            if examples is None:
                examples = choose(target, self.config.examples)
            if counterparts is None:
                counterparts = self._counterparts(examples, correspondence, dense, training)
            self.blendshapes = PatchwiseBlendshapes(
                source, target, _meshes(source, counterparts), _meshes(target, examples), dense, self.config.patches
            )
        self.shell = shell
        """Tissue of the target, where it takes part."""
        if shell is None and (self.config.transfer == "anatomical" or self.config.physics is not None):
            self.shell = build_shell(target)
        self.transfer: AnatomicalTransfer | DeformationTransfer | None = None
        if self.config.transfer == "anatomical":
            self.transfer = AnatomicalTransfer(source, target, dense, shell=self.shell)
        elif self.config.transfer == "surface":
            self.transfer = DeformationTransfer(source, target, dense)
        self.physics = None
        if self.config.physics is not None:
            trust = _confidence(self.shell, dense).pow(self.config.doubt).clamp_min(_LEAST_TRUST)
            self.physics = FacePhysics(self.shell, self.config.physics, stiffness=stiffness, trust=trust)
            anatomical = isinstance(self.transfer, AnatomicalTransfer)
            self.source_shell = self.transfer.source_shell if anatomical else carry_shell(self.shell, source, dense)
            """The same tissue in the source."""
            self._trusted = _trusted(self.source_shell, self.shell)
        self._inverse = InverseRig(target)

    def __call__(self, clip: Clip) -> Clip:
        """The clip on the target: bounded least squares of `vertices(clip)`, weights in [0, 1]."""
        weights = [self._inverse(stages.vertices) for stages in self._frames(clip)]
        empty = clip.weights.new_zeros(0, len(self.target.names))
        return replace(clip, names=self.target.names, weights=torch.cat([empty, *weights]).float())

    def vertices(self, clip: Clip) -> Float[Tensor, "T V 3"]:
        """Target vertices in metres, outside the span of the target's own shapes."""
        frames = [stages.vertices for stages in self._frames(clip)]
        return torch.cat([self.target.neutral.new_zeros(0, len(self.target.neutral), 3), *frames])

    def stages(self, vertices: Float[Tensor, "T Vs 3"], force: Float[Tensor, "*shape"] | None = None) -> Stages:
        """Every step of the way.

        Args:
            vertices: Meshes of the source.
            force: On the target's tissue, such as (0, -1, 0) for gravity; see `FacePhysics`.

        Raises:
            ReenactError: Something has the wrong shape, or there is a force and no simulation.
        """
        check_examples(self.source, vertices)
        if force is not None and self.physics is None:
            raise ReenactError(f"{self.target.name}: a force needs the simulation, which the config leaves out")
        source_neutral, neutral = self.source.neutral.double(), self.target.neutral.double()
        explained = source_neutral.expand(len(vertices), -1, 3)
        shown = transferred = neutral.expand(len(vertices), -1, 3)
        if self.blendshapes is not None:
            weights = self.blendshapes.weights(vertices)
            explained, shown = self.blendshapes.explained(weights), self.blendshapes.shown(weights)
        missing = source_neutral + vertices.double() - explained
        if self.transfer is not None:
            transferred = self.transfer.transfer(missing)
        settled = combined = shown + (transferred - neutral)
        if self.physics is not None:
            kept: Tensor | None = None
            if self.config.characteristics == "source":
                own = features(self.shell, combined)
                kept = torch.where(self._trusted[:, None], features(self.source_shell, vertices), own)
            settled = self.physics(combined, states=self.shell.fill(combined), features=kept, force=force)
        stages = (explained, shown, missing, transferred, combined, settled)
        return Stages(*(each.to(vertices.dtype) for each in stages))

    def _frames(self, clip: Clip) -> Iterator[Stages]:
        check_names(clip, self.source)
        for weights in clip.weights.split(_CHUNK):
            if len(weights):
                yield self.stages(self.source.vertices(weights))

    def _counterparts(
        self, examples: Tensor, sparse: Correspondence | None, dense: Correspondence, training: Clip | None
    ) -> Tensor:
        if self.config.pairing == "shapes" and examples.ndim == 2:
            _meshes(self.target, examples)
            matching = ShapeMatching(self.target, self.source, (sparse or dense).reversed())
            return matching(Clip(self.target.names, examples, 30.0)).weights
        if training is None:
            weights = motion.expressions(self.source.names, 300, seed=0)
        else:
            check_names(training, self.source)
            weights = training.weights[:: max(1, len(training) // 300)]
        return embed(self.source, self.target, _meshes(self.target, examples), dense, self.source.vertices(weights))


def _trusted(source: Shell, target: Shell) -> Bool[Tensor, "C"]:
    """Characteristics that the shapes of both rigs move about as far, from 0.4 to 2.5 times.

    Where a pair of places is wrong by the thickness of a lip, both ends of a slit may lie on one lip of the source.
    Such a slit never opens there, and would sew the target's mouth up.
    """
    ranges = []
    for shell in (source, target):
        shapes = shell.rig.vertices(torch.eye(len(shell.rig.names)))
        parts = [features(shell, part).norm(dim=-1).amax(0) for part in shapes.split(_CHUNK)]
        ranges.append(torch.stack(parts).amax(0))
    return (ranges[0] > 0.4 * ranges[1]) & (ranges[0] < 2.5 * ranges[1])


def _confidence(shell: Shell, pairs: Correspondence, steps: int = 8) -> Float[Tensor, "V"]:
    """How sure the pairs around each vertex of the target are, 0 to 1; 1 outside the tissue and far from any pair.

    Both the confidences and how many there are spread over the skin for some steps.
    """
    corners, shares = pairs.target.corners.ravel().numpy(), pairs.target.shares.double().ravel().numpy()
    weighed = shares * pairs.confidence.double().repeat_interleave(3).numpy()
    numbers, size = shell.vertices.numpy(), len(shell.rig.neutral)
    smoother = smoothing_matrix(shell.skin_faces, len(shell))
    sums, counts = (
        smoothed(smoother, np.bincount(corners, values, size)[numbers], steps) for values in (weighed, shares)
    )
    confidence = torch.ones(size, dtype=torch.float64)
    confidence[shell.vertices] = torch.from_numpy(np.where(counts > 1e-6, sums / np.maximum(counts, 1e-6), 1.0))
    return confidence.clamp(0, 1)


def _meshes(rig: Rig, expressions: Tensor) -> Float[Tensor, "E V 3"]:
    """Meshes as they are, weights as the rig shows them."""
    if expressions.ndim not in (2, 3) or len(expressions) == 0:
        raise ReenactError(
            f"{rig.name}: expected examples as meshes (E, {len(rig.neutral)}, 3) or weights (E, {len(rig.names)}), got "
            f"{tuple(expressions.shape)}"
        )
    if expressions.ndim == 2:
        return rig.vertices(expressions)
    check_examples(rig, expressions)
    return expressions
