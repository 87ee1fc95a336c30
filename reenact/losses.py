"""Distances between pictures and between weights, for training and for reporting alike.

Kim et al. 2021, "Deep Learning-Based Unsupervised Human Facial Retargeting", doi:10.1111/cgf.14400 (KI21), for the
three distances that it trains with.
"""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from reenact.rigs.rig import Rig


def picture_distance(
    a: Float[Tensor, "B C H W"],
    b: Float[Tensor, "B C H W"],
    weight: Float[Tensor, "1 H W"] | None = None,
    squared: bool = False,
) -> Float[Tensor, ""]:
    """Mean absolute difference over all entries, optionally weighted per pixel. Source: KI21, L_recon and L_r.

    The paper does not state the reduction; a mean keeps L_r and L_w within two orders of magnitude of each other.
    `squared` adds the mean square (ours): where most pixels are still, the median that an absolute difference asks for
    is the still picture.
    """
    difference = (a - b).abs()
    if squared:
        difference = difference + difference.square()
    return (difference if weight is None else difference * weight).mean()


def weight_distance(a: Float[Tensor, "B K"], b: Float[Tensor, "B K"]) -> Float[Tensor, ""]:
    """Mean absolute difference of blendshape weights. Source: KI21, L_w."""
    return (a - b).abs().mean()


def motion_weight(residuals: Float[Tensor, "N C H W"]) -> Float[Tensor, "1 H W"]:
    """Where a rig's pictures move: mean absolute residual per pixel over its mean, clamped to [0.2, 4]. Ours."""
    energy = residuals.abs().mean(dim=(0, 1), keepdim=True)[0]
    return (energy / energy.mean()).clamp(0.2, 4.0)


class VertexDistance:
    """Root mean square vertex error of predicted weights, relative to the rig's typical motion. Ours.

    Prepared once per rig: ||dV (a - b)||^2 is a quadratic form in the weights, so a step costs K x K numbers, not V.
    """

    def __init__(self, rig: Rig, weights: Float[Tensor, "N K"]):
        """`weights` are typical expressions; their root mean square motion becomes the unit."""
        flat = rig.deltas.flatten(1).double()
        gram = flat @ flat.T  # (K, K), square metres
        typical = torch.einsum("nk,kl,nl->n", weights.double(), gram, weights.double()).mean()
        values, vectors = torch.linalg.eigh(gram / typical)
        self.root = (vectors * values.clamp_min(0).sqrt()).float()  # gram = root root^T

    def __call__(self, a: Float[Tensor, "B K"], b: Float[Tensor, "B K"]) -> Float[Tensor, ""]:
        """0 for equal expressions; 1 when the error is as large as the typical motion."""
        return torch.linalg.vector_norm((a - b) @ self.root, dim=1).mean()
