"""Shapes that pair off between two rigs are taken to mean each other, full strength for full strength.

Ours; the geometric twin of `reenact.pairs`. The thin-plate map (`rbf`) makes shapes of two rigs comparable: carried
into the source's proportions, a blink moves the lid down there too. Where the shapes of both rigs pair off one to one,
the rigs are built to one scheme, and then a sculptor's full smile means the other's full smile, whatever distance
either moves (the "range of motion" of Ribera et al. 2017, doi:10.1145/3072959.3073674). The source's own shape is then
the best personal version of its partner. One that is two of the other's, left and right in one, is their sum. Where few
shapes pair off, the schemes differ, nothing is known of ranges, and what remains is proportion matching. Names are
never looked at.

Symbol  Code                   Shape
ds_j    carried.source_shapes  (Ks, N, 3) how the source's shapes move its places
dg_k    carried.guess          (Kt, N, 3) how the target's do, in the source's proportions
dp_k    personal               (Kt, N, 3) the target's shapes as the source would perform them
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from reenact.errors import ReenactError
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.inside import Inside
from reenact.retargeting.inverse_rig import nonnegative_least_squares
from reenact.retargeting.rbf import carry_shapes
from reenact.retargeting.retargeter import check_names
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig

_PLACES = 1024
"""Places whose motion is averaged at a time; bounds memory."""


@dataclass(frozen=True)
class ShapeMatchingConfig:
    """When two shapes are one."""

    similarity: float = 0.3
    """Least cosine between the motions of partners. Low, because each row of an assignment takes part: what is left for
    a shape when the sure pairs are made is mostly right, and worth more than the carried guess where that is poor."""
    sum_gain: float = 0.1
    """A shape that looks this much more like the sum of two shapes than like either is no single partner's."""
    sum_similarity: float = 0.8
    """Least cosine between a shape and the two shapes that it is the sum of."""
    sure: float = 0.6
    """Cosine from which a pair counts for `share`."""
    share: float = 0.55
    """Least share of the shapes of the rig with fewer that must surely pair off, one to one, for ranges to be believed
    equal. Sums do not count: who merges left and right may rescale them as well, and on `anny:merged`, where that was
    done, believing in ranges costs half as much error again."""
    blur: float = 0.05
    """Width over which motion is averaged before it is compared, as a share of the spread of the places; what pairs of
    places get wrong by less then matters less."""
    stiffness: float = 1.0
    """Of the thin-plate map, see `carry_shapes`."""
    copying: float = 10.0
    """How much a shape wants its partner's weight, as a share of how much a typical shape moves the places; the rest is
    for shapes without one. It also decides what places do not see: a tongue moves none."""


@dataclass(frozen=True)
class Partners:
    """Shapes of two rigs that mean each other, by index; each is in one entry at most."""

    single: tuple[tuple[int, int], ...] = ()
    """One of ours, one of theirs."""
    merged: tuple[tuple[int, int, int], ...] = ()
    """Two of ours, which one of theirs does together: left and right of one side, or parts of a viseme."""
    split: tuple[tuple[int, int, int], ...] = ()
    """One of ours, and the two of theirs that do it together."""

    def __len__(self) -> int:
        return len(self.single) + len(self.merged) + len(self.split)

    @property
    def ours(self) -> set[int]:
        """Our shapes that have a partner."""
        return {part for *parts, _ in (*self.single, *self.merged) for part in parts} | {j for j, *_ in self.split}

    def copied(self, count: int, their_count: int) -> Float[Tensor, "Ks Kt"]:
        """Their weights as ours, where partners mean each other at full strength: the mean of two that one does.

        Args:
            count: Of our shapes.
            their_count: Of theirs.
        """
        found = torch.zeros(count, their_count)
        for j, k in self.single:
            found[j, k] = 1.0
        for first, second, k in self.merged:
            found[first, k] = found[second, k] = 0.5
        for j, *both in self.split:
            found[j, both] = 1.0
        return found

    def personal(self, ours: Float[Tensor, "Ks N 3"], theirs: Float[Tensor, "Kt N 3"]) -> Float[Tensor, "Kt N 3"]:
        """Their shapes as our rig would perform them: our own where there is a partner, theirs elsewhere.

        Two that share one of ours divide it place by place, as they move there.
        """
        found = theirs.clone()
        for j, k in self.single:
            found[k] = ours[j]
        for first, second, k in self.merged:
            found[k] = ours[first] + ours[second]
        for j, *both in self.split:
            strength = theirs[both].square().sum(-1, keepdim=True)
            found[both] = strength / strength.sum(0).clamp_min(1e-30) * ours[j]
        return found


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
        likeness: Float[Tensor, "Ks Kt"] | None = None,
    ) -> None:
        """
        Args:
            source: Its motion is explained.
            target: Explains it.
            correspondence: Pairs of places; a few hundred tell small shapes apart.
            training: Not used.
            config: Settings.
            likeness: Cosines of what shapes look like, where pictures of them are at hand. They help to find partners:
                they see what places on the skin hardly do, eyeballs and the inside of the mouth.

        Raises:
            ReenactError: There is no correspondence.
        """
        if correspondence is None:
            raise ReenactError(f"{source.name} to {target.name}: shape matching needs a correspondence, got none")
        self.source, self.target = source, target
        config = config or ShapeMatchingConfig()
        self.carried = carry_shapes(source, target, correspondence, stiffness=config.stiffness)
        ours, theirs = self.carried.source_shapes, self.carried.guess
        self.inside = Inside.of(source, target, correspondence, self.carried)
        compared = self._compared(config)
        sure = find_partners(*compared, replace(config, similarity=config.sure))
        believed = len(sure.single) >= config.share * min(len(source.names), len(target.names))
        self.partners = find_partners(*compared, config, likeness) if believed else Partners()
        """None where too few pair off."""
        personal = self.partners.personal(ours, theirs)
        weighted = personal * self.carried.confidence[:, None]
        self.gram = torch.einsum("kni,lni->kl", weighted, personal)
        self._projection = torch.einsum("sni,kni->sk", ours, weighted)  # (Ks, Kt)
        copied = self.partners.copied(len(ours), len(theirs)).to(ours)
        pull = config.copying * self.gram.diagonal().median()
        self.gram += pull * torch.diag(copied.sum(0))
        self._projection += pull * copied

    def __call__(self, clip: Clip) -> Clip:
        """The clip on the target, weights in [0, 1]."""
        check_names(clip, self.source)
        projections = clip.weights.to(torch.float64) @ self._projection
        weights = nonnegative_least_squares(self.gram, projections, high=1.0)
        return replace(clip, names=self.target.names, weights=weights.float())

    def _compared(self, config: ShapeMatchingConfig) -> tuple[Float[Tensor, "Ks D"], Float[Tensor, "Kt D"]]:
        """Motions of both rigs' shapes as rows, averaged over neighbouring places and weighted by confidence; inside of
        shapes that move no place."""
        places = self.carried.source_neutral
        width = config.blur * float((places - places.mean(0)).square().sum(1).mean().sqrt())
        ours, theirs = [], []
        for some, trust in zip(places.split(_PLACES), self.carried.confidence.split(_PLACES)):
            near = torch.exp(-torch.cdist(some, places).square() / (2 * width**2)) * self.carried.confidence
            near = near / near.sum(1, keepdim=True).clamp_min(1e-12) * trust.sqrt()[:, None]
            ours.append(torch.einsum("nm,kmi->kni", near, self.carried.source_shapes).flatten(1))
            theirs.append(torch.einsum("nm,kmi->kni", near, self.carried.guess).flatten(1))
        hidden = self.inside.hidden()
        return torch.cat([*ours, hidden[0]], 1), torch.cat([*theirs, hidden[1]], 1)


