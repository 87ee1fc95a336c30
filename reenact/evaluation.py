"""How good a trained run is, in numbers that are hard to fool.

No single number judges facial retargeting. Each function below says what its number means and its trap; `evaluate`
puts them side by side with the trivial baselines that expose the traps: a face that never moves, one that always
holds the average pose, and the right expressions at the wrong time.

Kim et al. 2021, "Deep Learning-Based Unsupervised Human Facial Retargeting", doi:10.1111/cgf.14400, for the cyclic
protocol and the error maps. Wang et al. 2004, "Image Quality Assessment", doi:10.1109/TIP.2003.819861, for SSIM.

Symbol  Code       Shape
w_t     predicted  (T, K) weights of the target that a method found
w_t*    truth      (T, K) weights of the target that show the source's expression
"""

from __future__ import annotations

import io
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import lsq_linear
from skimage.metrics import structural_similarity
from torch import Tensor

from reenact.atomic import write_atomically
from reenact.errors import ReenactError
from reenact.retargeting.correspondence import Correspondence, find_correspondence
from reenact.retargeting.retargeter import Retargeter
from reenact.rigs import motion
from reenact.rigs.clip import Clip
from reenact.rigs.matching import matching
from reenact.rigs.rig import Rig

KINDS = motion.KINDS
"""Kinds of held-out clips. Each probes something else: a method can shine on speech and miss every blink."""

HELD_OUT_SEED = 1_000_000_000
"""Held-out clips take seeds from here on, far from those that training uses or that anyone types."""

_CHUNK = 64  # frames at a time: bounds memory, not results


@runtime_checkable
class PictureRetargeter(Protocol):
    """What evaluation asks of a retargeter that works through pictures; `reenact.inference.ImageRetargeter` is one.

    Pictures begin with three channels of colour in [0, 1], which are compared; what follows is for the networks.
    """

    source: Rig
    target: Rig

    def __call__(self, clip: Clip) -> Clip: ...
    def step(self, weights: Tensor) -> Tensor: ...
    def source_pictures(self, weights: Tensor) -> Tensor: ...
    def target_pictures(self, weights: Tensor) -> Tensor: ...
    def source_masks(self, weights: Tensor) -> Tensor: ...
    def target_masks(self, weights: Tensor) -> Tensor: ...
    def reenact(self, pictures: Tensor) -> Tensor: ...
    def read(self, pictures: Tensor) -> Tensor: ...
    def read_direct(self, pictures: Tensor) -> Tensor: ...
    def paired(self, weights: Tensor) -> Tensor | None: ...


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


def true_weights(
    source: Rig, target: Rig, weights: Float[Tensor, "T Ks"]
) -> tuple[Float[Tensor, "T Ks"], Float[Tensor, "T Kt"], list[int]]:
    """What the target should do, as far as names tell.

    Between rigs that share names the same shapes get the same weights (`matching`). Equal names promise equal meaning
    only between rigs of one maker; across makers a part of the error is a difference of opinion between sculptors. A
    merged character (`anny:merged`) shares names but not ranges, and stands for the full set that it was made from by a
    known matrix: from it the weights are those of the full set, to it they are the bounded least-squares fit to the
    full set's vertices. So it is for a built-in character with other shapes altogether (`anny:units`): its own head
    with ARKit's shapes says what it should do.

    Returns:
        The source's weights with every shape at rest whose meaning the target does not know; the target's weights;
        and the indices of the target's shapes that the truth covers, none where the rigs share no name.
    """
    full_source, source_matrix = _unmerged(source)
    full_target = _told_by(full_source, target)
    shared = matching(full_source.names, full_target.names)
    there = shared.any(0).nonzero().flatten().tolist()
    known = weights.clone()
    known[:, source_matrix[~shared.any(1)].abs().sum(0) > 0] = 0
    truth = known @ source_matrix.T @ shared
    if full_target is target:
        return known, truth.clamp(0, 1), there
    return known, _fit(full_target, truth, target), list(range(len(target.names))) if there else []


