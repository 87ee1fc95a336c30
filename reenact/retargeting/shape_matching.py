"""Shapes that pair off between two rigs are taken to mean each other, full strength for full strength.

Ours; the geometric twin of `reenact.pairs`. The thin-plate map (`rbf`) makes shapes of two rigs comparable: carried
into the source's proportions, a blink moves the lid down there too. Where the shapes of both rigs pair off one to one,
the rigs are built to one scheme, and then a sculptor's full smile means the other's full smile, whatever distance
either moves (the "range of motion" of Ribera et al. 2017, doi:10.1145/3072959.3073674). The source's own shape is then
the best personal version of its partner. Where few shapes pair off, the schemes differ, nothing is known of ranges, and
what remains is proportion matching. Names are never looked at.

Symbol  Code                   Shape
ds_j    carried.source_shapes  (Ks, N, 3) how the source's shapes move its places
dg_k    carried.guess          (Kt, N, 3) how the target's do, in the source's proportions
dp_k    personal               (Kt, N, 3) the target's shapes as the source would perform them
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from reenact.errors import ReenactError
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.inverse_rig import nonnegative_least_squares
from reenact.retargeting.rbf import carry_shapes
from reenact.retargeting.retargeter import check_names
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig


@dataclass(frozen=True)
class ShapeMatchingConfig:
    """When two shapes are one."""

    similarity: float = 0.3
    """Least cosine between the motions of partners. Low, because each row of an assignment takes part: what is left for
    a shape when the sure pairs are made is mostly right, and worth more than the carried guess where that is poor."""
    sum_gain: float = 0.1
    """A shape that looks this much more like the sum of two shapes than like either has no single partner."""
    sure: float = 0.6
    """Cosine from which a pair counts for `share`."""
    share: float = 0.55
    """Least share of the shapes of the rig with fewer that must surely pair off for ranges to be believed equal."""
    blur: float = 0.05
    """Width over which motion is averaged before it is compared, as a share of the spread of the places; what pairs of
    places get wrong by less then matters less."""
    stiffness: float = 1.0
    """Of the thin-plate map, see `carry_shapes`."""


class ShapeMatching:
    """Bounded least squares in the target's shapes, where those with a partner move as the partner does."""

    def __init__(
        self,
        source: Rig,
        target: Rig,
        correspondence: Correspondence | None = None,
        training: Clip | None = None,
        *,
        config: ShapeMatchingConfig | None = None,
    ) -> None:
        """
        Args:
            source: Its motion is explained.
            target: Explains it.
            correspondence: Pairs of places; a few hundred tell small shapes apart.
            training: Not used.
            config: Settings.

        Raises:
            ReenactError: There is no correspondence.
        """
        if correspondence is None:
            raise ReenactError(f"{source.name} to {target.name}: shape matching needs a correspondence, got none")
        self.source, self.target = source, target
        config = config or ShapeMatchingConfig()
        self.carried = carry_shapes(source, target, correspondence, stiffness=config.stiffness)
        ours, theirs = self.carried.source_shapes, self.carried.guess
        compared = self._compared(config)
        sure = find_partners(*compared, config.sure, config.sum_gain)
        believed = len(sure) >= config.share * min(len(source.names), len(target.names))
        self.partners = find_partners(*compared, config.similarity, config.sum_gain) if believed else ()
        """Source shape and target shape of each pair; none where too few pair off."""
        personal = theirs.clone()
        for j, k in self.partners:
            personal[k] = ours[j]
        weighted = personal * self.carried.confidence[:, None]
        self.gram = torch.einsum("kni,lni->kl", weighted, personal)
        self._projection = torch.einsum("sni,kni->sk", ours, weighted)  # (Ks, Kt)

    def __call__(self, clip: Clip) -> Clip:
        """The clip on the target, weights in [0, 1]."""
        check_names(clip, self.source)
        projections = clip.weights.to(torch.float64) @ self._projection
        weights = nonnegative_least_squares(self.gram, projections, high=1.0)
        return replace(clip, names=self.target.names, weights=weights.float())

    def _compared(self, config: ShapeMatchingConfig) -> tuple[Float[Tensor, "Ks D"], Float[Tensor, "Kt D"]]:
        """Motions of both rigs' shapes as rows, averaged over neighbouring places and weighted by confidence."""
        places = self.carried.source_neutral
        width = config.blur * float((places - places.mean(0)).square().sum(1).mean().sqrt())
        near = torch.exp(-torch.cdist(places, places).square() / (2 * width**2)) * self.carried.confidence
        near = near / near.sum(1, keepdim=True).clamp_min(1e-12) * self.carried.confidence.sqrt()[:, None]
        ours, theirs = (
            torch.einsum("nm,kmi->kni", near, shapes).flatten(1)
            for shapes in (self.carried.source_shapes, self.carried.guess)
        )
        return ours, theirs


def find_partners(
    ours: Float[Tensor, "Ks D"], theirs: Float[Tensor, "Kt D"], similarity: float, sum_gain: float
) -> tuple[tuple[int, int], ...]:
    """Pairs of rows with the largest sum of cosines, each row in one at most, each cosine at least `similarity`.

    Left out are rows that are a sum of two of the other side, better by `sum_gain`: merged left and right, or a viseme.
    """
    cosines = _unit(ours) @ _unit(theirs).T
    single = _best_sum(theirs, ours) - cosines.amax(0) < sum_gain  # (Kt,)
    single_ours = _best_sum(ours, theirs) - cosines.amax(1) < sum_gain  # (Ks,)
    allowed = single_ours[:, None] & single & (cosines >= similarity)
    rows, columns = linear_sum_assignment(torch.where(allowed, cosines, 0).numpy(), maximize=True)
    return tuple((int(j), int(k)) for j, k in zip(rows, columns) if allowed[j, k])


def _best_sum(shapes: Float[Tensor, "K D"], parts: Float[Tensor, "P D"]) -> Float[Tensor, "K"]:
    """Largest cosine between each shape and a sum of two parts."""
    if len(parts) < 2:
        return shapes.new_full((len(shapes),), -1.0)
    first, second = torch.triu_indices(len(parts), len(parts), 1)
    products, gram = _unit(shapes) @ parts.T, parts @ parts.T  # cosines of sums follow from dot products alone
    lengths = (gram.diagonal()[first] + gram.diagonal()[second] + 2 * gram[first, second]).clamp_min(1e-30).sqrt()
    return ((products[:, first] + products[:, second]) / lengths).amax(1)


def _unit(rows: Tensor) -> Tensor:
    return rows / rows.norm(dim=1, keepdim=True).clamp_min(1e-15)
