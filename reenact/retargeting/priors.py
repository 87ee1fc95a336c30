"""Penalties on weights that know the rig, or nothing: PCA of its shapes, squares, elastic net.

Seol et al. 2012, "Spacetime Expression Cloning for Blendshapes", doi:10.1145/2159516.2159519, for the model-specific
prior; Ribera et al. 2017, "Facial Retargeting with Automatic Range of Motion Alignment",
doi:10.1145/3072959.3073674, compares it and the elastic net of Zou & Hastie 2005 with its geometric prior. All are
quadratic forms w^T Q w - 2 q^T w that are added to the fit w^T H w - 2 b^T w.

Symbol  Code         Shape
U       directions   (C, 3 V) unit principal directions of the rig's shapes
sigma   deviations   (C,) standard deviations of the shapes along them
m       mean         mean of the shapes, as an offset from the neutral
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor

from reenact.errors import ReenactError
from reenact.retargeting.inverse_rig import nonnegative_least_squares
from reenact.rigs.rig import Rig


def pca_prior(rig: Rig, keep: float = 0.98) -> tuple[Float[Tensor, "K K"], Float[Tensor, "K"]]:
    """Q and q of |diag(1/sigma) U^T (v(w) - m)|^2: how unlike the rig's own shapes an expression is, in deviations.

    Directions that the shapes hardly use, beyond the share `keep` of their variance, cost nothing. The prior is
    smallest at the mean of the shapes, not at the neutral; leave q out to centre it on the neutral.

    Raises:
        ReenactError: `keep` is not in (0, 1], or all shapes are equal.

    Source: RB17, Sec. 6.2, after Seol et al. 2012; that only the blendshapes are the training set is RB17's.
    """
    if not 0 < keep <= 1:
        raise ReenactError(f"{rig.name}: expected a share of variance in (0, 1], got {keep}")
    deltas = rig.deltas.to(torch.float64).flatten(1)  # (K, 3 V)
    gram = deltas @ deltas.T
    count = len(gram)
    centring = torch.eye(count, dtype=torch.float64) - 1 / count
    # With X the centred deltas, X X^T = A diag(s) A^T, and the directions are U = diag(1/sqrt(s)) A^T X: all that is
    # needed follows from the Gram matrix, so that no (3 V, 3 V) matrix is made.
    variances, axes = torch.linalg.eigh(centring @ gram @ centring)
    variances, axes = variances.flip(0).clamp_min(0), axes.flip(1)
    if variances[0] <= 1e-12 * gram.diagonal().mean() or variances.sum() == 0:
        raise ReenactError(f"{rig.name}: expected shapes that differ, got {count} equal ones")
    shares = variances.cumsum(0) / variances.sum()
    kept = min(int((shares < keep - 1e-12).sum()) + 1, int((variances > 1e-10 * variances[0]).sum()))
    variances, axes = variances[:kept], axes[:, :kept]
    along = axes.T @ centring @ gram / variances.sqrt()[:, None]  # U^T dV, (C, K)
    scaled = along / (variances / count).sqrt()[:, None]
    return scaled.T @ scaled, scaled.T @ scaled.mean(1)


def ridge_weights(
    gram: Float[Tensor, "K K"], projections: Float[Tensor, "T K"], strength: float
) -> Float[Tensor, "T K"]:
    """Unbounded weights that minimise w^T H w - 2 b^T w + strength |w|^2. Source: Hoerl & Kennard 1970."""
    matrix = gram.to(torch.float64) + strength * torch.eye(len(gram), dtype=torch.float64)
    return torch.linalg.lstsq(matrix, projections.to(torch.float64).T).solution.T


def elastic_net(
    gram: Float[Tensor, "K K"],
    projections: Float[Tensor, "T K"],
    squares: float = 0.0,
    magnitudes: float = 0.0,
    low: float = 0.0,
    high: float = math.inf,
) -> Float[Tensor, "T K"]:
    """Weights that minimise w^T H w - 2 b^T w + squares |w|^2 + (magnitudes / K) |w|_1 between the bounds, exactly.

    Where weights may be negative they are split into positive and negative parts, which makes the absolute values
    linear.

    Raises:
        ReenactError: A negative strength.

    Source: Zou & Hastie 2005, "Regularization and Variable Selection via the Elastic Net"; RB17, Eq. 16 with the L2
    norm in the place of its prior.
    """
    if squares < 0 or magnitudes < 0:
        raise ReenactError(f"elastic net: expected strengths of at least 0, got {squares} and {magnitudes}")
    count = len(gram)
    wanted = projections.to(torch.float64)
    matrix = gram.to(torch.float64) + squares * torch.eye(count, dtype=torch.float64)
    threshold = magnitudes / (2 * count)
    if low >= 0:
        return nonnegative_least_squares(matrix, wanted - threshold, low, high)
    if math.isfinite(low) and low != -high:
        raise ReenactError(f"elastic net: expected bounds that mirror each other below 0, got {low} and {high}")
    both = torch.cat([torch.cat([matrix, -matrix], 1), torch.cat([-matrix, matrix], 1)])  # (2 K, 2 K)
    parts = nonnegative_least_squares(both, torch.cat([wanted, -wanted], 1) - threshold, 0.0, high)
    return parts[:, :count] - parts[:, count:]
