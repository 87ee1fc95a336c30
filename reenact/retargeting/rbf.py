"""Thin-plate maps between faces, and proportion matching: the target's shapes carried into the source's proportions.

Seol et al. 2012, "Spacetime Expression Cloning for Blendshapes", doi:10.1145/2159516.2159519, for proportion matching;
Ribera et al. 2017, "Facial Retargeting with Automatic Range of Motion Alignment", doi:10.1145/3072959.3073674, which
calls it the RBF guess and compares with it. The actor of these papers is our source, their rig is our target.

Symbol  Code                    Shape
a_0     source_neutral          (N, 3) places on the source at rest
da_f    displacements(weights)  (T, N, 3) how they move
s_0     target_neutral          (N, 3) their partners on the target at rest, size matched
ds_k    shapes                  (Kt, N, 3) how the target's shapes move them
dg_k    guess                   (Kt, N, 3) the same in the source's proportions
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from reenact.errors import ReenactError
from reenact.geometry import similarity_fit
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.inverse_rig import nonnegative_least_squares
from reenact.retargeting.retargeter import check_names
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig

_DISTANCES = 2**24
"""Distances between points and centers that are in memory at a time."""


class ThinPlate:
    """The smoothest map that takes the centers to the values: R(x) = [1, x] B + sum_m W_m |x - c_m|.

    Source: the kernel |r| is the thin plate's in three dimensions (Duchon 1977). An affine map is reproduced exactly,
    with W = 0.
    """

    def __init__(
        self,
        centers: Float[Tensor, "N 3"],
        values: Float[Tensor, "N D"],
        stiffness: float | Float[Tensor, "N"] = 1e-8,
    ) -> None:
        """
        Args:
            centers: Where the map is known; centers that coincide count once, with the mean of their values.
            values: Its values there.
            stiffness: How far the map may miss the values to be smoother, per center or for all, in units of the mean
                distance between centers.

        Raises:
            ReenactError: Fewer than four centers that differ, or all of them in one plane.
        """
        centers, values = centers.detach().to(torch.float64), values.detach().to(torch.float64)
        stiffness = torch.as_tensor(stiffness, dtype=torch.float64, device=centers.device).expand(len(centers))
        self._middle = centers.mean(0)
        self._size = float((centers - self._middle).square().sum(1).mean().sqrt()) or 1.0
        points = (centers - self._middle) / self._size  # of unit size, so that the system is balanced
        points, values, stiffness = _distinct(points, values, stiffness)
        affine = torch.cat([torch.ones_like(points[:, :1]), points], 1)  # Q, (N, 4)
        if len(points) < 4 or torch.linalg.matrix_rank(affine, rtol=1e-9) < 4:
            raise ReenactError(
                f"thin plate: expected at least four centers that do not lie in one plane, got {len(points)} distinct "
                "ones; spread the correspondence over the face"
            )
        distances = torch.cdist(points, points, compute_mode="donot_use_mm_for_euclid_dist")
        count = len(points)
        system = points.new_zeros(count + 4, count + 4)
        # -|r| is what is conditionally positive definite, so that the stiffness is subtracted from +|r|.
        system[:count, :count] = distances - torch.diag(stiffness * distances.mean())
        system[:count, count:], system[count:, :count] = affine, affine.T
        solution = torch.linalg.solve(system, torch.cat([values, values.new_zeros(4, values.shape[1])]))
        self._points, self._kernel, self._affine = points, solution[:count], solution[count:]

    def __call__(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch D"]:
        """The map at the points, in their precision."""
        mapped = []
        for x in self._normalised(points).split(max(1, _DISTANCES // len(self._points))):
            distances = torch.cdist(x, self._points, compute_mode="donot_use_mm_for_euclid_dist")
            mapped.append(self._affine[0] + x @ self._affine[1:] + distances @ self._kernel)
        return torch.cat(mapped).reshape(*points.shape[:-1], -1).to(points.dtype)

    def jacobian(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch D 3"]:
        """Derivative of the map by the points. At a center, whose own term has a kink, that term counts 0."""
        x = self._normalised(points)
        jacobians = []
        for chunk in x.split(1024):
            offsets = chunk[:, None] - self._points  # (P, N, 3)
            directions = offsets / offsets.norm(dim=-1, keepdim=True).clamp_min(1e-9)
            jacobians.append(torch.einsum("pni,nd->pdi", directions, self._kernel) + self._affine[1:].T)
        jacobian = torch.cat(jacobians) / self._size
        return jacobian.reshape(*points.shape[:-1], *jacobian.shape[1:]).to(points.dtype)

    def _normalised(self, points: Tensor) -> Tensor:
        return (points.detach().to(torch.float64).reshape(-1, 3) - self._middle) / self._size


def _distinct(points: Tensor, values: Tensor, stiffness: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Points that coincide, merged: the mean of their values and of their stiffness."""
    _, group = torch.unique((points * 1e8).round(), dim=0, return_inverse=True)
    count = int(group.max()) + 1
    if count == len(points):
        return points, values, stiffness
    share = 1 / torch.bincount(group).to(points)

    def mean(rows: Tensor) -> Tensor:
        return rows.new_zeros(count, rows.shape[1]).index_add_(0, group, rows) * share[:, None]

    return mean(points), mean(values), mean(stiffness[:, None])[:, 0]