def true_return(source: Rig, target: Rig, truth: Float[Tensor, "T Kt"]) -> Float[Tensor, "T Ks"]:
    """The source's weights that come back where the target shows the truth and both ways are exact.

    What they lack is what the target cannot show: cyclic numbers of a faithful method end about there. Ours.

    Args:
        source: Where motion came from, and comes back to.
        target: Between both, of names that `true_weights` knows.
        truth: What `true_weights` asks of the target.
    """
    full_source = _unmerged(source)[0]
    full_target = _told_by(full_source, target)
    shown = truth if full_target is target else _fit(target, truth, full_target)
    back = shown @ matching(full_target.names, full_source.names)
    return back if full_source is source else _fit(full_source, back, source)


def _told_by(source: Rig, target: Rig) -> Rig:
    """The target's head with the shapes that the source's names tell of; the target itself where its own are those."""
    if not matching(source.names, target.names).any():
        return _in_arkit(target)
    return _unmerged(target)[0]


def _in_arkit(rig: Rig) -> Rig:
    """The head of a built-in character with ARKit's shapes; other rigs as they are."""
    from reenact.rigs import anny

    return anny.with_arkit_shapes(rig.name) if rig.name in anny.CAST else rig


def _unmerged(rig: Rig) -> tuple[Rig, Tensor]:
    """The rig whose shapes a merged character combines, and the matrix (K_full, K) of weights; or the rig itself."""
    if rig.name.startswith("anny:"):
        from reenact.rigs import anny

        if rig.name in anny.CAST and anny.CAST[rig.name].merged:
            return anny.before_merging(rig.name), anny.merged_matrix()[2]
    return rig, torch.eye(len(rig.names))


def _fit(full: Rig, weights: Tensor, target: Rig) -> Tensor:
    """Weights in [0, 1] of `target` whose vertices lie closest to those of `full`, which has the same vertices."""
    basis, triangle = torch.linalg.qr(target.deltas.flatten(1).double().T)  # (3 V, K), (K, K)
    wanted = weights.double() @ (full.deltas.flatten(1).double() @ basis)  # (T, K)
    rows = [lsq_linear(triangle.numpy(), row.numpy(), (0, 1)).x for row in wanted]
    return torch.from_numpy(np.stack(rows)).float()


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


def skill(mae: float, mae_neutral: float) -> float:
    """1 - MAE / MAE of the neutral picture: 0 is no better than a face that never moves, 1 is exact.

    This is what makes picture errors mean something across rigs, framings and clips.
    """
    return 1.0 - _ratio(mae, mae_neutral)


def error_map(pictures: Float[Tensor, "B C H W"], truth: Float[Tensor, "B C H W"]) -> Float[Tensor, "H W"]:
    """Distance in RGB, channels in [0, 1], of each pixel; mean over pictures. Source: Kim et al. 2021, error maps."""
    return (pictures - truth).square().sum(1).sqrt().mean(0)


# ---------------------------------------------------------------------------------------------------------------------
# Protocol


def held_out_clips(names: tuple[str, ...], frames: int, seed: int, fps: float = 30.0) -> dict[str, Clip]:
    """One clip of each of `KINDS`, `frames` in all, from seeds that training never uses.

    Blinks are rare: theirs is the liveliest stretch of a clip four times as long. The same goes for clips under two
    seconds, which could lie in a pause.

    Raises:
        ReenactError: Too few frames for every kind to have three.
    """
    if frames < 3 * len(KINDS):
        raise ReenactError(
            f"evaluation: expected at least {3 * len(KINDS)} frames, three for each of {len(KINDS)} kinds of clip, "
            f"got {frames}; ask for more frames"
        )
    clips = {}
    for i, kind in enumerate(KINDS):
        count = frames // len(KINDS) + (i < frames % len(KINDS))
        length = max(4 * count if kind == "blinks" else count, round(2 * fps))
        made = motion.synthesize(names, length / fps, HELD_OUT_SEED + 100 * seed + i, fps, kind)
        activity = made.weights.sum(1).unfold(0, count, 1).sum(1)  # of every stretch of `count` frames
        start = int(activity.argmax())
        clips[kind] = Clip(made.names, made.weights[start : start + count], fps)
    return clips


