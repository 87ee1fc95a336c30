"""How good a trained run is, in numbers that are hard to fool.

`evaluate` puts the numbers of `reenact.metrics` side by side with the trivial baselines that expose their traps: a face
that never moves, one that always holds the average pose, and the right expressions at the wrong time. What is right
comes from `reenact.truth`.

Kim et al. 2021, "Deep Learning-Based Unsupervised Human Facial Retargeting", doi:10.1111/cgf.14400, for the cyclic
protocol.
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
from jaxtyping import Float
from torch import Tensor

from reenact.atomic import write_atomically
from reenact.errors import ReenactError
from reenact.metrics import (
    error_map,
    image_mae,
    image_ssim,
    jitter,
    lid_closure,
    lip_contact,
    masked_mae,
    per_shape,
    psnr_of,
    ratio_interval,
    skill,
    vertex_error_ratio,
    vertex_errors,
    weight_metrics,
)
from reenact.retargeting.correspondence import Correspondence, find_correspondence
from reenact.retargeting.retargeter import Retargeter
from reenact.rigs import motion
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig
from reenact.truth import true_return, true_weights

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
        - `exact`: the truth itself, and what comes back of it (`true_return`): what the target cannot show is lost to
          any method, so `cyclic` is to be read beside this one's. None where the truth is.
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
    known, truth, covered = true_weights(source, target, weights)

    say("comparing pictures of the cycle")
    returned = {
        "reenact": recovered,
        "direct": direct_back,
        "neutral": torch.zeros_like(weights),
        "mean_pose": weights.mean(0).expand_as(weights),
    }
    if paired is not None:
        returned["paired"] = reverse.paired(paired)
    if covered:
        returned["exact"] = true_return(source, target, truth)
    cycle.against(returned).against_pictures("shuffled", cycle.pictures[order])
    returned["shuffled"] = weights[order]
    cyclic = {
        name: {kind: _cyclic(source, cycle, name, weights, returned[name], span) for kind, span in _spans(kinds)}
        for name in returned
    }

    say("comparing methods")
    moved = {f"method {name}": _retarget(method, clips) for name, method in (methods or {}).items()}
    say("comparing with the truth")
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
            "exact": truth,
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
        "exact": summary("exact", "all") if covered else None,
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
