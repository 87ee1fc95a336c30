"""A rig's shapes personalised to an actor, from sparse markers and unlabelled expressions of the actor.

Ribera et al. 2017, "Facial Retargeting with Automatic Range of Motion Alignment", doi:10.1145/3072959.3073674. The
actor is our source, the rig our target. Four presets: `paper` is the publication to the letter; `robust` keeps its
energy but picks frames and weighs terms so that it does not shrink shapes; `quantile` and `residual` replace the
energy by a model of the data (`range_of_motion`) and are ours.

Paper            Code                        Shape
a_0, s_0         neutrals                    (M, 3) markers at rest, of the actor and of the size-matched rig
da_f             training                    (F, M, 3) displacements of the actor
ds_k             shapes                      (K, M, 3) what the rig's shapes do to the markers
dg_k             guess                       (K, M, 3) the same by the thin-plate map of `rbf`
dp_k             personalised                (K, M, 3) what we look for: the actor's version of ds_k
c_kf, c_kl       similarity                  (K, F), (K, K)
t_k              trust                       (K,)
c~_kf            enhanced                    (K, F)
u_k              masks                       (K, M)
alpha, beta      mesh_weight, graph_weight
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from scipy.signal import find_peaks
from torch import Tensor

from reenact.errors import ReenactError
from reenact.geometry import farthest_points
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.geometric_prior import FrameSolver, bending, sparsity_thresholds
from reenact.retargeting.marker_mesh import marker_mesh, surface_distances
from reenact.retargeting.range_of_motion import RangeConfig, learn_range_of_motion
from reenact.retargeting.rbf import carry_shapes
from reenact.retargeting.retargeter import check_names
from reenact.rigs import motion
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig

PRESETS = ("paper", "robust", "quantile", "residual")
MASKS = ("soft", "saturating", "none")

_STEEPNESS = 15.0  # r
_CENTIMETRES = 100.0  # in a metre: mu and lambda of the paper are meant for centimetres


@dataclass(frozen=True)
class AlignmentConfig:
    """How Eq. 4 is set up; the defaults are the paper's."""

    mask: str = "soft"
    """One of `MASKS`, see `soft_masks`."""
    mesh_weight: float = 0.01
    """alpha of Eq. 4."""
    graph_weight: float = 0.1
    """beta of Eq. 4."""
    averaged: bool = True
    """Divide Eq. 11 and 13 by the number of markers, as printed; it makes both all but vanish beside Eq. 10."""
    ensure_coverage: bool = False
    """Keep each shape's most similar frame among the key expressions."""
    best: int | None = None
    """Match a shape with only so many of its best frames, rows of Eq. 10 normalised; key expressions where None."""
    limit: float | None = None
    """Largest change of a shape's size against the guess, either way."""


PAPER = AlignmentConfig()
ROBUST = AlignmentConfig(mask="saturating", mesh_weight=0.1, graph_weight=0.05, averaged=False, best=3, limit=3.0)


# Similarity of the motion spaces --------------------------------------------------------------------------------------


def similarity(shapes: Float[Tensor, "K M 3"], frames: Float[Tensor, "F M 3"]) -> Float[Tensor, "K F"]:
    """Correlation about the neutral, in [-1, 1]; 0 where either side hardly moves.

    Source: RB17, Eq. 5. That near-neutral frames count 0 is ours: their correlation is noise.
    """
    a, b = shapes.double().flatten(1), frames.double().flatten(1)
    size_a, size_b = a.norm(dim=1), b.norm(dim=1)
    still_a, still_b = (size <= 1e-6 * _median_moving(size) for size in (size_a, size_b))
    correlation = (a @ b.T) / (size_a[:, None] * size_b + 1e-300)
    return correlation.masked_fill(still_a[:, None] | still_b, 0.0).clamp(-1, 1)


def trust(shapes: Float[Tensor, "K M 3"]) -> Float[Tensor, "K"]:
    """How far a shape is unlike all larger ones: 1 for the largest, 0 for the most redundant. Source: RB17, Eq. 6."""
    size = shapes.double().flatten(1).norm(dim=1)
    order = size.argsort(descending=True, stable=True)
    positive = similarity(shapes, shapes).clamp_min(0)[order][:, order]  # c+, largest shape first
    redundancy = positive.tril(-1).sum(1)
    most = redundancy.max()
    result = torch.ones_like(size)
    if most > 0:
        result[order] = 1 - redundancy / most
    return result


