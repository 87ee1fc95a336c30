"""Numbers of one answer against the truth: of surfaces, weights and pictures.

No single number judges facial retargeting. Each function says what its number means and its trap;
`reenact.evaluation` puts them side by side with the trivial baselines that expose the traps.

Kim et al. 2021, "Deep Learning-Based Unsupervised Human Facial Retargeting", doi:10.1111/cgf.14400, for the error maps.
Wang et al. 2004, "Image Quality Assessment", doi:10.1109/TIP.2003.819861, for SSIM.

Symbol  Code       Shape
w_t     predicted  (T, K) weights of the target that a method found
w_t*    truth      (T, K) weights of the target that show the source's expression
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from skimage.metrics import structural_similarity
from torch import Tensor

from reenact.rigs.rig import Rig

_CHUNK = 64  # frames at a time: bounds memory, not results

# ---------------------------------------------------------------------------------------------------------------------
# Surfaces


def moving_vertices(rig: Rig) -> Int[Tensor, "N"]:
    """Vertices that some shape at weight 1 displaces by more than 1 % of the largest displacement of any shape."""
    length = rig.deltas.norm(dim=-1)  # (K, V)
    return (length > 0.01 * length.max()).any(0).nonzero().flatten()


def vertex_errors(
    rig: Rig, predicted: Float[Tensor, "T K"], truth: Float[Tensor, "T K"]
) -> tuple[Float[Tensor, "T"], Float[Tensor, "T"]]:
    """Per frame, metres: the mean distance of the moving vertices from the truth, and of the truth from the neutral."""
    deltas = rig.deltas[:, moving_vertices(rig)]  # (K, N, 3)
    flat = deltas.flatten(1)

    def mean_length(weights: Tensor) -> Tensor:
        parts = [(chunk @ flat).unflatten(-1, (-1, 3)).norm(dim=-1).mean(-1) for chunk in weights.split(_CHUNK)]
        return torch.cat(parts).double()

    # The neutral cancels in the difference of two expressions of one rig.
    weights = predicted.to(deltas), truth.to(deltas)
    return mean_length(weights[0] - weights[1]), mean_length(weights[1])


def vertex_error_ratio(rig: Rig, predicted: Float[Tensor, "T K"], truth: Float[Tensor, "T K"]) -> float:
    """VER, the headline: how far the surface is from the truth, over how far the truth moves from the neutral.

    0 is exact, 1 is as bad as leaving the target neutral, above 1 is worse than doing nothing. It compares across rigs
    and units, and large motions count most, as they do to the eye. Its trap: small but telling motions, a blink or a
    lip seal, hardly move it; see `lid_closure` and `lip_contact`. 0 where neither moves; infinite where only the
    prediction does.

    Source: the definition is ours; sum over frames and `moving_vertices` of |v(w_t) - v(w_t*)| / |v(0) - v(w_t*)|.
    """
    error, motion = vertex_errors(rig, predicted, truth)
    return _ratio(float(error.sum()), float(motion.sum()))


def ratio_interval(
    numerator: Float[Tensor, "T"],
    denominator: Float[Tensor, "T"],
    block: int = 15,
    resamples: int = 1000,
    seed: int = 0,
) -> tuple[float, float]:
    """95 % interval of sum(numerator) / sum(denominator) when other frames had been drawn.

    Whole blocks of neighbouring frames are resampled, since neighbours are nearly copies of each other. The
    trap: it says nothing about another training seed, whose effect is often larger.

    Source: Künsch 1989, "The Jackknife and the Bootstrap for General Stationary Observations"; blocks do not overlap.
    """
    sums = [
        torch.stack([part.sum() for part in values.double().split(block)]).numpy()
        for values in (numerator, denominator)
    ]
    drawn = np.random.default_rng(seed).integers(0, len(sums[0]), (resamples, len(sums[0])))
    below = sums[1][drawn].sum(1)
    ratios = sums[0][drawn].sum(1)[below > 0] / below[below > 0]
    if len(ratios) == 0:
        return 0.0, 0.0
    low, high = np.quantile(ratios, [0.025, 0.975])
    return float(low), float(high)


def apertures(rig: Rig, weights: Float[Tensor, "T K"], pairs: Int[Tensor, "N 2"]) -> Float[Tensor, "T"]:
    """Mean distance in metres between the upper and lower vertices of the pairs, per frame."""
    gap = rig.neutral[pairs[:, 0]] - rig.neutral[pairs[:, 1]]  # (N, 3)
    opening = rig.deltas[:, pairs[:, 0]] - rig.deltas[:, pairs[:, 1]]  # (K, N, 3)
    return (gap + torch.einsum("tk,knc->tnc", weights.to(opening), opening)).norm(dim=-1).mean(-1)


def event_f1(predicted: Bool[Tensor, "T"], truth: Bool[Tensor, "T"]) -> float:
    """F1 score of events, where an event is a run of true frames and meets another if they share a frame.

    1 where neither has an event: nothing was missed and nothing invented, but nothing was tested either.
    """
    runs = [_runs(values) for values in (predicted, truth)]
    if not runs[0] and not runs[1]:
        return 1.0
    hits = sum(bool(truth[start:stop].any()) for start, stop in runs[0])
    found = sum(bool(predicted[start:stop].any()) for start, stop in runs[1])
    precision, recall = hits / max(len(runs[0]), 1), found / max(len(runs[1]), 1)
    return 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0


def lid_closure(
    rig: Rig,
    predicted: Float[Tensor, "T K"],
    truth: Float[Tensor, "T K"],
    pairs: Int[Tensor, "N 2"],
    closed: float = 0.2,
) -> dict[str, float]:
    """How well one eye's blinks arrive.

    Returns:
        `error`, the mean absolute difference of the openings in units of the neutral opening; `blink_f1`, the F1 score
        of blinks, where a blink is a run of frames below `closed`; and `blinks`, how many the truth has. A blink is
        short: `error` averages it away, so a face that never blinks still has a small `error` and a `blink_f1` of 0.
    """
    neutral = apertures(rig, torch.zeros(1, len(rig.names)), pairs)[0]
    openings = [apertures(rig, weights, pairs) / neutral for weights in (predicted, truth)]
    return {
        "error": float((openings[0] - openings[1]).abs().mean()),
        "blink_f1": event_f1(openings[0] < closed, openings[1] < closed),
        "blinks": float(len(_runs(openings[1] < closed))),
    }


def lip_contact(
    rig: Rig,
    predicted: Float[Tensor, "T K"],
    truth: Float[Tensor, "T K"],
    pairs: Int[Tensor, "N 2"],
    face_height: float,
    touching: float = 0.005,
) -> dict[str, float]:
    """How well the lips open and meet.

    Returns:
        `gap_error`, the mean absolute difference of the lip gaps in units of the face height (metres); `contact_f1`,
        the F1 score of contacts: runs of frames whose gap exceeds that of the neutral, whose lips rest on each other,
        by less than `touching` face heights; and `contacts`, how many the truth has. Lips touch in most frames, so a
        mouth that never opens scores well on contact; read both together.
    """
    rest = apertures(rig, torch.zeros(1, len(rig.names)), pairs)
    gaps = [(apertures(rig, weights, pairs) - rest) / face_height for weights in (predicted, truth)]
    return {
        "gap_error": float((gaps[0] - gaps[1]).abs().mean()),
        "contact_f1": event_f1(gaps[0] < touching, gaps[1] < touching),
        "contacts": float(len(_runs(gaps[1] < touching))),
    }


# ---------------------------------------------------------------------------------------------------------------------
# Weights


def weight_metrics(predicted: Float[Tensor, "T K"], truth: Float[Tensor, "T K"]) -> dict[str, float]:
    """How close the weights are, shape by shape.

    Returns:
        wmae: Mean absolute error. Most weights are near 0 most of the time, so the neutral scores well too.
        amae: The same where the truth is above 0.1, which takes that advantage away.
        correlation: Pearson correlation over time, mean of the shapes that move in the truth. Blind to amplitude, and
            a shape that never moves in the prediction counts as 0.
        gain: Median over those shapes of the slope of prediction over truth: 1 is the right range of motion, 0.5 is
            half of it. Blind to noise.
        jitter: Mean size of the second difference in time, over that of the truth. Below 1 is smoother than the
            truth, which mushes speech as surely as jitter spoils it.

        Two sets of weights can show the same face (shapes cancel each other), so a rig with redundant shapes can have
        a low vertex error and poor numbers here.
    """
    shapes = per_shape(predicted, truth)
    moving = [shape for shape in shapes if shape["moves"]]
    error = (predicted - truth).abs().double()
    active = truth > 0.1
    return {
        "wmae": float(error.mean()),
        "amae": float(error[active].mean()) if bool(active.any()) else 0.0,
        "correlation": float(np.mean([shape["correlation"] for shape in moving])) if moving else 0.0,
        "gain": float(np.median([shape["gain"] for shape in moving])) if moving else 0.0,
        "jitter": jitter(predicted, truth),
    }


def per_shape(predicted: Float[Tensor, "T K"], truth: Float[Tensor, "T K"]) -> list[dict[str, Any]]:
    """`mae`, `correlation`, `gain`, `activity` (standard deviation of the truth) and whether it `moves`, per shape."""
    a, b = predicted.double(), truth.double()
    mae = (a - b).abs().mean(0)
    a, b = a - a.mean(0), b - b.mean(0)
    covariance, spread_a, spread_b = (a * b).mean(0), a.square().mean(0).sqrt(), b.square().mean(0).sqrt()
    rows = []
    for k in range(truth.shape[1]):
        moves = float(spread_b[k]) > 1e-4  # a ten-thousandth of the range is rounding in a file, not motion
        scale = float(spread_a[k] * spread_b[k])
        rows.append(
            {
                "mae": float(mae[k]),
                "correlation": float(covariance[k]) / scale if moves and scale > 1e-10 else 0.0,
                "gain": float(covariance[k] / spread_b[k] ** 2) if moves else 0.0,
                "activity": float(spread_b[k]),
                "moves": moves,
            }
        )
    return rows


def jitter(predicted: Float[Tensor, "T K"], truth: Float[Tensor, "T K"]) -> float:
    """Mean |w[f+1] - 2 w[f] + w[f-1]| of the prediction over that of the truth; 1 is ideal, and 0 over 0 counts as 1.

    Both hold frames of one clip: a cut between clips would count as motion.
    """
    sizes = [float(values.double().diff(n=2, dim=0).abs().sum()) for values in (predicted, truth)]
    return 1.0 if sizes == [0.0, 0.0] else _ratio(*sizes)


# ---------------------------------------------------------------------------------------------------------------------
# Pictures


def image_mae(pictures: Float[Tensor, "B C H W"], truth: Float[Tensor, "B C H W"]) -> Float[Tensor, "B"]:
    """Mean absolute difference of each picture, over pixels and channels in [0, 1].

    Background and still skin agree whatever a method does, so every number looks good: read `skill` beside it.
    """
    return (pictures - truth).abs().mean((1, 2, 3))


def masked_mae(
    pictures: Float[Tensor, "B C H W"], truth: Float[Tensor, "B C H W"], mask: Float[Tensor, "B 1 H W"]
) -> Float[Tensor, "B"]:
    """`image_mae` over the pixels of the mask alone; 0 for an empty mask. Still skin flatters it yet."""
    error = ((pictures - truth).abs() * mask).mean(1).sum((1, 2))
    return error / mask.sum((1, 2, 3)).clamp(min=1e-9)


def image_ssim(pictures: Float[Tensor, "B C H W"], truth: Float[Tensor, "B C H W"]) -> Float[Tensor, "B"]:
    """Structural similarity of each picture with its truth, 1 for equal pictures; mean over channels.

    The one definition used in this project: Gaussian window of 11 pixels with sigma 1.5, K1 0.01, K2 0.03, range 1.
    A flat background scores 1 and lifts the mean; at low resolution a shift of one pixel costs a lot.

    Source: Wang et al. 2004, through scikit-image.
    """
    count, channels, height, width = pictures.shape
    edge = 5  # half of the window, which scikit-image leaves out: so stacked pictures do not see each other
    tall = [values.permute(0, 2, 3, 1).reshape(-1, width, channels).cpu().numpy() for values in (pictures, truth)]
    _, similarity = structural_similarity(
        *tall,
        full=True,
        channel_axis=-1,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        K1=0.01,
        K2=0.03,
    )
    inner = similarity.reshape(count, height, width, channels)[:, edge:-edge, edge:-edge]
    return torch.from_numpy(inner.mean((1, 2, 3), dtype=np.float64))


def psnr(pictures: Float[Tensor, "B C H W"], truth: Float[Tensor, "B C H W"]) -> float:
    """Peak signal-to-noise ratio in dB of the mean squared error over all pictures; infinite for equal ones.

    Taken of the mean error, not averaged over pictures: one perfect picture would make an average infinite.
    """
    return psnr_of(float((pictures - truth).double().square().mean()))


def psnr_of(mean_squared_error: float) -> float:
    """dB of a mean squared error of values in [0, 1]; infinite for 0."""
    return math.inf if mean_squared_error <= 0 else -10 * math.log10(mean_squared_error)


def skill(mae: float, mae_neutral: float) -> float:
    """1 - MAE / MAE of the neutral picture: 0 is no better than a face that never moves, 1 is exact.

    This is what makes picture errors mean something across rigs, framings and clips.
    """
    return 1.0 - _ratio(mae, mae_neutral)


def error_map(pictures: Float[Tensor, "B C H W"], truth: Float[Tensor, "B C H W"]) -> Float[Tensor, "H W"]:
    """Distance in RGB, channels in [0, 1], of each pixel; mean over pictures. Source: Kim et al. 2021, error maps."""
    return (pictures - truth).square().sum(1).sqrt().mean(0)


def _runs(values: Tensor) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], values.cpu().numpy().astype(np.int8), [0]])))
    return [(int(start), int(stop)) for start, stop in zip(edges[::2], edges[1::2])]


def _ratio(numerator: float, denominator: float) -> float:
    if denominator > 0:
        return numerator / denominator
    return 0.0 if numerator == 0 else math.inf