def evaluate(
    run_dir: Path,
    frames: int = 600,
    seed: int = 0,
    say: Callable[[str], None] = lambda _: None,
    methods: Sequence[str] = (),
    source: str | None = None,
    target: str | None = None,
    checkpoint: str = "newest",
    device: str = "cpu",
) -> dict:
    """The numbers of a finished run, also written to `RUN/evaluation/metrics.json`.

    Beside it `frames.npz` keeps the weights of every held-out frame (source, predicted, truth where known, recovered,
    direct, methods) and the error maps, for reports and for those who want to look closer.

    Args:
        run_dir: Folder that training wrote.
        frames: Held-out frames in all; their pictures stay in memory, some 0.1 GB per 600 at 64 pixels.
        seed: Of the held-out clips; the same seed gives the same clips for every run on the same rigs.
        say: Called with a few words before each stage.
        methods: Geometric methods to measure beside it, on the same frames.
        source: A rig of a cast, by any of its names; the run's first unless said.
        target: Another; the second unless said.
        checkpoint: The "newest", the "best", or a step; see `load_checkpoint`.
        device: Where pictures are rendered and networks run; what they say is compared on the CPU.

    Returns:
        See `evaluate_retargeters`, and `run`, the folder's name; `checkpoint`, the step of the networks where they are
        not the newest.

    Raises:
        ReenactError: Too few frames; an unknown method, or one that cannot work on these rigs; the run cannot be
            loaded.
    """
    from reenact.inference import ImageRetargeter
    from reenact.retargeting import METHODS

    for name in methods:
        if name not in METHODS:
            raise ReenactError(f"evaluation: expected methods among {', '.join(METHODS)}, got {name}")

    if frames < 3 * len(KINDS):
        held_out_clips((), frames, seed)  # raises before the slow loading
    say("loading the networks")
    load = partial(ImageRetargeter.load, run_dir, source=source, target=target, device=device, checkpoint=checkpoint)
    forward, reverse = load(), load(reverse=True)
    others = {}
    for name in methods:
        say(f"preparing {name}")
        others[name] = METHODS[name](forward.source, forward.target, _correspondence(forward, name))
    numbers, arrays = evaluate_retargeters(forward, reverse, frames, seed, say, others)
    numbers = {"run": run_dir.resolve().name, **numbers}
    if checkpoint != "newest" and forward.older is not None:
        numbers["checkpoint"] = forward.older
    folder = run_dir / "evaluation"
    folder.mkdir(parents=True, exist_ok=True)
    packed = io.BytesIO()
    np.savez_compressed(packed, **arrays)
    write_atomically(folder / "frames.npz", packed.getvalue())
    write_atomically(folder / "metrics.json", (json.dumps(finite(numbers), indent=2) + "\n").encode())
    return numbers


def _correspondence(forward: Any, method: str) -> Correspondence | None:
    """The one that the run found, or found now; names alone need none."""
    if method in ("copy", "neutral"):
        return None
    known = forward.run.correspondence(*forward.keys)
    if known is not None:
        return known
    return find_correspondence(forward.source, forward.target, forward.run.config.pairs.markers)