def contrast(positive: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Correlations pushed apart around one half. Source: RB17, Eq. 7, whose quotient is a logistic function."""
    return torch.sigmoid(_STEEPNESS * (positive - 0.5))


def enhance(correlation: Float[Tensor, "K F"], trusted: Float[Tensor, "K"]) -> Float[Tensor, "K F"]:
    """Similarity with contrast for trusted shapes, as it is for others; in [0, 1]. Source: RB17, Eq. 8."""
    positive = correlation.clamp_min(0)
    return (1 - trusted)[:, None] * positive + trusted[:, None] * contrast(positive)


def key_expressions(enhanced: Float[Tensor, "K F"], ensure_coverage: bool = False) -> Int[Tensor, "N"]:
    """Frames at which the summed similarity has a peak, plateaus counting once.

    Source: RB17, Sec. 4.2. "Three frames wide" is read as a Gaussian of sigma 0.5 over three taps.
    """
    taps = torch.exp(-0.5 * (torch.tensor([-1.0, 0.0, 1.0], dtype=enhanced.dtype) / 0.5) ** 2)
    padded = torch.nn.functional.pad(enhanced[:, None], (1, 1), mode="replicate")
    smooth = torch.nn.functional.conv1d(padded, (taps / taps.sum())[None, None])[:, 0]
    curve = torch.nn.functional.pad(smooth.sum(0), (1, 1), value=-1.0)  # ends can be peaks, too
    # Correlation does not change while a lone shape fades in and out; rounding must not make peaks of that plateau.
    found = find_peaks(curve.round(decimals=9).numpy(), plateau_size=1)[0] - 1
    chosen = set(found.tolist())
    if ensure_coverage:
        chosen.update(enhanced.argmax(1)[enhanced.amax(1) > 0].tolist())
    return torch.tensor(sorted(chosen), dtype=torch.int64)


def soft_masks(shapes: Float[Tensor, "K M 3"], kind: str = "soft") -> Float[Tensor, "K M"]:
    """How much each marker belongs to each shape, in [0, 1].

    Args:
        shapes: Displacements.
        kind: "soft" is the length over the shape's largest, as published; "saturating" reaches 1 at a tenth of the
            largest, so that it separates left from right without shrinking; "none" is 1 everywhere.

    Source: RB17, Sec. 4.3; "saturating" is ours.
    """
    if kind not in MASKS:
        raise ReenactError(f"manifold alignment: expected a mask among {', '.join(MASKS)}, got {kind}")
    length = shapes.double().norm(dim=-1)
    share = length / length.amax(1, keepdim=True).clamp_min(1e-300)
    return {"soft": share, "saturating": (10 * share).clamp_max(1), "none": torch.ones_like(share)}[kind]


def expression_graph(shapes: Float[Tensor, "K M 3"]) -> Float[Tensor, "K K"]:
    """G, the signed Laplacian of the graph of all shapes: (G ds)_k = Lap(ds_k). Rows sum to 0. Source: RB17, Eq. 12."""
    weights = similarity(shapes, shapes)
    weights.fill_diagonal_(0)
    weights = weights / weights.abs().sum(1, keepdim=True).clamp_min(1e-300)
    return weights - torch.diag(weights.sum(1))


# Personalised shapes --------------------------------------------------------------------------------------------------


def solve_alignment(
    matched: Float[Tensor, "K M 3"],
    match_weights: Float[Tensor, "K"],
    shapes: Float[Tensor, "K M 3"],
    guess: Float[Tensor, "K M 3"],
    laplacian: Float[Tensor, "M M"],
    graph: Float[Tensor, "K K"],
    mesh_weight: float,
    graph_weight: float,
) -> Float[Tensor, "K M 3"]:
    """The exact minimum of Eq. 4: sum_k D_k |dp_k|^2 - 2 <matched_k, dp_k>, and both constraints.

    The system is (D + beta G^T G) (x) I + I (x) alpha L^T L: a Kronecker sum, which the eigenvectors of a K x K and an
    M x M matrix make diagonal. The paper solves the sparse system of K M unknowns.

    Args:
        matched: Sum over frames of similarity times masked displacement.
        match_weights: D, the sum of the similarities.
        shapes: ds.
        guess: dg.
        laplacian: L of the marker mesh.
        graph: G of the shapes.
        mesh_weight: alpha, with all its factors.
        graph_weight: beta, with all its factors.

    Source: RB17, Eq. 10 to 13; the solver is ours, as is a trace of |dp - dg|^2, for shapes that nothing else holds.
    """
    relations = graph_weight * graph.T @ graph
    theta, left = torch.linalg.eigh(torch.diag(match_weights) + relations)
    stiffness = mesh_weight * laplacian.T @ laplacian
    lam, right = torch.linalg.eigh(stiffness)
    anchor = 1e-8 * (theta.mean() + lam.mean())
    if anchor <= 0:
        anchor = torch.ones_like(anchor)  # nothing but the guess counts
    wanted = matched + anchor * guess
    wanted = wanted + torch.einsum("mn,kni->kmi", stiffness, guess) + torch.einsum("kl,lmi->kmi", relations, shapes)
    spectrum = torch.einsum("ka,kmi,mb->abi", left, wanted, right)
    spectrum = spectrum / (theta[:, None] + lam + anchor).clamp_min(anchor)[..., None]
    return torch.einsum("ka,abi,mb->kmi", left, spectrum, right)


def align(
    shapes: Float[Tensor, "K M 3"],
    guess: Float[Tensor, "K M 3"],
    training: Float[Tensor, "F M 3"],
    laplacian: Float[Tensor, "M M"],
    config: AlignmentConfig = PAPER,
    spacing: int = 6,
) -> Float[Tensor, "K M 3"]:
    """Personalised shapes by the energy of the paper, Eq. 4.

    Args:
        shapes: ds, size matched: Eq. 13 compares them with the actor's.
        guess: dg.
        training: da, a sequence.
        laplacian: Of the marker mesh.
        config: Its terms.
        spacing: Frames between two that match one shape, where `config.best` is set.
    """
    shapes, guess, training = shapes.double(), guess.double(), training.double()
    enhanced = enhance(similarity(shapes, training), trust(shapes))
    masks = soft_masks(shapes, config.mask)
    if config.best is None:
        frames = key_expressions(enhanced, config.ensure_coverage)
        weights = enhanced[:, frames] / max(len(frames), 1)
    else:
        weights = _best_frames(enhanced, shapes, training, config.best, spacing)
        frames = weights.any(0).nonzero().flatten()
        weights = weights[:, frames]
    matched = masks[..., None] * torch.einsum("kf,fmi->kmi", weights, training[frames])  # Eq. 10
    divisor = shapes.shape[1] if config.averaged else 1
    personalised = solve_alignment(
        matched,
        weights.sum(1),
        shapes,
        guess,
        laplacian.double(),
        expression_graph(shapes),
        config.mesh_weight / divisor,
        config.graph_weight / divisor,
    )
    if config.limit is not None:
        wanted, size = (x.flatten(1).norm(dim=1) for x in (guess, personalised))
        ratio = (size / wanted.clamp_min(1e-300)).clamp_min(1e-12)
        personalised = personalised * (ratio.clamp(1 / config.limit, config.limit) / ratio)[:, None, None]
    return personalised


def _best_frames(enhanced: Tensor, shapes: Tensor, training: Tensor, count: int, spacing: int) -> Float[Tensor, "K F"]:
    """Weights of each shape's best frames, summing to 1; 0 for shapes that no frame resembles."""
    flat = shapes.flatten(1)
    extent = (flat @ training.flatten(1).T) / flat.square().sum(1, keepdim=True).clamp_min(1e-300)
    score = torch.where(enhanced >= 0.3, enhanced * extent.clamp_min(0), 0.0)
    weights = torch.zeros_like(enhanced)
    for k, row in enumerate(score):
        left = row.clone()
        for _ in range(count):
            best = int(left.argmax())
            if left[best] <= 0:
                break
            weights[k, best] = enhanced[k, best]
            left[max(0, best - spacing + 1) : best + spacing] = 0
    return weights / weights.sum(1, keepdim=True).clamp_min(1e-300)


def personalise(
    shapes: Float[Tensor, "K M 3"],
    guess: Float[Tensor, "K M 3"],
    training: Float[Tensor, "F M 3"],
    laplacian: Float[Tensor, "M M"] | None = None,
    preset: str = "quantile",
    *,
    peak: float = 1.0,
    spacing: int = 6,
) -> Float[Tensor, "K M 3"]:
    """dp, the actor's version of each shape, from markers alone.

    Args:
        shapes: ds, size matched to the actor.
        guess: dg.
        training: da, the actor's displacements over a range of motion.
        laplacian: Of the marker mesh; only `paper` and `robust` need it.
        preset: One of `PRESETS`.
        peak: Largest weight that a shape is expected to reach in the training, for `quantile` and `residual`.
        spacing: Frames between two that may count as different expressions; 1 where the training is no sequence.

    Raises:
        ReenactError: Unknown preset, sizes that disagree, no Laplacian where it is needed.
    """
    if preset not in PRESETS:
        raise ReenactError(f"manifold alignment: expected a preset among {', '.join(PRESETS)}, got {preset}")
    if shapes.shape != guess.shape or training.shape[1:] != shapes.shape[1:] or len(training) == 0:
        raise ReenactError(
            f"manifold alignment: expected shapes, a guess and frames of the same markers, got {tuple(shapes.shape)}, "
            f"{tuple(guess.shape)} and {tuple(training.shape)}"
        )
    if preset in ("paper", "robust"):
        if laplacian is None:
            raise ReenactError(f"manifold alignment: preset {preset} needs the Laplacian of a marker mesh, got none")
        return align(shapes, guess, training, laplacian, PAPER if preset == "paper" else ROBUST, spacing)
    rounds = 0 if preset == "quantile" else RangeConfig.rounds
    return learn_range_of_motion(guess, training, RangeConfig(peak=peak, spacing=spacing, rounds=rounds)).shapes


# Weights of frames ----------------------------------------------------------------------------------------------------


def frame_solver(
    personalised: Float[Tensor, "K M 3"],
    preset: str = "quantile",
    bent: Float[Tensor, "K K"] | None = None,
    *,
    sparsity: float | None = None,
    prior: float | None = None,
    importance: Float[Tensor, "M"] | None = None,
) -> FrameSolver:
    """What finds the weights of frames, Eq. 16, with the constants of a preset.

    `paper` means its mu = 0.3 and lambda = 0.6 in centimetres, and allows weights of any sign. Everything else is free
    of units, keeps weights in [0, 1], and has no prior unless it is asked for: once shapes are personalised, it costs
    more than it prevents.

    Args:
        personalised: dp, metres.
        preset: One of `PRESETS`.
        bent: `bending` of the rig, square metres at the size of the actor; no prior where None.
        sparsity: lambda, 0.6 where None; for all other presets what a shape that acts alone loses of its weight, 0.003.
        prior: mu, 0.3 where None; for all other presets the strength of the prior beside that of the data, 0.
        importance: How much each marker counts.
    """
    count = len(personalised)
    if preset == "paper":
        strength = 0.6 if sparsity is None else sparsity
        return FrameSolver(
            personalised * _CENTIMETRES,
            None if bent is None else bent * _CENTIMETRES**2,
            0.3 if prior is None else prior,
            torch.full((count,), strength / (2 * count), dtype=torch.float64),
            importance=importance,
            low=-math.inf,
            high=math.inf,
        )
    thresholds = sparsity_thresholds(personalised, 0.003 if sparsity is None else sparsity)
    if bent is None or not prior:
        return FrameSolver(personalised, thresholds=thresholds, importance=importance)
    data = personalised.double().square().sum() / personalised.shape[1]  # the trace of H
    mu = prior * float(data / bent.diagonal().sum().clamp_min(1e-300))
    return FrameSolver(personalised, bent, mu, thresholds, importance=importance)


def solve_frames(
    personalised: Float[Tensor, "K M 3"],
    displacements: Float[Tensor, "T M 3"],
    preset: str = "quantile",
    bent: Float[Tensor, "K K"] | None = None,
) -> Float[Tensor, "T K"]:
    """Weights of the rig for an actor's frames; see `frame_solver`, which is for frames that come one by one."""
    return frame_solver(personalised, preset, bent)(displacements)


# The retargeter -------------------------------------------------------------------------------------------------------


def range_of_motion(names: tuple[str, ...], count: int = 2000) -> Clip:
    """Expressions that show all that a rig can do: random ones, and each shape alone; no sequence."""
    weights = torch.cat([motion.expressions(names, count, seed=0), torch.eye(len(names))])
    return Clip(tuple(names), weights, fps=30.0)


class ManifoldAlignment:
    """Finds what the target's shapes look like on the source, then weights that explain the source by them."""

    def __init__(
        self,
        source: Rig,
        target: Rig,
        correspondence: Correspondence | None = None,
        training: Clip | None = None,
        *,
        preset: str = "quantile",
        markers: int = 300,
        sparsity: float | None = None,
        prior: float | None = None,
    ) -> None:
        """
        Args:
            source: The actor.
            target: The rig.
            correspondence: Pairs of places, of which markers are chosen where the faces move.
            training: A sequence of the source that covers its range of motion; `range_of_motion` where None.
            preset: One of `PRESETS`.
            markers: Most markers that are used, spread evenly; the paper has 99.
            sparsity: See `frame_solver`.
            prior: See `frame_solver`.

        Raises:
            ReenactError: No correspondence, an unknown preset, training of another rig, too few moving pairs.
        """
        if correspondence is None:
            raise ReenactError(f"{source.name} to {target.name}: manifold alignment needs a correspondence, got none")
        if preset not in PRESETS:
            raise ReenactError(f"manifold alignment: expected a preset among {', '.join(PRESETS)}, got {preset}")
        if training is not None and (training.names != source.names or len(training) == 0):
            raise ReenactError(
                f"training clip: expected frames of the {len(source.names)} shapes of {source.name}, in its order, got "
                f"{len(training)} frames of {len(training.names)} shapes"
            )
        self.source, self.target, self.preset = source, target, preset
        self.correspondence = _markers(source, target, correspondence, markers)
        carried = carry_shapes(source, target, self.correspondence)
        full = range_of_motion(source.names) if training is None else training
        shown = full.weights.amax(0)
        peak = float(shown[shown > 0.05].mean()) if bool((shown > 0.05).any()) else 1.0
        neutral = carried.target_neutral
        if preset in ("paper", "robust"):
            distances = surface_distances(target, self.correspondence.target) * carried.scale
            laplacian = marker_mesh(neutral, distances).laplacian(neutral)
        else:
            laplacian = None
        self.personalised = personalise(
            carried.shapes,
            carried.guess,
            carried.displacements(full.weights),
            laplacian,
            preset,
            peak=peak,
            spacing=1 if training is None else 6,
        )
        self.solver = frame_solver(
            self.personalised,
            preset,
            bending(target) * carried.scale**2 if preset == "paper" or prior else None,
            sparsity=sparsity,
            prior=prior,
            importance=carried.confidence,
        )
        in_centimetres = _CENTIMETRES if preset == "paper" else 1.0
        self._projection = self.solver.project(carried.source_shapes * in_centimetres)  # (Ks, Kt)

    def __call__(self, clip: Clip) -> Clip:
        """The clip on the target; weights in [0, 1], but of any sign and size under `paper`, as published."""
        check_names(clip, self.source)
        weights = self.solver.solve(clip.weights.double() @ self._projection)
        return replace(clip, names=self.target.names, weights=weights.float())

    def step(self, weights: Float[Tensor, "Ks"], last: Float[Tensor, "Kt"] | None = None) -> Float[Tensor, "Kt"]:
        """Weights of the target for one frame, in time for the next; `last` is the result of the frame before."""
        projections = weights.double()[None] @ self._projection
        return self.solver.solve(projections, None if last is None else last.double()[None])[0].float()


def _markers(source: Rig, target: Rig, correspondence: Correspondence, count: int) -> Correspondence:
    """The pairs at which either face moves by more than 2 % of its largest motion, thinned to an even spread."""
    moves = torch.zeros(len(correspondence), dtype=torch.bool)
    for rig, places in ((source, correspondence.source), (target, correspondence.target)):
        length = places.of(rig.deltas).norm(dim=-1).amax(0)  # (N,)
        moves |= length > 0.02 * rig.deltas.norm(dim=-1).max()
    moves &= correspondence.confidence > 0
    chosen = moves.nonzero().flatten()
    if len(chosen) < 4:
        raise ReenactError(
            f"{source.name} to {target.name}: expected at least 4 pairs where the faces move, got {len(chosen)} of "
            f"{len(correspondence)}; spread the correspondence over mouth, eyes and brows"
        )
    if len(chosen) > count:
        points = correspondence.source.of(source.neutral)[chosen]
        chosen = chosen[farthest_points(points, count, correspondence.confidence[chosen])]
    return correspondence[chosen]


def _median_moving(sizes: Tensor) -> Tensor:
    moving = sizes[sizes > 0]
    return moving.median() if len(moving) else sizes.new_zeros(())
