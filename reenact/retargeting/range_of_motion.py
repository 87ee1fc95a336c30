"""How far and which way an actor moves for each shape of a rig, learnt from unlabelled expressions.

Ours; it answers the question of Ribera et al. 2017 (`manifold_alignment`) by a model of the data instead of by similar
frames. An expression is a sum of the actor's versions of few shapes, and an actor's version is the guess, larger or
smaller, plus what the guess has wrong:

    da_f = sum_k w_kf rho_k (dg_k + e_k) + noise,   w_kf >= 0,   e_k^m ~ Normal(0, spread^2 |dg_k^m|^2)

What a large shape has wrong is larger than a whole small shape. So the weights of a frame are fitted with each marker
counting as little as the active shapes leave it uncertain; frames in which a shape does not look like itself once the
others are taken away do not tell its range; and a shape's own error is learnt where it shows.

Symbol  Code         Shape
dg_k    guess        (K, M, 3) the rig's shapes in the actor's proportions
da_f    training     (F, M, 3) the actor's displacements
w_kf    weights      (F, K)
rho_k   amplitudes   (K,)
        certainty    (F, M) one over the variance of a marker in a frame
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass

import numba
import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.signal import find_peaks
from threadpoolctl import threadpool_limits
from torch import Tensor

from reenact.retargeting.inverse_rig import nonnegative_least_squares


@dataclass(frozen=True)
class RangeConfig:
    """How the range of motion is learnt. Lengths are relative, so that neither units nor the size of a head matter."""

    peak: float = 1.0
    """The largest weight that a shape is expected to reach in the training: 1 where it is a full range of motion, less
    where its expressions stop short. All amplitudes scale with its inverse."""
    spread: float = 0.3
    """How wrong the guess may be, as a share of each marker's displacement."""
    elsewhere: float = 0.05
    """The same for markers that hardly move, as a share of the shape's largest displacement."""
    noise: float = 0.03
    """Noise of a marker, as a share of the median shape's largest displacement."""
    misfit: float = 4.0
    """How much what stays unexplained at a marker adds to its noise: an actor who does what no mix of the rig's shapes
    does must not teach them."""
    sparsity: float = 0.002
    """What a weight loses by the penalty on activity."""
    agreement: float = 0.9
    """A frame counts for a shape's range if what is left of it when the other shapes are taken away is as similar to
    the shape as this share of the best frame's similarity."""
    frames: int = 6
    """Frames looked at for each shape: as many of the strongest, and of the purest."""
    spacing: int = 6
    """Frames between two that are looked at for one shape; 1 where the training is no sequence."""
    limit: float = 3.0
    """Largest change of amplitude, either way."""
    rounds: int = 4
    """Rounds that learn what the guess has wrong."""


@dataclass(frozen=True)
class RangeOfMotion:
    """What was learnt; float64."""

    amplitudes: Float[Tensor, "K"]
    """rho: how much further than the guess the actor goes, before directions are learnt."""
    shapes: Float[Tensor, "K M 3"]
    """dp: the actor's version of each shape."""
    covered: Int[Tensor, "K"]
    """1 where the training shows a shape, 0 where nothing but the guess is known of it."""
    frames: Int[Tensor, "N"]
    """The frames that were looked at."""


def learn_range_of_motion(
    guess: Float[Tensor, "K M 3"], training: Float[Tensor, "F M 3"], config: RangeConfig | None = None
) -> RangeOfMotion:
    """The actor's version of each shape; with `rounds=0` amplitudes only, directions as they are guessed."""
    config = config or RangeConfig()
    guess64 = np.ascontiguousarray(guess.double().numpy())
    energy = (guess64**2).sum((1, 2))
    moving = energy > 1e-12 * max(energy.max(), 1e-300)
    amplitudes, shapes = np.ones(len(guess64)), guess64.copy()
    covered, frames = np.zeros(len(guess64), dtype=np.int64), np.zeros(0, dtype=np.int64)
    if moving.any() and len(training) and bool(training.any()):
        rough = _rough_weights(torch.from_numpy(guess64[moving]), training)
        frames = _telling_frames(rough, energy[moving], config)
        displacements = np.ascontiguousarray(training[torch.from_numpy(frames)].double().numpy())
        with threadpool_limits(1, user_api="blas"):  # the products are small: two threads take four times as long
            found = _learn(guess64[moving], displacements, rough[frames], config)
        amplitudes[moving], shapes[moving], covered[moving] = found
    return RangeOfMotion(*(torch.from_numpy(array) for array in (amplitudes, shapes, covered, frames)))


