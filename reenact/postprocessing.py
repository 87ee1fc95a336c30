"""What is done to a finished clip, shape by shape, because an animator asked for it.

In this order: the resting face becomes zero, noise goes, then gain, offset, limits and locks. Ours; the smoothing is
that of Takeda, Farsiu and Milanfar 2007, "Kernel Regression for Image Processing and Reconstruction",
doi:10.1109/TIP.2006.888330, in time instead of in a picture.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from reenact.config import PostConfig
from reenact.errors import ReenactError
from reenact.rigs.clip import Clip

_RIDGE = 1e-3
"""Of slope and curvature, where a frame counts as 1."""


def postprocess(clip: Clip, config: PostConfig) -> Clip:
    """The clip with everything that the settings ask for; the same clip where they ask for nothing.

    Raises:
        ReenactError: A setting names a shape that the clip lacks, the rest lies outside the clip, or a lower limit is
            above its upper one.
    """
    weights = clip.weights
    if config.rest is not None:
        weights = calibrated(weights, _resting(clip, config.rest, config.rest_seconds))
    if config.smooth:
        weights = smoothed(weights, config.smooth * clip.fps, config.smooth_range)
    if config.gain:
        weights = weights * _per_shape(clip.names, config.gain, 1.0, "gain").to(weights)
    if config.offset:
        weights = weights + _per_shape(clip.names, config.offset, 0.0, "offset").to(weights)
    low = _per_shape(clip.names, config.low, -torch.inf, "low").to(weights)
    high = _per_shape(clip.names, config.high, torch.inf, "high").to(weights)
    if bool((low > high).any()):
        name = clip.names[int((low > high).nonzero()[0])]
        raise ReenactError(f"post: {name}: expected post.low below post.high, got the reverse")
    if config.low or config.high:
        weights = weights.clamp(low, high)
    if config.lock:
        held = _per_shape(clip.names, config.lock, torch.nan, "lock").to(weights)
        weights = torch.where(held.isnan(), weights, held)
    return clip if weights is clip.weights else replace(clip, weights=weights)


def calibrated(weights: Float[Tensor, "T K"], rest: Float[Tensor, "K"]) -> Float[Tensor, "T K"]:
    """Weights with `rest` at 0 and 1 where it was; what lay below the rest is 0.

    Args:
        weights: In [0, 1].
        rest: Weights that a tracker gave for a face at rest; a shape resting at 1 stays as it is.
    """
    span = 1 - rest
    return torch.where(span > 1e-6, ((weights - rest) / span.clamp_min(1e-6)).clamp_min(0), weights)


def smoothed(weights: Float[Tensor, "T K"], width: float, reach: float) -> Float[Tensor, "T K"]:
    """Weights without their small fast changes; large ones, such as a blink, stay as sharp as they were.

    Around each frame a parabola is laid through its neighbours, which count by how near they are in time and how near
    in value: a frame of a blink differs from the frames beside it by more than `reach` and keeps its value, and the
    top of a smile, which a mean would wear down, is a parabola already. Never beyond what the neighbours had.

    Args:
        weights: Any.
        width: Standard deviation in time, frames.
        reach: Standard deviation in weight; changes well above it are motion, well below it noise.

    Source: data-adapted kernel regression of second order, Takeda et al. 2007, Sec. III, over time. The ridge, which
    makes a mean of the parabola where neighbours hardly count, and the limits are ours.
    """
    radius = min(int(3 * width + 0.5), len(weights) - 1)
    if radius < 1:  # also without any width
        return weights
    values = weights.double()
    least, greatest = values, values
    moments = torch.diag(values.new_tensor([0, _RIDGE, _RIDGE])).expand(*values.shape, 3, 3).clone()
    total = values.new_zeros(*values.shape, 3)
    frames = torch.arange(len(weights), device=weights.device)
    for shift in range(-radius, radius + 1):
        there = frames + shift
        inside = ((there >= 0) & (there < len(weights))).to(values)[:, None]
        neighbour = values[there.clamp(0, len(weights) - 1)]
        least, greatest = least.minimum(neighbour), greatest.maximum(neighbour)
        near = torch.exp(-0.5 * ((neighbour - values) / reach).square() - 0.5 * (shift / width) ** 2) * inside
        powers = values.new_tensor([1, shift / width, (shift / width) ** 2])
        moments += near[:, :, None, None] * torch.outer(powers, powers)
        total += (near * neighbour)[:, :, None] * powers
    return torch.linalg.solve(moments, total)[:, :, 0].clamp(least, greatest).to(weights)


def _resting(clip: Clip, start: float, seconds: float) -> Float[Tensor, "K"]:
    """Median weights of the part of the clip in which the face rests."""
    first, last = round(start * clip.fps), round((start + seconds) * clip.fps)
    if not 0 <= first < len(clip):
        raise ReenactError(f"post.rest: expected a time within the clip of {clip.duration:.2f} s, got {start:g} s")
    return clip.weights[first : max(last, first + 1)].median(0).values


def _per_shape(names: tuple[str, ...], values: Mapping[str, float], default: float, key: str) -> Float[Tensor, "K"]:
    """The value for each shape; of several patterns that fit, the last counts."""
    found = torch.full((len(names),), default)
    for pattern, value in values.items():
        fits = [index for index, name in enumerate(names) if fnmatch.fnmatchcase(name.lower(), pattern.lower())]
        if not fits:
            raise ReenactError(f"post.{key}: no shape is called {pattern}; the clip has {', '.join(names)[:200]}")
        found[fits] = value
    return found