def find_partners(
    ours: Float[Tensor, "Ks D"],
    theirs: Float[Tensor, "Kt D"],
    config: ShapeMatchingConfig,
    likeness: Float[Tensor, "Ks Kt"] | None = None,
) -> Partners:
    """Rows that mean each other: sums of two first, then the pairs with the largest sum of cosines.

    A row is a sum of two of the other side where it looks like that by `sum_similarity`, and `sum_gain` more than like
    any single one, unless one of the two has a better home. What looks like a sum, and is none, has no partner either
    if no single one is `sure`. Cosines of a second kind, `likeness`, count as much. (From a man to ICT FaceKit and
    back, by all places that move, 50 and 50 single partners are right so and none is wrong; 46 and 50, 4 and none by
    the rows alone.)
    """
    cosines = _unit(ours) @ _unit(theirs).T
    merged, doubtful = _sums(theirs, ours, cosines.T, config)
    split, doubtful_ours = _sums(ours, theirs, cosines, config)
    allowed = ~doubtful_ours[:, None] & ~doubtful
    for k, (first, second) in merged.items():
        allowed[:, k] = allowed[first] = allowed[second] = False
    split = {j: both for j, both in split.items() if bool(allowed[j].any())}
    for j, (first, second) in split.items():
        allowed[j] = allowed[:, first] = allowed[:, second] = False
    if likeness is not None:
        cosines = (cosines + likeness.to(cosines)) / 2
    allowed &= cosines >= config.similarity
    rows, columns = linear_sum_assignment(torch.where(allowed, cosines, 0).numpy(), maximize=True)
    return Partners(
        tuple((int(j), int(k)) for j, k in zip(rows, columns) if allowed[j, k]),
        tuple((*both, k) for k, both in merged.items()),
        tuple((j, *both) for j, both in split.items()),
    )


def _sums(
    shapes: Float[Tensor, "K D"],
    parts: Float[Tensor, "P D"],
    cosines: Float[Tensor, "K P"],
    config: ShapeMatchingConfig,
) -> tuple[dict[int, tuple[int, int]], Bool[Tensor, "K"]]:
    """Shapes that are sums of two parts, the closest first, each part in one; and those that only look so."""
    doubtful = torch.zeros(len(shapes), dtype=torch.bool)
    if len(parts) < 2:
        return {}, doubtful
    first, second = torch.triu_indices(len(parts), len(parts), 1)
    products, gram = _unit(shapes) @ parts.T, parts @ parts.T  # cosines of sums follow from dot products alone
    lengths = (gram.diagonal()[first] + gram.diagonal()[second] + 2 * gram[first, second]).clamp_min(1e-30).sqrt()
    best, place = ((products[:, first] + products[:, second]) / lengths).max(1)
    found: dict[int, tuple[int, int]] = {}
    for k in best.argsort(descending=True).tolist():
        if best[k] - cosines[k].max() < config.sum_gain:
            continue
        both = int(first[place[k]]), int(second[place[k]])
        at_home = all(cosines[k, part] >= cosines[:, part].max() for part in both)
        free = not any(part in other for part in both for other in found.values())
        if best[k] >= config.sum_similarity and at_home and free:
            found[k] = both
        else:
            doubtful[k] = cosines[k].max() < config.sure
    return found, doubtful


def _unit(rows: Tensor) -> Tensor:
    return rows / rows.norm(dim=1, keepdim=True).clamp_min(1e-15)
