"""What a target should do, as far as names tell: the truth that answers are measured against.

Ours. Methods never see it; where a method reads names, the tables say so.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import lsq_linear
from torch import Tensor

from reenact.rigs.matching import matching
from reenact.rigs.rig import Rig


def true_weights(
    source: Rig, target: Rig, weights: Float[Tensor, "T Ks"]
) -> tuple[Float[Tensor, "T Ks"], Float[Tensor, "T Kt"], list[int]]:
    """What the target should do, as far as names tell.

    Between rigs that share names the same shapes get the same weights (`matching`). Equal names promise equal meaning
    only between rigs of one maker; across makers a part of the error is a difference of opinion between sculptors. A
    merged character (`anny:merged`) shares names but not ranges, and stands for the full set that it was made from by a
    known matrix: from it the weights are those of the full set, to it they are the bounded least-squares fit to the
    full set's vertices. So it is for a built-in character with other shapes altogether (`anny:units`): its own head
    with ARKit's shapes says what it should do.

    Returns:
        The source's weights with every shape at rest whose meaning the target does not know; the target's weights;
        and the indices of the target's shapes that the truth covers, none where the rigs share no name.
    """
    full_source, source_matrix = _unmerged(source)
    full_target = _told_by(full_source, target)
    shared = matching(full_source.names, full_target.names)
    there = shared.any(0).nonzero().flatten().tolist()
    known = weights.clone()
    known[:, source_matrix[~shared.any(1)].abs().sum(0) > 0] = 0
    truth = known @ source_matrix.T @ shared
    if full_target is target:
        return known, truth.clamp(0, 1), there
    return known, _fit(full_target, truth, target), list(range(len(target.names))) if there else []


def true_return(source: Rig, target: Rig, truth: Float[Tensor, "T Kt"]) -> Float[Tensor, "T Ks"]:
    """The source's weights that come back where the target shows the truth and both ways are exact.

    What they lack is what the target cannot show: cyclic numbers of a faithful method end about there. In [0, 1]. Ours.

    Args:
        source: Where motion came from, and comes back to.
        target: Between both, of names that `true_weights` knows.
        truth: What `true_weights` asks of the target.
    """
    full_source = _unmerged(source)[0]
    full_target = _told_by(full_source, target)
    shown = truth if full_target is target else _fit(target, truth, full_target)
    back = shown @ matching(full_target.names, full_source.names)
    return back if full_source is source else _fit(full_source, back, source)


def _told_by(source: Rig, target: Rig) -> Rig:
    """The target's head with the shapes that the source's names tell of; the target itself where its own are those."""
    if not matching(source.names, target.names).any():
        return _in_arkit(target)
    return _unmerged(target)[0]


def _in_arkit(rig: Rig) -> Rig:
    """The head of a built-in character with ARKit's shapes; other rigs as they are."""
    from reenact.rigs import anny

    return anny.with_arkit_shapes(rig.name) if rig.name in anny.CAST else rig


def _unmerged(rig: Rig) -> tuple[Rig, Tensor]:
    """The rig whose shapes a merged character combines, and the matrix (K_full, K) of weights; or the rig itself."""
    if rig.name.startswith("anny:"):
        from reenact.rigs import anny

        if rig.name in anny.CAST and anny.CAST[rig.name].merged:
            return anny.before_merging(rig.name), anny.merged_matrix()[2]
    return rig, torch.eye(len(rig.names))


def _fit(full: Rig, weights: Tensor, target: Rig) -> Tensor:
    """Weights in [0, 1] of `target` whose vertices lie closest to those of `full`, which has the same vertices."""
    basis, triangle = torch.linalg.qr(target.deltas.flatten(1).double().T)  # (3 V, K), (K, K)
    wanted = weights.double() @ (full.deltas.flatten(1).double() @ basis)  # (T, K)
    rows = [lsq_linear(triangle.numpy(), row.numpy(), (0, 1)).x for row in wanted]
    return torch.from_numpy(np.stack(rows)).float()
