"""Regression from paired expressions: radial basis functions, and kernel canonical correlation.

Deng et al. 2006, "Animating Blendshape Faces by Cross-Mapping Motion Capture Data", doi:10.1145/1111411.1111419; Song
et al. 2011, "Characteristic facial retargeting", doi:10.1002/cav.414, adds kernel canonical correlation analysis, here
after Bach & Jordan 2002, "Kernel Independent Component Analysis". Kim et al. 2021, doi:10.1111/cgf.14400, compares with
22 and 31 pairs.

An artist gives the pairs of these papers. Where none are given, `expression_pairs` makes them, from shared names first
and from the correspondence where no name is shared; they are then no better than what made them, and what these methods
show is how they interpolate.

Symbol  Code      Shape
x_i     inputs    (n, Ks) weights of the source in each pair
y_i     outputs   (n, Kt) weights of the target
phi     _kernel   exp(-r^2 / 2 width^2)
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from reenact.errors import ReenactError
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.rbf import ProportionMatching
from reenact.retargeting.retargeter import check_names
from reenact.retargeting.trivial import CopyNames
from reenact.rigs import arkit
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig

Pairs = tuple[Tensor, Tensor]
"""Weights of the source (n, Ks) and of the target (n, Kt) in n expressions that mean the same."""


def expression_pairs(
    source: Rig, target: Rig, correspondence: Correspondence | None = None, count: int | None = None
) -> Pairs:
    """Expressions of the source with those of the target that mean the same; the neutral pair is the first.

    All single shapes, or, where a count is given, that many expressions in all, left and right together, those first
    that move the source most: `count` 22 or 31 follows the protocol of KI21. The target's expression is the namesake,
    in ARKit's spellings; where the rigs share no name, it is what proportion matching makes of it.

    Raises:
        ReenactError: No name is shared and there is no correspondence, or the source has fewer expressions.
    """
    shapes = torch.eye(len(source.names))
    if count is not None:
        shapes = _both_sides(source)
        if not 2 <= count <= len(shapes) + 1:
            raise ReenactError(f"{source.name}: expected 2 to {len(shapes) + 1} pairs, got {count}")
        strength = (shapes @ source.deltas.flatten(1)).norm(dim=1)
        shapes = shapes[strength.argsort(descending=True, stable=True)[: count - 1]]
    shared = {part for name in source.names for part in arkit.meaning(name) or (name,)}
    if any(shared.intersection(arkit.meaning(name) or (name,)) for name in target.names):
        method = CopyNames(source, target)
    elif correspondence is not None:
        method = ProportionMatching(source, target, correspondence)
    else:
        raise ReenactError(
            f"{source.name} to {target.name}: no shape has the same name; give pairs of expressions or a correspondence"
        )
    inputs = torch.cat([torch.zeros(1, len(source.names)), shapes])
    return inputs, method(Clip(source.names, inputs, fps=30.0)).weights


def _both_sides(rig: Rig) -> Float[Tensor, "n K"]:
    """Single shapes, where left and right partners act together."""
    groups: dict[str, list[int]] = {}
    for index, name in enumerate(rig.names):
        base, side = arkit.sides(name)
        direction = arkit.canonical(name) in {one for pair in arkit.DIRECTIONS for one in pair}
        groups.setdefault(name if side is None or direction else base, []).append(index)
    shapes = torch.zeros(len(groups), len(rig.names))
    for row, members in enumerate(groups.values()):
        shapes[row, members] = 1.0
    return shapes


class CrossMapping:
    """Radial basis functions from source weights to target weights, on a linear trend."""

    def __init__(
        self,
        source: Rig,
        target: Rig,
        correspondence: Correspondence | None = None,
        training: Clip | None = None,
        *,
        pairs: Pairs | None = None,
        ridge: float = 1e-3,
        width: float | None = None,
        trend: Literal["linear", "constant"] = "linear",
    ) -> None:
        """
        Args:
            source: Of the inputs.
            target: Of the outputs.
            correspondence: Makes the pairs where none are given and no name is shared.
            training: Not used.
            pairs: Examples; see `expression_pairs` for what happens without.
            ridge: Lambda, added to the diagonal: 0 goes through every pair.
            width: Of the Gaussian; the median distance between inputs where None.
            trend: What remains far from all pairs. Linear: over as many principal directions of the inputs as n pairs
                can tell from a constant with one to spare, n - 2.

        Raises:
            ReenactError: Pairs of the wrong size, fewer than two, or inputs that repeat.

        Source: Deng et al. 2006 and Song et al. 2011 for phi and the ridge. The reduced trend is ours, and so is that
        the value at the neutral is taken off, so that a still face stays still whatever the ridge.
        """
        self.source, self.target = source, target
        inputs, outputs = _checked(source, target, pairs or expression_pairs(source, target, correspondence))
        count = len(inputs)
        self.inputs = inputs
        self.width = _width(inputs) if width is None else width
        self._mean = inputs.mean(0)
        _, strengths, axes = torch.linalg.svd(inputs - self._mean, full_matrices=False)
        kept = min(count - 2, int((strengths > 1e-9 * strengths[0]).sum())) if trend == "linear" else 0
        self._axes = axes[: max(kept, 0)]  # (D, Ks)
        basis = self._basis(inputs)  # (n, 1 + D)
        size = basis.shape[1]
        system = inputs.new_zeros(count + size, count + size)
        system[:count, :count] = _gaussian(inputs, inputs, self.width)
        system[:count, :count] += ridge * torch.eye(count, dtype=torch.float64)
        system[:count, count:], system[count:, :count] = basis, basis.T
        solution = torch.linalg.solve(system, torch.cat([outputs, outputs.new_zeros(size, outputs.shape[1])]))
        self._kernel, self._trend = solution[:count], solution[count:]
        self._rest = torch.zeros(1, outputs.shape[1], dtype=torch.float64)
        self._rest = self._regress(inputs.new_zeros(1, inputs.shape[1]))

    def __call__(self, clip: Clip) -> Clip:
        """The clip on the target, weights in [0, 1]."""
        check_names(clip, self.source)
        weights = self._regress(clip.weights.to(torch.float64)).clamp(0, 1)
        return replace(clip, names=self.target.names, weights=weights.float())

    def _regress(self, x: Tensor) -> Tensor:
        return _gaussian(x, self.inputs, self.width) @ self._kernel + self._basis(x) @ self._trend - self._rest

    def _basis(self, x: Tensor) -> Tensor:
        return torch.cat([torch.ones_like(x[:, :1]), (x - self._mean) @ self._axes.T], 1)


class KernelCCA:
    """Regression through the directions in which source and target weights, in kernel space, vary together."""

    def __init__(
        self,
        source: Rig,
        target: Rig,
        correspondence: Correspondence | None = None,
        training: Clip | None = None,
        *,
        pairs: Pairs | None = None,
        eta: float = 1e-2,
        directions: int | None = None,
        kernel: Literal["gaussian", "linear"] = "gaussian",
    ) -> None:
        """
        Args:
            source: Of the inputs.
            target: Of the outputs.
            correspondence: Makes the pairs where none are given and no name is shared.
            training: Not used.
            pairs: Examples; see `expression_pairs` for what happens without.
            eta: Regularisation, times the number of pairs. Towards 0 every correlation becomes 1 and means nothing.
            directions: How many are kept; all n - 1 where None. Fifteen, as is common for smooth data, lose most of
                what single shapes say, whose inputs are all at right angles.
            kernel: Of both sides.

        Raises:
            ReenactError: Pairs of the wrong size, fewer than two, or inputs that repeat.

        Source: Bach & Jordan 2002, Eq. 13 (both kernels regularised); the ridge from scores to weights, with the same
        eta, and the neutral taken off are ours.
        """
        self.source, self.target, self.kernel = source, target, kernel
        inputs, outputs = _checked(source, target, pairs or expression_pairs(source, target, correspondence))
        count = len(inputs)
        self.inputs, self._width = inputs, _width(inputs)
        self._raw = self._similarity(inputs, inputs, self._width)
        ours, theirs = _centred(self._raw), _centred(self._similarity(outputs, outputs, _width(outputs)))
        smooth = [_smoother(gram, eta * count) for gram in (ours, theirs)]  # K (K + eta n I)^-1
        left, strengths, _ = torch.linalg.svd(smooth[0] @ smooth[1])
        kept = count - 1 if directions is None else directions
        self.correlations = strengths[:kept]
        """Of the kept directions, largest first."""
        ridge = eta * count * torch.eye(count, dtype=torch.float64)
        self._directions = torch.linalg.solve(ours + ridge, left[:, :kept])  # (n, D)
        scores = ours @ self._directions
        self._coefficients = torch.linalg.solve(
            scores.T @ scores + eta * (scores.square().sum(0).mean()) * torch.eye(kept, dtype=torch.float64),
            scores.T @ (outputs - outputs.mean(0)),
        )
        self._rest = torch.zeros(1, outputs.shape[1], dtype=torch.float64)
        self._rest = self._regress(inputs.new_zeros(1, inputs.shape[1]))

    def __call__(self, clip: Clip) -> Clip:
        """The clip on the target, weights in [0, 1]."""
        check_names(clip, self.source)
        weights = self._regress(clip.weights.to(torch.float64)).clamp(0, 1)
        return replace(clip, names=self.target.names, weights=weights.float())

    def _regress(self, x: Tensor) -> Tensor:
        similarity = self._similarity(x, self.inputs, self._width)
        centred = similarity - similarity.mean(1, keepdim=True) - self._raw.mean(0) + self._raw.mean()
        return centred @ self._directions @ self._coefficients - self._rest

    def _similarity(self, a: Tensor, b: Tensor, width: float) -> Tensor:
        return a @ b.T if self.kernel == "linear" else _gaussian(a, b, width)


def _checked(source: Rig, target: Rig, pairs: Pairs) -> Pairs:
    inputs, outputs = (side.to(torch.float64) for side in pairs)
    expected = (len(inputs), len(source.names)), (len(inputs), len(target.names))
    if len(inputs) < 2 or (inputs.shape, outputs.shape) != expected:
        raise ReenactError(
            f"pairs: expected at least two, of {len(source.names)} and {len(target.names)} weights, got "
            f"{tuple(inputs.shape)} and {tuple(outputs.shape)}"
        )
    if len(torch.unique(inputs, dim=0)) < len(inputs):
        raise ReenactError(f"pairs: expected inputs that differ, got {len(inputs)} with repetitions; merge them")
    return inputs, outputs


def _width(points: Tensor) -> float:
    """The median distance between different points."""
    distances = torch.pdist(points)
    distances = distances[distances > 0]
    return float(distances.median()) if len(distances) else 1.0


def _gaussian(a: Tensor, b: Tensor, width: float) -> Tensor:
    distances = torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")
    return torch.exp(-distances.square() / (2 * width**2))


def _centred(gram: Tensor) -> Tensor:
    return gram - gram.mean(0) - gram.mean(1, keepdim=True) + gram.mean()


def _smoother(gram: Tensor, ridge: float) -> Tensor:
    return torch.linalg.solve(gram + ridge * torch.eye(len(gram), dtype=gram.dtype), gram)