@dataclass(frozen=True)
class CarriedShapes:
    """The shapes of a target in the space of a source, at the N pairs of a correspondence; float64."""

    source_neutral: Float[Tensor, "N 3"]
    """a_0: the places of the source at rest."""
    source_shapes: Float[Tensor, "Ks N 3"]
    """How the source's own shapes move them."""
    target_neutral: Float[Tensor, "N 3"]
    """s_0: the places of the target at rest, moved and scaled as one piece onto those of the source."""
    shapes: Float[Tensor, "Kt N 3"]
    """ds: how the target's shapes move them, rotated and scaled alike."""
    guess: Float[Tensor, "Kt N 3"]
    """dg: the same bent into the source's proportions."""
    confidence: Float[Tensor, "N"]
    """How sure each pair is."""
    scale: float
    """Size of the source in units of the target."""
    carry: Callable[[Float[Tensor, "*batch 3"]], Float[Tensor, "*batch 3"]]
    """Where any point of the target lies in the source's proportions."""

    def displacements(self, weights: Float[Tensor, "T Ks"]) -> Float[Tensor, "T N 3"]:
        """da: how the source's weights move its places."""
        return torch.einsum("tk,kni->tni", weights.to(self.source_shapes), self.source_shapes)


def carry_shapes(
    source: Rig,
    target: Rig,
    correspondence: Correspondence,
    linearised: bool = False,
    stiffness: float = 1e-8,
) -> CarriedShapes:
    """The target's shapes in the proportions of the source, by the thin-plate map between the neutrals.

    Args:
        source: The actor.
        target: The rig.
        correspondence: Pairs of places; the less sure ones bend the map less where `stiffness` allows it.
        linearised: Carry offsets by the map's derivative, exactly proportional to them, instead of carrying both ends.
        stiffness: Of the map, see `ThinPlate`; divided by the confidence of each pair.

    Source: RB17, Sec. 4.2 (the guess g_k); the two ways to carry an offset are ours.
    """
    confidence = correspondence.confidence.to(torch.float64)
    source_neutral = correspondence.source.of(source.neutral.to(torch.float64))
    target_neutral = correspondence.target.of(target.neutral.to(torch.float64))
    scale, rotation, translation = similarity_fit(target_neutral, source_neutral, confidence)
    placed = scale * target_neutral @ rotation.T + translation
    shapes = scale * correspondence.target.of(target.deltas.to(torch.float64)) @ rotation.T  # (Kt, N, 3)
    plate = ThinPlate(placed, source_neutral, stiffness / confidence.clamp_min(1e-3))
    if linearised:
        guess = torch.einsum("nij,knj->kni", plate.jacobian(placed), shapes)
    else:
        guess = plate(placed + shapes) - plate(placed)
    return CarriedShapes(
        source_neutral=source_neutral,
        source_shapes=correspondence.source.of(source.deltas.to(torch.float64)),
        target_neutral=placed,
        shapes=shapes,
        guess=guess,
        confidence=confidence,
        scale=float(scale),
        carry=lambda points: plate(scale * points @ rotation.T + translation),
    )


class ProportionMatching:
    """Bounded least squares of the source's motion in the target's shapes, carried into the source's proportions."""

    def __init__(
        self,
        source: Rig,
        target: Rig,
        correspondence: Correspondence | None = None,
        training: Clip | None = None,
        *,
        sparsity: float = 0.0,
        linearised: bool = False,
        stiffness: float = 1e-8,
    ) -> None:
        """
        Args:
            source: The actor.
            target: The rig.
            correspondence: Pairs of places.
            training: Not used.
            sparsity: Penalty on each weight, in weights: a shape that acts alone loses this much. RB17's lambda / K
                depends on units and on how many markers a shape moves; this form does not.
            linearised: See `carry_shapes`.
            stiffness: See `carry_shapes`.

        Raises:
            ReenactError: There is no correspondence.

        Source: Seol et al. 2012 as RB17 describe it, with RB17's Eq. 2 for the weights. The bounds and the form of the
        sparsity are ours.
        """
        if correspondence is None:
            raise ReenactError(f"{source.name} to {target.name}: proportion matching needs a correspondence, got none")
        self.source, self.target, self.sparsity = source, target, sparsity
        self.carried = carry_shapes(source, target, correspondence, linearised, stiffness)
        weighted = self.carried.guess * self.carried.confidence[:, None]
        self.gram = torch.einsum("kni,lni->kl", weighted, self.carried.guess)  # H
        self.source_projection = torch.einsum("sni,kni->sk", self.carried.source_shapes, weighted)  # (Ks, Kt)

    def __call__(self, clip: Clip) -> Clip:
        """The clip on the target, weights in [0, 1]."""
        check_names(clip, self.source)
        projections = clip.weights.to(torch.float64) @ self.source_projection - self.sparsity * self.gram.diagonal()
        weights = nonnegative_least_squares(self.gram, projections, high=1.0)
        return replace(clip, names=self.target.names, weights=weights.float())
