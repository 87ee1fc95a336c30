"""Key shapes found in a clip, every frame as a sum of them that never subtracts, the same sum of the target's.

Chuang & Bregler 2002, "Performance Driven Facial Animation using Blendshape Interpolation", Stanford CS-TR-2002-02.

Paper  Code              Shape
Q      features          (T, D) tracked points of every frame, coordinates in a row
S      key_features      (K, D) the key shapes of the source
w      weights           (T, K)
B      target_weights    (K, Kt) or meshes (K, V, 3): the key shapes of the target
k      eyes, mouth       how many key shapes a region has

The paper tracks contours in a video and an artist makes B. Here the features are places of a rig or markers, and B may
be given or is made from the target rig. The paper morphs absolute positions; offsets from the neutral are our default,
because then a still face stays still and the fit does not depend on the origin.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.cluster.vq import kmeans2
from scipy.ndimage import median_filter
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from reenact.errors import ReenactError
from reenact.geometry import farthest_points
from reenact.retargeting.correspondence import Correspondence, Places
from reenact.retargeting.inverse_rig import InverseRig, nonnegative_least_squares
from reenact.retargeting.rbf import ProportionMatching
from reenact.retargeting.retargeter import check_names
from reenact.retargeting.trivial import CopyNames
from reenact.rigs import arkit, motion
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig

# Choosing key shapes --------------------------------------------------------------------------------------------------


def principal_scores(features: Float[Tensor, "T D"], count: int) -> Float[Tensor, "T C"]:
    """Centred features along their first principal axes, largest variance first; at most `count` that vary at all."""
    centred = features.to(torch.float64) - features.to(torch.float64).mean(0)
    left, strengths, _ = torch.linalg.svd(centred, full_matrices=False)
    # A vector and its negative are the same axis: the sign is that of its largest score.
    left = left * left.gather(0, left.abs().argmax(0, keepdim=True)).sign()
    varies = int((strengths > 1e-9 * strengths[0].clamp_min(1e-300)).sum())
    return (left * strengths)[:, : min(count, varies)]


def pca_extremes(features: Float[Tensor, "T D"], count: int) -> Int[Tensor, "N"]:
    """The frames farthest out along the principal axes, both ends of each, in the order of choice.

    A frame that is extreme twice counts once, and the next axis follows; fewer come back only where all axes are used
    up. Since each count adds to the smaller one's frames, the error of Eq. 5 never rises with it.

    Source: CB02, Sec. 4.2. That the farther end of an axis comes first, which decides for odd counts, is ours.
    """
    _check_count(features, count)
    chosen: list[int] = []
    for scores in principal_scores(features, len(features)).T:
        ends = sorted((int(scores.argmax()), int(scores.argmin())), key=lambda frame: -abs(float(scores[frame])))
        chosen += [frame for frame in ends if frame not in chosen]
        if len(chosen) >= count:
            break
    return torch.tensor(chosen[:count], dtype=torch.int64)


def cluster_frames(features: Float[Tensor, "T D"], count: int, dimensions: int = 2, seed: int = 0) -> Int[Tensor, "T"]:
    """The cluster, 0 to at most `count` - 1, of each frame, by k-means in the plane or space of the first axes.

    Source: CB02, Sec. 4.2. The key shape is a cluster's centre of mass: `features` averaged over it. The starts (the
    best of ten, k-means++) are ours; empty clusters are dropped.
    """
    _check_count(features, count)
    scores = principal_scores(features, dimensions).numpy()
    if scores.shape[1] == 0:
        return torch.zeros(len(features), dtype=torch.int64)
    rng = np.random.default_rng(seed)
    best, least = np.zeros(len(scores), np.int64), np.inf
    for _ in range(10):
        centers, labels = kmeans2(scores, count, iter=50, minit="++", missing="warn", rng=rng)
        spread = np.square(scores - centers[labels]).sum()
        if spread < least:
            best, least = labels, spread
    return torch.from_numpy(np.unique(best, return_inverse=True)[1].reshape(-1).astype(np.int64))


def convex_hull(features: Float[Tensor, "T D"]) -> Int[Tensor, "N"]:
    """The frames on the convex hull of the first two principal scores, counter-clockwise.

    Source: CB02, Sec. 4.2: with more dimensions nearly every frame lies on the hull.

    Raises:
        ReenactError: The features move along one line only.
    """
    scores = principal_scores(features, 2).numpy()
    try:
        hull = ConvexHull(scores)
    except (QhullError, ValueError):
        raise ReenactError(
            f"convex hull: expected features that vary in two directions, got {scores.shape[1]} over {len(scores)} "
            "frames; choose key shapes by extremes"
        ) from None
    return torch.from_numpy(hull.vertices.astype(np.int64))


def _check_count(features: Tensor, count: int) -> None:
    if not 0 < count <= len(features):
        raise ReenactError(f"key shapes: expected 1 to {len(features)}, the number of frames, got {count}")


# Decomposition --------------------------------------------------------------------------------------------------------


def decompose(
    features: Float[Tensor, "T D"],
    key_features: Float[Tensor, "K D"],
    sum_to_one: bool = False,
    negative: bool = False,
    smoothness: float = 0.0,
) -> Float[Tensor, "T K"]:
    """Weights of the key shapes in every frame, in float64.

    Args:
        features: Q.
        key_features: S.
        sum_to_one: Let the weights of a frame sum to 1; the fit is then the same wherever the origin lies.
        negative: Allow negative weights, Eq. 3; for comparison only. The minimum-norm solution where there are many.
        smoothness: Penalty on change between frames, as a share of the mean squared length of the key shapes: keeps
            nearly equal key shapes from taking turns. Not with `negative`.

    Source: CB02, Eq. 4. The sum (a heavy extra row, 1000 times the root mean square of S) and the smoothness are ours.
    """
    wanted, basis = features.to(torch.float64), key_features.to(torch.float64)
    extra = 0.0
    if sum_to_one:
        middle = basis.mean(0)  # weights that sum to 1 take it off both sides; it would only cost precision
        wanted, basis = wanted - middle, basis - middle
        extra = 1e3 * float(basis.square().mean().sqrt()) or 1.0
        wanted = torch.cat([wanted, torch.full_like(wanted[:, :1], extra)], 1)
        basis = torch.cat([basis, torch.full_like(basis[:, :1], extra)], 1)
    if negative:
        return torch.linalg.lstsq(basis.T, wanted.T, driver="gelsd").solution.T
    gram = basis @ basis.T
    penalty = smoothness * float(gram.diagonal().mean() - extra**2)
    return nonnegative_least_squares(gram, wanted @ basis.T, ridge=1e-12, smoothness=penalty)


def reconstruction_error(
    features: Float[Tensor, "T D"], key_features: Float[Tensor, "K D"], weights: Float[Tensor, "T K"]
) -> float:
    """E, the summed squared distance of all frames from their sums of key shapes. Source: CB02, Eq. 5."""
    made = weights.to(torch.float64) @ key_features.to(torch.float64)
    return float((features.to(torch.float64) - made).square().sum())


# Head motion ----------------------------------------------------------------------------------------------------------


def affine_motion(
    features: Float[Tensor, "T N D"],
    reference: Float[Tensor, "N D"],
    still: Int[Tensor, "M"] | None = None,
) -> tuple[Float[Tensor, "T D D"], Float[Tensor, "T D"]]:
    """Linear part A and translation b of each frame: `reference @ A.T + b` lies closest to the features.

    Args:
        features: Tracked points in two or three dimensions.
        reference: The same points at rest.
        still: Points that move with the head only; all where None, which takes part of a wide smile for head motion.

    Raises:
        ReenactError: Too few points to tell an affine map, or points on one line or plane.

    Source: CB02, Sec. 3, which removes it before anything else.
    """
    dimensions = reference.shape[1]
    chosen = torch.arange(len(reference)) if still is None else still
    basis = torch.cat([reference[chosen], torch.ones_like(reference[chosen, :1])], 1).to(torch.float64)  # (M, D + 1)
    # Relative to their spread, so that the test does not depend on where the origin lies.
    spread = torch.linalg.svdvals(basis[:, :-1] - basis[:, :-1].mean(0))
    if len(chosen) <= dimensions or spread[-1] < 1e-6 * spread[0]:
        raise ReenactError(
            f"affine motion: expected more than {dimensions} still points that span {dimensions} dimensions, got "
            f"{len(chosen)}; drop a dimension or give more points"
        )
    fit = torch.linalg.pinv(basis) @ features[:, chosen].to(torch.float64)  # (T, D + 1, D)
    return fit[:, :dimensions].transpose(1, 2), fit[:, dimensions]


def without_affine_motion(
    features: Float[Tensor, "T N D"], linear: Float[Tensor, "T D D"], translation: Float[Tensor, "T D"]
) -> Float[Tensor, "T N D"]:
    """The features as if the head had rested: A^-1 (x - b)."""
    moved = features.to(torch.float64) - translation[:, None]
    return torch.linalg.solve(linear, moved.transpose(1, 2)).transpose(1, 2)


def in_plane_motion(linear: Float[Tensor, "T D D"]) -> tuple[Float[Tensor, "T"], Float[Tensor, "T"]]:
    """Angle in radians, counter-clockwise, and scale of the similarity nearest to A in the x-y plane.

    Source: CB02, Sec. 5: only these and the translation reach the target.
    """
    cosine = linear[:, 0, 0] + linear[:, 1, 1]
    sine = linear[:, 1, 0] - linear[:, 0, 1]
    return torch.atan2(sine, cosine), torch.hypot(sine, cosine) / 2


# Regions --------------------------------------------------------------------------------------------------------------


def region_masks(rig: Rig) -> dict[str, Float[Tensor, "V"]]:
    """How much of each vertex belongs to the eyes and to the mouth, summing to 1.

    The face is divided by height. Between one third and two thirds of the way from the lips to the eyes one region
    blends into the other linearly. Where lips and eyes are is told by the parts of the rig, else by where shapes with
    ARKit's names move most, else there is one region, the face.

    Source: CB02, Sec. 5, has the two regions and the linear blend; where they meet is ours.
    """
    lips, eyes = rig.part("lips"), rig.part("eyes")
    if len(lips) and len(eyes):
        low, high = float(rig.neutral[lips, 1].mean()), float(rig.neutral[eyes, 1].mean())
    else:
        heights = []
        for region in ("mouth", "eyelids"):
            shapes = [index for index, name in enumerate(rig.names) if arkit.canonical(name) in arkit.REGIONS[region]]
            energy = rig.deltas[shapes].square().sum((0, 2)).double()
            heights.append(float((energy * rig.neutral[:, 1]).sum() / energy.sum()) if energy.sum() > 0 else None)
        low, high = heights
    if low is None or high is None or not low < high:
        return {"face": torch.ones_like(rig.neutral[:, 0])}
    eyes_share = (3 * (rig.neutral[:, 1] - low) / (high - low) - 1).clamp(0, 1)
    return {"eyes": eyes_share, "mouth": 1 - eyes_share}


# The method -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class KeyShapesConfig:
    """How key shapes are chosen and frames decomposed."""

    selection: Literal["extremes", "clusters", "hull"] = "extremes"
    """Ends of the principal axes, centres of clusters, or the convex hull, which sets its own number."""
    eyes: int = 10
    """Key shapes of the eye region, as in the paper's first clip."""
    mouth: int = 12
    """Key shapes of the mouth region; both together where the face is one region."""
    form: Literal["offsets", "absolute", "sum_to_one"] = "offsets"
    """What is summed: offsets from the neutral (ours), positions as in the paper, or positions whose weights sum to 1,
    with the neutral as one more key shape. Only `absolute` moves a still face."""
    negative: bool = False
    """Plain least squares instead, Eq. 3, to see why not."""
    dimensions: int = 2
    """Principal axes that clusters are found in, 2 or 3."""
    snap: bool = False
    """Take the frame nearest to a cluster's centre instead of the mean of its frames."""
    median: int = 3
    """Frames of the median filter before choosing: the ends of axes are where tracking fails. 1 is none."""
    smoothness: float = 0.0
    """See `decompose`."""
    features: int = 60
    """Tracked places of each region, where none are given."""
    projected: bool = False
    """Drop the depth, as a camera in front does."""
    seed: int = 0
    """Of the clusters' starts and of the clip that is made where no training clip is given."""