@torch.no_grad()
def evaluate_retargeters(
    forward: PictureRetargeter,
    reverse: PictureRetargeter,
    frames: int = 600,
    seed: int = 0,
    say: Callable[[str], None] = lambda _: None,
    methods: Mapping[str, Retargeter] | None = None,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """All numbers of a pair of retargeters, and the frames they were measured on.

    Returns:
        Numbers, nested:

        - `truth`: `ver` with its 95 % interval `ver_interval`, `ve_mm`, and `weight_metrics` against `true_weights`,
          which the rigs' shared names call right; `lids`, `lips` where the target's contacts are known. None where the
          rigs share no name. Source shapes without a partner are left at rest here, so that the truth is known.
        - `cyclic`: source -> target -> source, pictures of the recovered weights against the original ones: `mae`,
          `ssim`, `mae_masked`, `skill`; and `wmae`, `ver`, `correlation` on the source rig. Needs no truth, hence works
          for any two rigs. Its trap: two networks that smuggle the source's weights through a meaningless target
          face have a perfect cycle. Never read it without `truth`, or without looking.
        - `bpnet`: BPNet alone, on pictures of the target itself: `wmae`, `ver`, `correlation`, `psnr`, `ssim`. The
          floor under `truth`: the pipeline cannot read better than this.
        - `decoded`: pictures that ReenactNet draws against the target's with the true weights. `truth` minus `bpnet`,
          seen in pictures. None where the truth is.
        - `speed`: one frame at a time, rendering included: `fps`, `latency_ms_p50`, `latency_ms_p99`.
        - `baselines`: `neutral`, `mean_pose` (of the truth, so a generous one) and `shuffled` (true frames in random
          order), each with `truth` and `cyclic`.
        - `direct`: the ablation that feeds the source's residual picture straight to the target's BPNet. ReenactNet
          earns its place by beating it.
        - `paired`: the pairs of shapes that training found, applied to the weights without any network; None without
          pairs. Zero where every shape of one rig has its partner on the other: read `truth` beside it.
        - `methods`: the `truth` of each of `methods`, None without one.
        - `kinds`: `truth` and `cyclic` per kind of clip. `shapes`: `per_shape` by name. `worst`: frames by falling
          vertex error.

        Numbers over all kinds pool the frames; jitter is the mean of the clips.
        Arrays, per frame: `source`, `predicted`, `recovered`, `direct`, `method NAME` weights, `kind` (index into
        `KINDS`); `truth` and `error` (metres) where known; error maps `map_cyclic`, `map_cyclic_neutral`, `map_truth`,
        `map_truth_neutral` (H, W).

    Source: cyclic protocol of Kim et al. 2021, Sec. 4; all else is ours.
    """
    source, target = forward.source, forward.target
    clips = held_out_clips(source.names, frames, seed)
    fps = next(iter(clips.values())).fps
    weights = torch.cat([clip.weights for clip in clips.values()])  # (T, Ks)
    kinds = {kind: _span(clips, kind) for kind in clips}

    say("retargeting there and back")
    predicted = _retarget(forward, clips)
    recovered = _retarget(reverse, _split(target.names, predicted, kinds, fps))
    cycle = _PictureComparison(forward.source_pictures, forward.source_masks, weights)
    direct = _in_chunks(forward.read_direct, cycle.pictures)
    direct_back = _in_chunks(lambda part: reverse.read_direct(reverse.source_pictures(part)), direct)
    paired = forward.paired(weights)
    order = torch.randperm(len(weights), generator=torch.Generator().manual_seed(seed))

    say("comparing pictures of the cycle")
    returned = {
        "reenact": recovered,
        "direct": direct_back,
        "neutral": torch.zeros_like(weights),
        "mean_pose": weights.mean(0).expand_as(weights),
    }
    if paired is not None:
        returned["paired"] = reverse.paired(paired)
    cycle.against(returned).against_pictures("shuffled", cycle.pictures[order])
    returned["shuffled"] = weights[order]
    cyclic = {
        name: {kind: _cyclic(source, cycle, name, weights, returned[name], span) for kind, span in _spans(kinds)}
        for name in returned
    }

    say("comparing methods")
    moved = {f"method {name}": _retarget(method, clips) for name, method in (methods or {}).items()}
    say("comparing with the truth")
    known, truth, covered = true_weights(source, target, weights)
    true: dict[str, dict[str, Any]] = {}
    decoded, shapes, worst = None, [], []
    arrays: dict[str, np.ndarray] = {}
    if covered:
        answers, pictures = {"reenact": predicted, "direct": direct}, cycle.pictures
        if not torch.equal(known, weights):  # shapes without a partner would move the target in unknown ways
            pictures = _in_chunks(forward.source_pictures, known)
            answers["reenact"] = _retarget(forward, _split(source.names, known, kinds, fps))
            answers["direct"] = _in_chunks(forward.read_direct, pictures)
        if paired is not None:
            answers["paired"] = forward.paired(known)
        for name, method in (methods or {}).items():
            same, key = torch.equal(known, weights), f"method {name}"
            answers[key] = moved[key] if same else _retarget(method, _split(source.names, known, kinds, fps))
        answers |= {
            "neutral": torch.zeros_like(truth),
            "mean_pose": truth.mean(0).expand_as(truth),
            "shuffled": truth[order],
        }
        contacts = contacts_of(target)
        true = {
            name: {
                kind: true_numbers(target, answer, truth, covered, span, list(kinds.values()), contacts)
                for kind, span in _spans(kinds)
            }
            for name, answer in answers.items()
        }
        drawn = _in_chunks(forward.reenact, pictures)
        seen = _PictureComparison(forward.target_pictures, forward.target_masks, truth)
        seen.against({"reenact": answers["reenact"], "neutral": answers["neutral"]}).against_pictures("decoded", drawn)
        decoded = _picture_numbers(seen, "decoded", slice(None))
        error, _ = vertex_errors(target, answers["reenact"], truth)
        worst = error.argsort(descending=True).tolist()
        shapes = [
            {"name": target.names[j], **row}
            for j, row in zip(covered, per_shape(answers["reenact"][:, covered], truth[:, covered]), strict=True)
        ]
        arrays = {
            "truth": truth.numpy(),
            "truth_source": known.numpy(),
            "truth_predicted": answers["reenact"].numpy(),
            "error": error.numpy(),
            "map_truth": seen.maps["reenact"],
            "map_truth_neutral": seen.maps["neutral"],
        }

    say("testing BPNet on the target's own pictures")
    bpnet = _bpnet(forward, frames, seed)
    say("measuring speed")
    seconds = speed(forward, weights)

    def summary(name: str, kind: str) -> dict[str, Any]:
        return {"truth": true[name][kind] if true else None, "cyclic": cyclic[name][kind]}

    numbers = {
        "source": source.name,
        "target": target.name,
        "frames": len(weights),
        "seed": seed,
        "shared_shapes": len(covered),
        **summary("reenact", "all"),
        "bpnet": bpnet,
        "decoded": decoded,
        "speed": seconds,
        "baselines": {name: summary(name, "all") for name in ("neutral", "mean_pose", "shuffled")},
        "direct": summary("direct", "all"),
        "paired": None if paired is None else summary("paired", "all"),
        "methods": {name: {"truth": true[f"method {name}"]["all"] if true else None} for name in methods or {}},
        "kinds": {kind: summary("reenact", kind) for kind in kinds},
        "shapes": shapes,
        "worst": worst,
    }
    arrays |= {
        "source": weights.numpy(),
        "predicted": predicted.numpy(),
        "recovered": recovered.numpy(),
        "direct": direct.numpy(),
        "kind": np.concatenate([np.full(span.stop - span.start, i) for i, span in enumerate(kinds.values())]),
        "map_cyclic": cycle.maps["reenact"],
        "map_cyclic_neutral": cycle.maps["neutral"],
    }
    arrays |= {name: weights.numpy() for name, weights in moved.items()}
    return numbers, arrays


def finite(value: Any) -> Any:
    """The same nested numbers with None for infinities and NaN, which JSON cannot hold."""
    if isinstance(value, Mapping):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


class _PictureComparison:
    """Scores of several candidates against the pictures of one set of weights, which are rendered once per chunk."""

    def __init__(
        self, render: Callable[[Tensor], Tensor], render_masks: Callable[[Tensor], Tensor], truth: Tensor
    ) -> None:
        self.render = render
        self.pictures = _in_chunks(lambda part: _once_each(render, part), truth)
        self.masks = _in_chunks(lambda part: _once_each(render_masks, part), truth)
        self.scores: dict[str, dict[str, Tensor]] = {}
        self.maps: dict[str, np.ndarray] = {}

    def against(self, candidates: dict[str, Tensor]) -> _PictureComparison:
        for name, weights in candidates.items():
            parts = weights.split(_CHUNK)
            self._compare(name, (_once_each(self.render, part) for part in parts))
        return self

    def against_pictures(self, name: str, pictures: Tensor) -> _PictureComparison:
        self._compare(name, iter(pictures.split(_CHUNK)))
        return self

    def _compare(self, name: str, chunks: Any) -> None:
        rows: dict[str, list[Tensor]] = {"mae": [], "ssim": [], "mae_masked": [], "mse": []}
        total = torch.zeros(self.pictures.shape[-2:], dtype=torch.float64)
        colors = self.pictures[:, :3]
        for pictures, truth, mask in zip(chunks, colors.split(_CHUNK), self.masks.split(_CHUNK), strict=True):
            shown = pictures[:, :3]
            rows["mae"].append(image_mae(shown, truth))
            rows["ssim"].append(image_ssim(shown, truth))
            rows["mae_masked"].append(masked_mae(shown, truth, mask))
            rows["mse"].append((shown - truth).square().mean((1, 2, 3)))
            total += error_map(shown, truth) * len(shown)
        self.scores[name] = {key: torch.cat(parts).double() for key, parts in rows.items()}
        self.maps[name] = (total / len(self.pictures)).float().numpy()


def _picture_numbers(comparison: _PictureComparison, name: str, span: slice) -> dict[str, float]:
    means = {key: float(values[span].mean()) for key, values in comparison.scores[name].items()}
    neutral = float(comparison.scores["neutral"]["mae"][span].mean())
    return {
        "mae": means["mae"],
        "ssim": means["ssim"],
        "mae_masked": means["mae_masked"],
        "skill": skill(means["mae"], neutral),
        "psnr": psnr_of(means["mse"]),
    }


def _cyclic(
    source: Rig, comparison: _PictureComparison, name: str, original: Tensor, recovered: Tensor, span: slice
) -> dict[str, float]:
    weights = weight_metrics(recovered[span], original[span])
    return {
        **_picture_numbers(comparison, name, span),
        "wmae": weights["wmae"],
        "ver": vertex_error_ratio(source, recovered[span], original[span]),
        "correlation": weights["correlation"],
        "background": 1.0 - float(comparison.masks[span].mean()),
    }


def true_numbers(
    target: Rig,
    predicted: Tensor,
    truth: Tensor,
    shared: list[int],
    span: slice,
    clips: list[slice],
    contacts: dict[str, Tensor],
) -> dict[str, Any]:
    """The numbers against the truth: VER with its interval, the weights', and of lids and lips where they are known.

    Args:
        target: Whose weights.
        predicted: (T, K).
        truth: (T, K).
        shared: Shapes that the truth covers; only they count in the weights' numbers.
        span: Frames to count.
        clips: Spans of the clips, for what must not look across their borders.
        contacts: From `contacts_of`.
    """
    inside = [clip for clip in clips if span.start is None or clip == span]
    predicted_span, truth_span = predicted[span], truth[span]
    error, motion = vertex_errors(target, predicted_span, truth_span)
    numbers: dict[str, Any] = {
        "ver": vertex_error_ratio(target, predicted_span, truth_span),
        "ver_interval": list(ratio_interval(error, motion)),
        "ve_mm": 1000 * float(error.mean()),
        **weight_metrics(predicted_span[:, shared], truth_span[:, shared]),
        "jitter": float(np.mean([jitter(predicted[clip][:, shared], truth[clip][:, shared]) for clip in inside])),
    }
    lids = [lid_closure(target, predicted_span, truth_span, contacts[key]) for key in contacts if "lids" in key]
    if lids:
        numbers["lids"] = {key: float(np.mean([lid[key] for lid in lids])) for key in lids[0]}
    if lids and "lips" in contacts:
        height = _face_height(target, contacts)
        numbers["lips"] = lip_contact(target, predicted_span, truth_span, contacts["lips"], height)
    return numbers


def contacts_of(rig: Rig) -> dict[str, Tensor]:
    """Pairs of vertices (N, 2) that meet when `lips`, `lids_left` and `lids_right` close, those that are known.

    Of a built-in character they are marked on its mesh; of another rig they are what its shapes show, see
    `retargeting.landmarks`, and nothing where no shape opens a jaw or closes lids.
    """
    from reenact.retargeting.landmarks import Landmarks
    from reenact.rigs import anny  # reads its assets

    if rig.name in anny.BUILT_IN:
        return {key: torch.as_tensor(pairs) for key, pairs in anny.contacts(rig.name).items()}
    try:
        contacts = Landmarks.of(rig).contacts
    except ReenactError:  # no face moves
        return {}
    return {key: contact.pairs for key, contact in contacts.items()}


def _face_height(rig: Rig, contacts: dict[str, Tensor]) -> float:
    """Root of the nose to chin, metres: 1.8 times the height of the lids above the lips, as in an average adult."""
    lids = torch.cat([contacts[key] for key in contacts if "lids" in key]).flatten()
    height = rig.neutral[lids, 1].mean() - rig.neutral[contacts["lips"].flatten(), 1].mean()
    return 1.8 * float(height)


def _bpnet(forward: PictureRetargeter, frames: int, seed: int) -> dict[str, float]:
    target = forward.target
    clips = held_out_clips(target.names, frames, seed + 50)  # other clips than the source's
    weights = torch.cat([clip.weights for clip in clips.values()])
    comparison = _PictureComparison(forward.target_pictures, forward.target_masks, weights)
    read = torch.cat([forward.read(part).float().cpu() for part in comparison.pictures.split(_CHUNK)])
    comparison.against({"read": read, "neutral": torch.zeros_like(weights)})
    pictures = _picture_numbers(comparison, "read", slice(None))
    scores = weight_metrics(read, weights)
    return {
        "wmae": scores["wmae"],
        "ver": vertex_error_ratio(target, read, weights),
        "correlation": scores["correlation"],
        "psnr": pictures["psnr"],
        "ssim": pictures["ssim"],
        "mae": pictures["mae"],
        "skill": pictures["skill"],
    }


def speed(
    forward: PictureRetargeter, weights: Float[Tensor, "T Ks"], count: int = 100, warm_up: int = 10
) -> dict[str, float]:
    """Frames one at a time, rendering included: frames a second, milliseconds at the median and 99th percentile."""
    rows = weights[torch.linspace(0, len(weights) - 1, count + warm_up).long()]
    seconds = []
    for row in rows:
        start = time.perf_counter()
        forward.step(row)
        seconds.append(time.perf_counter() - start)
    milliseconds = 1000 * np.array(seconds[warm_up:])
    return {
        "fps": 1000 / max(float(milliseconds.mean()), 1e-9),
        "latency_ms_p50": float(np.quantile(milliseconds, 0.5)),
        "latency_ms_p99": float(np.quantile(milliseconds, 0.99)),
        "threads": torch.get_num_threads(),
    }


def _retarget(retargeter: Retargeter | PictureRetargeter, clips: dict[str, Clip]) -> Tensor:
    return torch.cat([retargeter(clip).weights.detach().float().cpu() for clip in clips.values()])


def _split(names: tuple[str, ...], weights: Tensor, kinds: dict[str, slice], fps: float) -> dict[str, Clip]:
    return {kind: Clip(names, weights[span], fps) for kind, span in kinds.items()}


def _span(clips: dict[str, Clip], kind: str) -> slice:
    lengths = [len(clip) for clip in clips.values()]
    i = list(clips).index(kind)
    return slice(sum(lengths[:i]), sum(lengths[: i + 1]))


def _spans(kinds: dict[str, slice]) -> list[tuple[str, slice]]:
    return [("all", slice(None)), *kinds.items()]


def _in_chunks(function: Callable[[Tensor], Tensor], values: Tensor) -> Tensor:
    return torch.cat([function(part).detach().float().cpu() for part in values.split(_CHUNK)])


def _once_each(render: Callable[[Tensor], Tensor], weights: Tensor) -> Tensor:
    """What `render` makes of each row, equal rows rendered once: a baseline that never moves costs one picture."""
    rows, which = weights.unique(dim=0, return_inverse=True)
    return render(rows).detach().float().cpu()[which]


def _runs(values: Tensor) -> list[tuple[int, int]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], values.cpu().numpy().astype(np.int8), [0]])))
    return [(int(start), int(stop)) for start, stop in zip(edges[::2], edges[1::2])]


def _ratio(numerator: float, denominator: float) -> float:
    if denominator > 0:
        return numerator / denominator
    return 0.0 if numerator == 0 else math.inf


def psnr_of(mean_squared_error: float) -> float:
    """dB of a mean squared error of values in [0, 1]; infinite for 0."""
    return math.inf if mean_squared_error <= 0 else -10 * math.log10(mean_squared_error)
