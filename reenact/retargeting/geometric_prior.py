"""Bending of the surface as a penalty on weights, and the weights of a frame under it.

Ribera et al. 2017, "Facial Retargeting with Automatic Range of Motion Alignment", doi:10.1145/3072959.3073674, Sec. 5.

Paper                         Code            Shape
dV                            rig.deltas      (K, V, 3)
L                             operator        (V, V), the same for x, y and z
(1/N) |L dV w|^2              w^T prior w     prior (K, K)
dp_k                          shapes          (K, M, 3) personalised shapes at the markers
da_f                          displacements   (T, M, 3)
H = (1/M) P P^T               gram            (K, K)
b = (1/M) P da_f              projections     (T, K)
lambda / (2 K)                thresholds      (K,)
"""

from __future__ import annotations

import inspect
import math

import numba
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from reenact.errors import ReenactError
from reenact.geometry import cotangent_laplacian
from reenact.retargeting.inverse_rig import by_blocks, nonnegative_least_squares
from reenact.rigs.rig import Rig

_EPSILON = 1e-4
"""Below this a weight counts as zero to the sparsity: |w| is taken as sqrt(w^2 + epsilon^2)."""
_ROUNDS = 30
_SETTLED = 1e-3


def bending(rig: Rig) -> Float[Tensor, "K K"]:
    """The matrix whose quadratic form w^T Q w says how far the weights bend the surface of the rig; square metres.

    Source: RB17, Eq. 14 and 15. Bending is that of the displacement, so the neutral has none however curved it is. The
    Laplacian is not divided by areas, on which the paper is silent.
    """
    operator = cotangent_laplacian(rig.neutral, rig.faces)
    shapes, vertices, _ = rig.deltas.shape
    offsets = rig.deltas.detach().cpu().double().permute(1, 0, 2).reshape(vertices, 3 * shapes).numpy()
    bent = (operator @ offsets).reshape(vertices, shapes, 3).transpose(1, 0, 2).reshape(shapes, -1)  # (K, 3 V)
    return torch.from_numpy(bent @ bent.T / vertices)


def sparsity_thresholds(shapes: Float[Tensor, "K M 3"], strength: float) -> Float[Tensor, "K"]:
    """Thresholds that take `strength` off the weight of any shape that acts alone, however few markers it moves.

    Source: ours. RB17 takes lambda / (2 K) for all shapes, which no blink that moves two of a hundred markers survives.
    """
    return strength * shapes.double().square().sum((1, 2)) / shapes.shape[1]