@dataclass(frozen=True)
class _Region:
    """What one region knows."""

    places: Places
    frames: Int[Tensor, "K"]
    key_weights: Float[Tensor, "K Ks"]
    key_features: Float[Tensor, "K D"]
    target_weights: Float[Tensor, "K Kt"] | None
    target_meshes: Float[Tensor, "K V 3"] | None


class KeyShapes:
    """Decomposes frames of the source into key shapes of a training clip, and sums the target's key shapes alike."""

    def __init__(
        self,
        source: Rig,
        target: Rig,
        correspondence: Correspondence | None = None,
        training: Clip | None = None,
        *,
        config: KeyShapesConfig | None = None,
        features: Places | None = None,
        target_keys: Mapping[str, Tensor] | None = None,
    ) -> None:
        """
        Args:
            source: Plays the actress.
            target: Is animated.
            correspondence: Makes the target's key shapes, by proportion matching, where none are given; without it
                they are copied by name.
            training: Clip of the source in which key shapes are sought; where None, every shape rises and falls once,
                as in the range-of-motion takes of actors.
            config: Settings.
            features: Tracked places of the source; spread over what moves where None.
            target_keys: An artist's key shapes for each region, as weights (K, Kt) or as meshes (K, V, 3). Which
                expressions they must show is found in `frames` and `key_weights` of an object built without.

        Raises:
            ReenactError: The training clip has other names, no frames or no motion; given key shapes do not fit.
        """
        self.source, self.target = source, target
        self.config = config or KeyShapesConfig()
        if training is None:
            training = motion.synthesize(source.names, 2.0 * len(source.names), self.config.seed, kind="ramps")
        check_names(training, source)
        if len(training) < 2:
            raise ReenactError(f"training clip: expected at least two frames, got {len(training)}")
        self.training = training
        masks, self.masks = region_masks(source), region_masks(target)
        if masks.keys() != self.masks.keys():
            masks = {"face": torch.ones_like(source.neutral[:, 0])}
            self.masks = {"face": torch.ones_like(target.neutral[:, 0])}
        if target_keys is not None and target_keys.keys() != masks.keys():
            raise ReenactError(
                f"target key shapes: expected regions {', '.join(masks)}, got {', '.join(target_keys) or 'none'}"
            )
        energy = target.deltas.square().sum(2)  # (Kt, V)
        self._shares = {name: energy @ mask / energy.sum(1).clamp_min(1e-30) for name, mask in self.masks.items()}
        sculptor = None
        if target_keys is None:
            sculptor = (
                CopyNames(source, target)
                if correspondence is None
                else ProportionMatching(source, target, correspondence)
            )
        self._regions: dict[str, _Region] = {}
        for name, mask in masks.items():
            places = (
                _places_of_region(source, mask, self.config.features)
                if features is None
                else features[(features.of(torch.stack([mask, mask, mask], 1))[:, 0] >= 0.5).nonzero().flatten()]
            )
            self._regions[name] = self._prepare(name, places, sculptor, target_keys)
        self._inverse = InverseRig(target) if any(r.target_meshes is not None for r in self._regions.values()) else None

    @property
    def frames(self) -> dict[str, Int[Tensor, "K"]]:
        """Frames of the training clip that became key shapes, for the artist to see: the frame nearest to the centre
        of each cluster. The neutral that `sum_to_one` adds is -1."""
        return {name: region.frames for name, region in self._regions.items()}

    @property
    def key_weights(self) -> dict[str, Float[Tensor, "K Ks"]]:
        """The key shapes as weights of the source."""
        return {name: region.key_weights for name, region in self._regions.items()}

    def decompose(self, clip: Clip) -> dict[str, Float[Tensor, "T K"]]:
        """Weights of the key shapes of each region in every frame."""
        check_names(clip, self.source)
        return {name: self._decompose(region, clip.weights) for name, region in self._regions.items()}

    def vertices(self, clip: Clip) -> Float[Tensor, "T V 3"]:
        """Target vertices: the regions' sums of key shapes, blended by the masks. Source: CB02, Eq. 2."""
        made = torch.zeros(len(clip), *self.target.neutral.shape)
        for name, weights in self.decompose(clip).items():
            made += self.masks[name][:, None] * self._morph(self._regions[name], weights.float())
        return made

    def __call__(self, clip: Clip) -> Clip:
        """The clip on the target, weights in [0, 1].

        Where key shapes are weights, each shape of the target takes from every region as large a share as of its own
        motion lies there; where they are meshes, the weights are fitted to `vertices`.
        """
        if self._inverse is not None:
            return replace(clip, names=self.target.names, weights=self._inverse(self.vertices(clip)))
        summed = torch.zeros(len(clip), len(self.target.names))
        for name, weights in self.decompose(clip).items():
            summed += (weights.float() @ self._regions[name].target_weights) * self._shares[name]
        return replace(clip, names=self.target.names, weights=summed.clamp(0, 1))

    def _prepare(
        self,
        name: str,
        places: Places,
        sculptor: CopyNames | ProportionMatching | None,
        target_keys: Mapping[str, Tensor] | None,
    ) -> _Region:
        config, weights = self.config, self.training.weights.float()
        track = self._track(places, weights)
        track = torch.from_numpy(median_filter(track.numpy(), (config.median, 1), mode="nearest"))
        if float(track.std(0).max()) == 0:
            raise ReenactError(
                f"training clip: expected motion in the region {name}, got {len(track)} equal frames; train on a clip "
                "that moves the whole face"
            )
        count = min(getattr(config, name, config.eyes + config.mouth), len(track))
        if config.selection == "clusters":
            labels = cluster_frames(track, count, config.dimensions, config.seed)
            members = torch.nn.functional.one_hot(labels).double()  # (T, K)
            key_weights = ((members / members.sum(0)).T @ weights.double()).float()
            scores = principal_scores(track, config.dimensions)
            centers = (members / members.sum(0)).T @ scores
            frames = torch.cdist(scores, centers).argmin(0)
            if config.snap:
                key_weights = weights[frames]
        else:
            frames = convex_hull(track) if config.selection == "hull" else pca_extremes(track, count)
            key_weights = weights[frames]
        if config.form == "sum_to_one":
            frames = torch.cat([frames, torch.tensor([-1])])
            key_weights = torch.cat([key_weights, torch.zeros_like(key_weights[:1])])
        key_features = self._track(places, key_weights)
        target_weights, target_meshes = None, None
        if sculptor is not None:
            target_weights = sculptor(Clip(self.source.names, key_weights, self.training.fps)).weights
        elif target_keys[name].shape == (len(frames), len(self.target.names)):
            target_weights = target_keys[name].float()
        elif target_keys[name].shape == (len(frames), *self.target.neutral.shape):
            target_meshes = target_keys[name].float()
        else:
            raise ReenactError(
                f"target key shapes of the {name}: expected ({len(frames)}, {len(self.target.names)}) weights or "
                f"({len(frames)}, {len(self.target.neutral)}, 3) vertices, got {tuple(target_keys[name].shape)}"
            )
        return _Region(places, frames, key_weights, key_features, target_weights, target_meshes)

    def _flat(self, points: Float[Tensor, "T N 3"]) -> Float[Tensor, "T D"]:
        return points[..., : 2 if self.config.projected else 3].flatten(1)

    def _track(self, places: Places, weights: Float[Tensor, "T Ks"]) -> Float[Tensor, "T D"]:
        """Features of expressions of the source, about the middle of the places at rest."""
        neutral = places.of(self.source.neutral.double())
        moved = torch.einsum("tk,kni->tni", weights.double(), places.of(self.source.deltas.double()))
        return self._flat(neutral - neutral.mean(0) + moved)

    def _decompose(self, region: _Region, weights: Float[Tensor, "T Ks"]) -> Float[Tensor, "T K"]:
        features, keys = self._track(region.places, weights), region.key_features
        if self.config.form == "offsets":
            rest = self._track(region.places, torch.zeros_like(weights[:1]))
            features, keys = features - rest, keys - rest
        return decompose(features, keys, self.config.form == "sum_to_one", self.config.negative, self.config.smoothness)

    def _morph(self, region: _Region, weights: Float[Tensor, "T K"]) -> Float[Tensor, "T V 3"]:
        """F(w, B), about the target's middle where positions are summed."""
        if region.target_meshes is None:
            offsets = (region.target_weights @ self.target.deltas.flatten(1)).unflatten(1, (-1, 3))
        else:
            offsets = region.target_meshes - self.target.neutral
        neutral = self.target.neutral
        if self.config.form == "absolute":
            middle = neutral.mean(0)
            neutral = middle + weights.sum(1)[:, None, None] * (neutral - middle)
        return neutral + (weights @ offsets.flatten(1)).unflatten(1, (-1, 3))


def _places_of_region(rig: Rig, mask: Float[Tensor, "V"], count: int) -> Places:
    """Vertices spread over a region, denser where more moves."""
    motion_energy = rig.deltas.square().sum((0, 2)).sqrt() * (mask >= 0.5)
    moving = motion_energy > 0.01 * motion_energy.max()
    if not bool(moving.any()):
        raise ReenactError(f"{rig.name}: expected shapes that move the whole face, got a region where none does")
    weights = torch.where(moving, motion_energy, 0)
    return Places.at(farthest_points(rig.neutral, min(count, int(moving.sum())), weights))
