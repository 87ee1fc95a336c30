"""Distances between blendshape weights. Those between pictures belong to the network that describes them: see
`reenact.models`.

Kim et al. 2021, "Deep Learning-Based Unsupervised Human Facial Retargeting", doi:10.1111/cgf.14400 (KI21).
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from reenact.rigs.rig import Rig


def weight_distance(a: Float[Tensor, "B K"], b: Float[Tensor, "B K"]) -> Float[Tensor, "B"]:
    """Mean absolute difference of blendshape weights, of each expression. Source: KI21, L_w."""
    return (a - b).abs().mean(1)


def code_distance(a: Float[Tensor, "B D"], b: Float[Tensor, "C D"]) -> Float[Tensor, ""]:
    """How differently two sets of codes are distributed, in units of their own spread: 0 for the same distribution.

    Mean squared differences of the means and of the covariances. Source: CORAL, Sun & Saenko 2016,
    doi:10.1007/978-3-319-49409-8_35, which has the covariances only.
    """
    spread = torch.cat([a, b]).std(0).detach().clamp_min(1e-6)
    a, b = a / spread, b / spread
    covariances = [(each - each.mean(0)).T @ (each - each.mean(0)) / max(len(each) - 1, 1) for each in (a, b)]
    return (a.mean(0) - b.mean(0)).square().mean() + (covariances[0] - covariances[1]).square().mean()


class VertexDistance:
    """Root mean square vertex error of predicted weights, relative to the rig's typical motion. Ours.

    Prepared once per rig: ||dV (a - b)||^2 is a quadratic form in the weights, so a step costs K x K numbers, not V.
    """

    def __init__(self, rig: Rig, weights: Float[Tensor, "N K"], device: torch.device | str = "cpu"):
        """`weights` are typical expressions; their root mean square motion becomes the unit. Called on `device`."""
        flat = rig.deltas.flatten(1).double()
        gram = flat @ flat.T  # (K, K), square metres
        typical = torch.einsum("nk,kl,nl->n", weights.double(), gram, weights.double()).mean()
        values, vectors = torch.linalg.eigh(gram / typical)
        self.root = (vectors * values.clamp_min(0).sqrt()).float().to(device)  # gram = root root^T

    def __call__(self, a: Float[Tensor, "B K"], b: Float[Tensor, "B K"]) -> Float[Tensor, "B"]:
        """0 for equal expressions; 1 when the error is as large as the typical motion."""
        return torch.linalg.vector_norm((a - b) @ self.root, dim=1)