class FrameSolver:
    """Weights of frames of marker displacements: minimises

        |da - sum_k w_k dp_k|^2 / M + mu (w^T Q w - 2 q^T w) + 2 sum_k thresholds_k |w_k|

    with everything that frames share prepared once. Weights either have bounds, low >= 0, and are the exact minimum; or
    may have any sign, as the paper has it, and come from iteratively reweighted least squares.

    Source: RB17, Eq. 2, 15 and 16, where q = 0. Bounds are ours.
    """

    def __init__(
        self,
        shapes: Float[Tensor, "K M 3"],
        prior: Float[Tensor, "K K"] | None = None,
        mu: float = 0.0,
        thresholds: Float[Tensor, "K"] | None = None,
        *,
        pull: Float[Tensor, "K"] | None = None,
        importance: Float[Tensor, "M"] | None = None,
        low: float = 0.0,
        high: float = 1.0,
    ) -> None:
        """
        Args:
            shapes: What each weight does to the markers.
            prior: Q, e.g. `bending`, or the identity for L2.
            mu: Weight of the prior.
            thresholds: Half of the sparsity penalty on each weight.
            pull: q, where a prior is centred somewhere else than the neutral.
            importance: How much each marker counts; 1 where None.
            low: Smallest weight; -inf, with high = inf, for weights of any sign.
            high: Largest weight.

        Raises:
            ReenactError: Bounds that neither method solves.
        """
        self.signed = low == -math.inf and high == math.inf
        if not self.signed and low < 0:
            raise ReenactError(f"frame solver: expected bounds from 0 up, or none at all, got {low} to {high}")
        count, markers = shapes.shape[:2]
        double = shapes.double()
        weighted = double if importance is None else double * importance.double()[:, None]
        self._projector = (weighted / markers).reshape(count, -1).T.contiguous()  # (3 M, K)
        self.gram = self._projector.T @ double.reshape(count, -1).T
        self.system = self.gram if prior is None else self.gram + mu * prior.double()
        self.pull = self.gram.new_zeros(count) if pull is None else mu * pull.double()
        self.thresholds = self.gram.new_zeros(count) if thresholds is None else thresholds.double()
        self.low, self.high = low, high
        ridge = 1e-8 * self.system.diagonal().mean().clamp_min(1e-300)
        self._matrix = np.ascontiguousarray((self.system + ridge * torch.eye(count).double()).numpy())
        self._limits = self.thresholds.numpy()

    def project(self, displacements: Float[Tensor, "*batch M 3"]) -> Float[Tensor, "*batch K"]:
        """b: what every shape has in common with each frame."""
        return displacements.double().flatten(-2) @ self._projector

    def __call__(self, displacements: Float[Tensor, "T M 3"]) -> Float[Tensor, "T K"]:
        """Weights of all frames of a clip."""
        return self.solve(self.project(displacements))

    def step(self, displacements: Float[Tensor, "M 3"], last: Float[Tensor, "K"] | None = None) -> Float[Tensor, "K"]:
        """Weights of one frame; those of the frame before, where given, save time."""
        return self.solve(self.project(displacements)[None], None if last is None else last[None])[0]

    def solve(
        self, projections: Float[Tensor, "T K"], last: Float[Tensor, "1 K"] | None = None
    ) -> Float[Tensor, "T K"]:
        """Weights of frames of which only b is known."""
        wanted = projections.double() + self.pull
        if not self.signed:
            # Where no weight is negative, |w| is w, and sparsity merely lowers what the data ask for.
            start = last if last is not None and len(wanted) == 1 else None
            return nonnegative_least_squares(self.system, wanted - self.thresholds, self.low, self.high, start)
        weights = np.zeros(wanted.shape)
        start = np.zeros(wanted.shape[1]) if last is None else last[0].double().numpy()
        rows, warm = wanted.numpy(), last is not None

        def reweighted(block: slice) -> None:
            first = warm and block.start == 0
            _reweighted(self._matrix, rows[block], self._limits, start, first, weights[block])

        by_blocks(reweighted, len(rows))
        return torch.from_numpy(weights)

    def objective(
        self, weights: Float[Tensor, "*batch K"], projections: Float[Tensor, "*batch K"]
    ) -> Float[Tensor, "*batch"]:
        """What is minimised, without the part that no weight changes, and with |w| smoothed at 0."""
        quadratic = torch.einsum("...k,kl,...l->...", weights, torch.from_numpy(self._matrix), weights)
        linear = ((projections + self.pull) * weights).sum(-1)
        return quadratic - 2 * linear + 2 * (self.thresholds * (weights.square() + _EPSILON**2).sqrt()).sum(-1)


# The loops, on numpy arrays -------------------------------------------------------------------------------------------


def _compiled(function):
    # An import hook that checks types, as in our tests, wraps every function; the compiler needs the bare one.
    return numba.njit(cache=True, nogil=True, error_model="numpy")(inspect.unwrap(function))


@_compiled
def _reweighted(matrix, wanted, thresholds, start, warm, weights):
    """Iteratively reweighted least squares of every frame, each warm from the one before.

    |w| <= w^2 / (2 |w'|) + |w'| / 2 touches at w = w', so that each round solves a K x K system and never raises the
    objective. Source: RB17, Sec. 5; epsilon, and when to stop, are ours.
    """
    frames, count = wanted.shape
    found = np.empty(count)
    before = start.copy()
    for frame in range(frames):
        if not warm:
            found[:] = wanted[frame]
            _solve_shifted(matrix, np.zeros(count), found)
            before[:] = found
        for _ in range(_ROUNDS):
            found[:] = wanted[frame]
            _solve_shifted(matrix, thresholds / np.sqrt(before * before + _EPSILON * _EPSILON), found)
            moved = np.abs(found - before).max()
            before[:] = found
            if moved < _SETTLED:
                break
        weights[frame] = before
        warm = True


@_compiled
def _solve_shifted(matrix, shift, vector):
    """Replaces the vector (K,) by (matrix + diag(shift))^-1 vector, by Cholesky."""
    count = len(vector)
    shifted = matrix.copy()
    for i in range(count):
        shifted[i, i] += shift[i]
    factor = np.linalg.cholesky(shifted)
    for i in range(count):
        row = factor[i]
        for m in range(i):
            vector[i] -= row[m] * vector[m]
        vector[i] /= row[i]
    for i in range(count - 1, -1, -1):
        row = factor[i]
        vector[i] /= row[i]
        for m in range(i):
            vector[m] -= row[m] * vector[i]
