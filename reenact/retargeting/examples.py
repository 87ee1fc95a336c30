"""Examples for `plbs`: which expressions of a rig tell most, and what the source does where only the target is known.

AnaConDaR, 2024, does "not make the common assumption that for each target example a matching source expression must be
known"; it finds one "by a data-driven embedding of the target examples in the source domain". How stands in a section
that we do not have: what is here is ours.

Symbol    Code        Shape
T_E       examples    (E, Vt, 3)
S         sequence    (T, Vs, 3) what the source is seen doing
S_E       of `embed`  (E, Vs, 3)
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from reenact.errors import ReenactError
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.deformation_transfer import DeformationTransfer
from reenact.retargeting.inverse_rig import nonnegative_least_squares
from reenact.retargeting.plbs import PatchConfig, Patches, check_examples
from reenact.rigs import motion
from reenact.rigs.rig import Rig

CANDIDATES = 250
"""Random expressions among which `choose` looks, beside the single shapes."""


def choose(
    rig: Rig, count: int, candidates: Float[Tensor, "N K"] | None = None, patches: Patches | None = None
) -> Float[Tensor, "E K"]:
    """Weights of the expressions that explain all candidates best, patch by patch; the most telling first.

    An expression that moves brows, lids and mouth at once tells of all three, since patches mix it separately. So each
    next one is that which takes most from what the candidates' motion in each patch leaves unexplained by those before.

    Args:
        rig: Whose expressions.
        count: How many; fewer come back where fewer explain all.
        candidates: Weights to choose from; the single shapes and `CANDIDATES` random expressions where None.
        patches: Of the rig; as `PatchConfig` has them where None.

    Raises:
        ReenactError: No expression is asked for, or the candidates are not weights of the rig.

    Source: pivoted Gram-Schmidt, as for choosing columns of a matrix, summed over patches; ours.
    """
    if count < 1:
        raise ReenactError(f"examples: expected at least 1, got {count}")
    if candidates is None:
        random = motion.expressions(rig.names, CANDIDATES, seed=0)
        candidates = torch.cat([torch.eye(len(rig.names)), random])
    if candidates.shape[1] != len(rig.names):
        raise ReenactError(f"{rig.name}: expected weights (N, {len(rig.names)}), got {tuple(candidates.shape)}")
    patches = patches or Patches.of(rig, PatchConfig.patches, PatchConfig.rings)
    columns = patches.shares.tocsc()
    left = []
    for patch in range(len(patches)):
        own = columns[:, [patch]].tocoo()
        deltas = rig.deltas[:, own.coords[0]].double() * torch.from_numpy(own.data).sqrt()[:, None]
        moved = candidates.double() @ deltas.flatten(1)  # (N, 3 M)
        left.append(moved @ moved.T)
    unexplained = torch.stack(left)  # (P, N, N) inner products of the candidates in each patch
    start = unexplained.diagonal(dim1=1, dim2=2)  # (P, N)
    floor = 1e-9 * start.amax(1, keepdim=True)
    chosen: list[int] = []
    while len(chosen) < min(count, len(candidates)):
        own = unexplained.diagonal(dim1=1, dim2=2)
        gains = torch.where(own > floor, unexplained.square().sum(1) / own.clamp_min(1e-300), 0).sum(0)
        gains[chosen] = 0
        best = int(gains.argmax())
        if not gains[best] > 1e-9 * start.sum():
            break
        chosen.append(best)
        column, pivot = unexplained[:, :, best], own[:, best]
        share = torch.where(pivot > floor[:, 0], 1 / pivot.clamp_min(1e-300), 0)
        unexplained = unexplained - share[:, None, None] * column[:, :, None] * column[:, None, :]
    if not chosen:
        raise ReenactError(f"{rig.name}: expected candidates that move the face, got {len(candidates)} that do not")
    return candidates[chosen]


def embed(
    source: Rig,
    target: Rig,
    examples: Float[Tensor, "E Vt 3"],
    correspondence: Correspondence,
    sequence: Float[Tensor, "T Vs 3"],
) -> Float[Tensor, "E Vs 3"]:
    """What the source would do where the target shows the examples: mixtures of what the source is seen doing.

    The examples' deformation is carried to the source, and each becomes the non-negative mixture of frames that comes
    closest. A mixture of real frames has the source's own way of moving, which the carried example lacks.

    Amplitudes are geometric: how far the target moves is taken for how far the source does. Where more is known of how
    both rigs' shapes belong together, give the source's expressions instead.

    Args:
        source: In whose expressions the examples are embedded.
        target: Whose examples they are.
        examples: Meshes, metres.
        correspondence: Pairs from source to target.
        sequence: Frames of the source, the more different the better; a few hundred are enough.

    Raises:
        ReenactError: Meshes do not fit their rigs, or the frames do not move.
    """
    check_examples(target, examples)
    check_examples(source, sequence)
    back = DeformationTransfer(target, source, correspondence.reversed())
    neutral, seen = source.neutral.double(), back.covered.sqrt()[:, None]
    frames = (sequence.double() - neutral).flatten(1)
    weighted = ((sequence.double() - neutral) * seen).flatten(1)
    if not bool(weighted.abs().amax() > 0):
        raise ReenactError(f"{source.name}: expected frames that move, got {len(sequence)} neutral ones")
    carried = ((back.transfer(examples.double()) - neutral) * seen).flatten(1)
    weights = nonnegative_least_squares(weighted @ weighted.T, carried @ weighted.T)
    return (neutral + (weights @ frames).unflatten(1, neutral.shape)).to(sequence.dtype)