def _learn(
    guess: Float[np.ndarray, "K M 3"],
    displacements: Float[np.ndarray, "N M 3"],
    weights: Float[np.ndarray, "N K"],
    config: RangeConfig,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Amplitudes (K,), shapes (K, M, 3) and whether each is covered (K,)."""
    squares = (guess**2).sum(2)  # (K, M)
    largest = squares.max(1, keepdims=True)
    support = squares > 0.01 * largest
    prior = config.spread**2 * (squares + config.elsewhere**2 * largest) / 3  # variance of a coordinate of e_k^m
    least = config.noise**2 * np.median(largest)
    noise = np.full(guess.shape[1], least)  # (M,) variance of a coordinate
    shapes, variance, amplitudes = guess.copy(), prior.copy(), np.ones(len(guess))
    covered = np.zeros(len(guess), dtype=np.int64)

    def weigh(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        certainty = 1 / (noise + weights**2 @ variance)  # (N, M)
        fitted, similarity = weights.copy(), np.zeros_like(weights)
        _fit(shapes, displacements, certainty, config.sparsity, support, fitted, similarity)
        # What neither the shapes nor their uncertainty explain is no error of any one shape.
        rest = (displacements - np.einsum("nk,kmi->nmi", fitted, shapes)) ** 2
        unexplained = (rest.sum(2) / 3 - fitted**2 @ variance).clip(min=0).mean(0)
        noise[:] = np.maximum(least, config.misfit * unexplained)
        certainty = 1 / (noise + fitted**2 @ variance)
        return fitted, similarity, certainty

    for _ in range(2):  # the second time the uncertainty has the right size
        weights, similarity, certainty = weigh(weights)
        peaks = _peaks(weights, similarity, config.agreement)
        covered = (peaks * amplitudes > 0.05).astype(np.int64)
        wanted = np.where(covered, amplitudes * peaks / config.peak, 1.0).clip(1 / config.limit, config.limit)
        growth = wanted / amplitudes
        amplitudes, weights = wanted, weights / growth
        shapes, variance = shapes * growth[:, None, None], variance * growth[:, None] ** 2
    for last in reversed(range(config.rounds)):
        scale = amplitudes[:, None]
        shapes, variance = _update(guess * scale[..., None], prior * scale**2, displacements, weights, certainty)
        if last:
            weights, similarity, certainty = weigh(weights)
    return amplitudes, shapes, covered


def _rough_weights(guess: Tensor, training: Tensor) -> Float[np.ndarray, "F K"]:
    """Weights under the guess, shrunk a little, to see which frames matter."""
    flat = guess.flatten(1)
    gram = flat @ flat.T
    projections = training.double().flatten(1) @ flat.T - 0.02 * gram.diagonal()
    return nonnegative_least_squares(gram, projections).numpy()


def _telling_frames(weights: np.ndarray, energy: np.ndarray, config: RangeConfig) -> Int[np.ndarray, "N"]:
    """Frames in which some shape is strong, or purest: has most of the frame's motion."""
    motion = weights**2 @ energy + 1e-300
    chosen: set[int] = set()
    for k, track in enumerate(weights.T):
        peaks = find_peaks(np.concatenate([[0.0], track, [0.0]]), distance=config.spacing)[0] - 1
        strength = track[peaks]
        purity = strength * np.sqrt(strength**2 * energy[k] / motion[peaks])
        for score in (strength, purity):
            chosen.update(peaks[np.argsort(-score, kind="stable")[: config.frames]].tolist())
    return np.array(sorted(chosen), dtype=np.int64)


def _peaks(weights: np.ndarray, similarity: np.ndarray, agreement: float) -> Float[np.ndarray, "K"]:
    """The largest weight of each shape among frames in which it looks like itself."""
    # The similarity of a faint trace is chance.
    considered = np.where(weights > 0.2 * weights.max(0), similarity, -1.0)
    return np.where(considered >= agreement * considered.max(0), weights, 0.0).max(0)


def _update(
    centre: Float[np.ndarray, "K M 3"],
    prior: Float[np.ndarray, "K M"],
    displacements: Float[np.ndarray, "N M 3"],
    weights: Float[np.ndarray, "N K"],
    certainty: Float[np.ndarray, "N M"],
) -> tuple[np.ndarray, np.ndarray]:
    """The most probable shapes (K, M, 3) given the weights, and what variance is left (K, M)."""
    count, markers = prior.shape
    products = (weights[:, :, None] * weights[:, None, :]).reshape(len(weights), -1)
    precision = (certainty.T @ products).reshape(markers, count, count)
    precision[:, np.arange(count), np.arange(count)] += 1 / prior.T
    data = np.stack([weights.T @ (certainty * displacements[:, :, axis]) for axis in range(3)], axis=2)
    covariance = np.linalg.inv(precision)
    shapes = covariance @ (data + centre / prior[..., None]).transpose(1, 0, 2)  # (M, K, 3)
    return np.ascontiguousarray(shapes.transpose(1, 0, 2)), np.einsum("mkk->km", covariance).copy()


# The loop, on numpy arrays --------------------------------------------------------------------------------------------


def _compiled(function):
    # An import hook that checks types, as in our tests, wraps every function; the compiler needs the bare one.
    return numba.njit(cache=True, nogil=True, error_model="numpy")(inspect.unwrap(function))


@_compiled
def _fit(shapes, displacements, certainty, sparsity, support, weights, similarity):
    """Non-negative weights of each frame under its own certainties, and how much each shape looks like itself in it.

    In place. Similar is what the other shapes leave of the frame: its correlation with the shape over the markers that
    the shape moves; 0 for inactive shapes.
    """
    count, markers, _ = shapes.shape
    rows, frame_row = np.empty((count, 3 * markers)), np.empty(3 * markers)
    for frame in range(len(displacements)):
        for m in range(markers):
            root = np.sqrt(certainty[frame, m])
            for axis in range(3):
                frame_row[3 * m + axis] = root * displacements[frame, m, axis]
                for k in range(count):
                    rows[k, 3 * m + axis] = root * shapes[k, m, axis]
        gram = rows @ rows.T
        found = weights[frame]
        ridge = 1e-6 * np.trace(gram) / count
        gradient = gram @ found - rows @ frame_row
        for _ in range(200):
            moved = 0.0
            for k in range(count):
                slope = gradient[k] + ridge * found[k] + sparsity * gram[k, k]
                value = max(found[k] - slope / (gram[k, k] + ridge), 0.0)
                change = value - found[k]
                if change != 0.0:
                    found[k] = value
                    moved = max(moved, abs(change))
                    for j in range(count):
                        gradient[j] += change * gram[k, j]
            if moved < 1e-4:
                break
        rest = frame_row - rows.T @ found
        for k in range(count):
            similarity[frame, k] = 0.0
            if found[k] > 0.0:
                common, own, left = 0.0, 0.0, 0.0
                for m in range(markers):
                    if support[k, m]:
                        for i in range(3 * m, 3 * m + 3):
                            row = rows[k, i]
                            value = rest[i] + found[k] * row
                            common += row * value
                            own += row * row
                            left += value * value
                similarity[frame, k] = common / np.sqrt(own * left + 1e-300)
