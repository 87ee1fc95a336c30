"""Samples at uneven times made into frames at a constant rate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float

from reenact.errors import ReenactError
from reenact.rigs.clip import Clip


def steady(
    where: str, times: Float[np.ndarray, "T"], weights: Float[np.ndarray, "T K"], single: float = 30.0
) -> tuple[Float[np.ndarray, "N K"], float]:
    """The same motion at a constant rate, and that rate in frames per second.

    The rate is that of the usual step between samples, taken as whole where it is within 0.2 % of that. Evenly spaced
    samples come back as they are. Otherwise rows are put in the order of their times, of rows closer than a quarter
    step the last counts (a doubled frame), and frames are linear between the rows (a dropped frame).

    Args:
        where: File, for messages.
        times: Seconds.
        weights: One row per time.
        single: Rate to give a single sample.

    Raises:
        ReenactError: No samples, a time that is not finite, or gaps so long that frames would outnumber samples by 20.
    """
    if len(times) == 0:
        raise ReenactError(f"{where}: expected at least one frame, got none")
    sound = np.abs(times) < 1e12
    if not sound.all():
        raise ReenactError(f"{where}: times must be finite, row {int((~sound).argmax()) + 1} is not")
    order = np.argsort(times, kind="stable")
    times, weights = times[order], weights[order]
    with np.errstate(over="ignore"):
        steps = np.diff(times)
        if not (steps > 0).any():
            return weights[-1:], single
        step = float(np.quantile(steps[steps > 0], 0.5, method="lower"))
        last_of_each = np.append(steps > 0.25 * step, True)
        times, weights = times[last_of_each], weights[last_of_each]
        if len(times) == 1:
            return weights, single
        span = float(times[-1] - times[0])
        even = span / (len(times) - 1)
        evenly = np.abs(times - times[0] - even * np.arange(len(times))).max() < 0.02 * even
        fps = 1 / (even if evenly else step)
        whole = float(round(min(max(fps, 1), 1e6)))
        # Even samples stay as they are: the whole rate must fit them to a tenth of a frame up to the last.
        if abs(fps - whole) < 0.002 * whole and not (evenly and abs(span * whole - len(times) + 1) > 0.1):
            fps = whole
    if fps > 1e6 or span * fps > 20 * len(times) + 1000:
        raise ReenactError(
            f"{where}: expected about one row per frame, got {len(times)} rows over {span:.6g} s at {fps:.6g} fps; "
            "check the times"
        )
    if evenly:
        return weights, fps
    grid = times[0] + np.arange(round(span * fps) + 1) / fps
    return np.stack([np.interp(grid, times, column) for column in weights.T], axis=1), fps


def resampled(clip: Clip, fps: float) -> Clip:
    """The same motion at another rate: weights are linear between frames, the first frame stays the first.

    Raises:
        ReenactError: The rate is not a number from 1 to 1000.
    """
    if not 1 <= fps <= 1000:
        raise ReenactError(f"expected 1 to 1000 frames per second, got {fps:g}")
    if fps == clip.fps or len(clip) == 0:
        return replace(clip, fps=fps)
    last = (len(clip) - 1) / clip.fps
    places = torch.arange(int(last * fps + 1e-6) + 1, dtype=torch.float64) * (clip.fps / fps)
    before = places.floor().long().clamp(max=len(clip) - 1)
    share = (places - before).to(clip.weights)[:, None]
    after = (before + 1).clamp(max=len(clip) - 1)
    weights = clip.weights[before] * (1 - share) + clip.weights[after] * share
    rotations = clip.rotations
    if rotations is not None:
        rotations = rotations[before] * (1 - share) + rotations[after] * share
    return replace(clip, weights=weights, fps=fps, rotations=rotations)
