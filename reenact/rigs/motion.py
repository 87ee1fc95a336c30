"""Facial motion made by formula: random expressions, speech, emotions, blinks, ramps.

All of it is ours, made to look like what faces do, not measured from any; only the gaps, rates and durations follow
what is known of people: blinks last about 150 ms and come every three seconds or so, neighbouring speech sounds overlap
by about 100 ms, eyes jump between targets and move together.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float
from numpy.random import Generator
from scipy.special import betaincinv, ndtr
from torch import Tensor

from reenact.errors import ReenactError
from reenact.rigs import arkit
from reenact.rigs.clip import Clip

KINDS = ("mixed", "speech", "emotion", "expressions", "blinks", "ramps")
"""What `synthesize` can make."""

BOTH = 0.1
"""Two shapes that exclude each other keep the product of their weights below this."""
_TONGUE = 0.15
"""Chance of a tongue to be out in crowded expressions, beside that of another shape to be active."""


def expressions(
    names: Sequence[str], count: int, seed: int | Generator, crowded: float = 0.0, uneven: float = 0.0
) -> Float[Tensor, "{count} K"]:
    """Random valid expressions: weights in [0, 1], most of them 0.

    An expression has 1 + Poisson(2) active units, a unit being a shape or a left/right pair; amplitudes are
    Beta(1.2, 1.2). Thirty in a hundred pairs move on one side only and the others nearly alike, so that over many
    expressions left and right correlate by 0.8. Both eyes always look the same way. Where the names are ARKit's
    (`arkit.canonical`), blinks are twice as likely as other units, shapes that cannot go together have a product below
    0.1 (smile and frown, jaw left and right, looking up and down), and mouthClose never exceeds jawOpen. Of other names
    only left/right pairs are recognised.

    Args:
        names: Shapes to sample, K of them.
        count: Expressions.
        seed: A seed, or a generator that is advanced.
        crowded: Share of expressions in which any number of units are active, up to all of them, at a common strength
            from 0.2 to 1 of the usual. Recorded faces are like that: they move nearly every shape a little, but for
            the tongue, which stays in while it can.
        uneven: Share of those in which units also differ in strength: most move hardly, a few as far as they can.
    """
    table = _table(tuple(names))
    rng = np.random.default_rng(seed)
    groups = len(table.first)
    # The smallest of exponential waiting times are a weighted draw without replacement.
    waits = rng.standard_exponential((count, groups), dtype=np.float32) / table.frequency
    active = np.minimum(1 + rng.poisson(2.0, count), groups)
    strength = np.ones((count, 1))
    if crowded:
        full = rng.random(count) < crowded
        waits[full] /= table.eagerness
        active[full] = rng.integers(1, groups, count, endpoint=True)[full]
        strength[full] = rng.uniform(0.2, 1.0, (count, 1))[full]
    if crowded and uneven:
        chosen = rng.random((count, 1)) < uneven
        factor = 3 * rng.random((count, groups)) ** 2  # 1 in the mean
        strength = np.where(full[:, None] & chosen, factor * strength, strength)
    last = np.take_along_axis(np.sort(waits, axis=1), active[:, None] - 1, axis=1)  # (N, 1)
    amplitude_normal = rng.standard_normal((2, count, groups), dtype=np.float32)
    amplitude_normal[1] = 0.91 * amplitude_normal[0] + 0.4146 * amplitude_normal[1]  # correlation 0.91, variance 1
    amplitudes = np.interp(ndtr(amplitude_normal), _QUANTILES, _BETA)
    amplitudes = np.minimum(amplitudes * (waits <= last) * strength, 1)
    alone = rng.random((count, groups), dtype=np.float32)
    alone[:, table.together] = 1
    amplitudes[0] *= ~((alone >= 0.15) & (alone < 0.3))
    amplitudes[1] *= ~(alone < 0.15)
    weights = np.zeros((count, len(table.names)))
    weights[:, table.first] = amplitudes[0]
    weights[:, table.second[table.paired]] = amplitudes[1][:, table.paired]
    for corrective, base in table.correctives:
        # Raising the base keeps the corrective as frequent as the others; lowering it would leave it at 0.
        weights[:, base] = np.maximum(weights[:, base], weights[:, corrective])
    return torch.from_numpy(_valid(weights, table).astype(np.float32))


def synthesize(names: Sequence[str], seconds: float, seed: int, fps: float = 30.0, kind: str = "mixed") -> Clip:
    """A clip of made-up motion, the same for the same arguments.

    | kind | motion |
    |---|---|
    | mixed | speech, emotions, blinks, brow beats, gaze jumps, and 1/f noise of 0.01 |
    | speech | words of random syllables from 15 mouth shapes, blended over 80 to 120 ms, with pauses |
    | emotion | joy, sadness, anger, fear, disgust, surprise in turn, at random strength |
    | expressions | `expressions` one after the other, through critically damped springs |
    | blinks | 0.3 a second, 150 ms each, both eyes |
    | ramps | one shape at a time, up to 1 and down (a corrective together with its base), in random order |

    Names that stand for ARKit shapes (`arkit.meaning`) get the motion of those shapes. Where less than half of the
    names do, only "expressions" and "ramps" keep their meaning, and every other kind is "expressions".

    Args:
        names: Shapes that the clip has, in its order.
        seconds: Length, at least one frame.
        seed: Seed of everything random.
        fps: Frames per second.
        kind: One of `KINDS`.

    Raises:
        ReenactError: Unknown kind, or a length or rate that is not positive.
    """
    if kind not in KINDS:
        nearest = difflib.get_close_matches(kind, KINDS, n=1)
        hint = f"did you mean {nearest[0]}?" if nearest else "see the list"
        raise ReenactError(f"synthetic clip: expected a kind among {', '.join(KINDS)}, got {kind}; {hint}")
    if not (np.isfinite(seconds) and np.isfinite(fps) and seconds > 0 and fps > 0):
        raise ReenactError(f"synthetic clip: expected a positive length and rate, got {seconds} s at {fps} fps")
    if seconds * fps > 1e6:
        raise ReenactError(f"synthetic clip: expected at most 1,000,000 frames, got {seconds} s at {fps} fps")
    table = _table(tuple(names))
    times = np.arange(max(1, round(seconds * fps))) / fps
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    understood = sum(bool(arkit.meaning(name)) for name in table.names)
    if kind == "ramps":
        weights = _ramps(table, len(times), rng)
    elif kind == "expressions" or 2 * understood < len(table.names):
        weights = _springs(table, times, rng)
    else:
        weights = _valid(_TRACKS[kind](times, rng) @ _spread(table.names), table)
    return Clip(table.names, torch.from_numpy(weights.clip(0, 1).astype(np.float32)), fps)


# Rules -----------------------------------------------------------------------------------------------------------


_OPPOSED: tuple[tuple[str, str], ...] = (
    *arkit.DIRECTIONS,
    *(
        (a + side, b + side)
        for side in ("Left", "Right")
        for a, b in (
            ("mouthSmile", "mouthFrown"),
            ("eyeBlink", "eyeWide"),
            ("eyeSquint", "eyeWide"),
            ("eyeLookUp", "eyeLookDown"),
            ("eyeLookIn", "eyeLookOut"),
            ("browDown", "browOuterUp"),
        )
    ),
    *(
        (a, b + side)
        for side in ("Left", "Right")
        for a, b in (
            ("mouthPucker", "mouthStretch"),
            ("mouthPucker", "mouthSmile"),
            ("mouthPucker", "mouthDimple"),
            ("mouthFunnel", "mouthStretch"),
            ("mouthFunnel", "mouthSmile"),
            ("mouthFunnel", "mouthPress"),
            ("mouthRollLower", "mouthLowerDown"),
            ("mouthRollUpper", "mouthUpperUp"),
            ("tongueOut", "mouthPress"),
        )
    ),
    ("mouthRollLower", "mouthShrugLower"),
    ("mouthRollUpper", "mouthShrugUpper"),
    ("mouthRollLower", "mouthFunnel"),
    ("mouthRollUpper", "mouthFunnel"),
    ("cheekPuff", "jawOpen"),
    ("cheekPuff", "tongueOut"),
    ("tongueOut", "mouthClose"),
    ("tongueOut", "mouthRollLower"),
    ("tongueOut", "mouthRollUpper"),
    # Eyes do not look past each other.
    ("eyeLookUpLeft", "eyeLookDownRight"),
    ("eyeLookDownLeft", "eyeLookUpRight"),
    ("eyeLookInLeft", "eyeLookInRight"),
    ("eyeLookOutLeft", "eyeLookOutRight"),
)


@dataclass(frozen=True)
class _Table:
    """What the names of a rig say, as indices."""

    names: tuple[str, ...]
    first: np.ndarray  # (G,) a shape of each unit
    second: np.ndarray  # (G,) its other side, where `paired`
    paired: np.ndarray  # (G,) bool
    together: np.ndarray  # (G,) bool: no sides, or never on one side only
    frequency: np.ndarray  # (G,) relative chance of being active
    eagerness: np.ndarray  # (G,) factor of it in crowded expressions
    opposed: np.ndarray  # (E, 2)
    correctives: tuple[tuple[int, int], ...]


@lru_cache(maxsize=64)
def _table(names: tuple[str, ...]) -> _Table:
    if not names or len(set(names)) != len(names):
        raise ReenactError(f"expected at least one blendshape name, all different, got {len(names)}")
    known: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        for part in arkit.meaning(name):
            known.setdefault(part, []).append(index)
    partner: dict[int, int] = {}
    yoked = {"eyeLookInLeft": "eyeLookOutRight", "eyeLookOutLeft": "eyeLookInRight"}
    for left, right in yoked.items():
        if len(known.get(left, ())) == len(known.get(right, ())) == 1 and known[left] != known[right]:
            partner[known[left][0]] = known[right][0]
    # Sides in these names are directions, or belong to the partner just found.
    apart = {name for pair in arkit.DIRECTIONS for name in pair} | set(yoked) | set(yoked.values())
    left_of = {}
    for index, name in enumerate(names):
        base, side = arkit.sides(name)
        if side == "left" and not apart.intersection(arkit.meaning(name)):
            left_of[base] = index
    for index, name in enumerate(names):
        base, side = arkit.sides(name)
        if side == "right" and base in left_of and index not in partner.values():
            partner.setdefault(left_of[base], index)
    taken = set(partner.values())
    first = [index for index in range(len(names)) if index not in taken]
    canon = [arkit.meaning(names[index])[:1] for index in first]
    pairs = {
        (min(i, j), max(i, j))
        for a, b in _OPPOSED
        for i in known.get(a, ())
        for j in known.get(b, ())
        if i != j  # a merged shape may stand for both
    }
    return _Table(
        names,
        first=np.array(first),
        second=np.array([partner.get(index, 0) for index in first]),
        paired=np.array([index in partner for index in first]),
        together=np.array(
            [
                index not in partner or (bool(name) and name[0].startswith("eyeLook"))
                for index, name in zip(first, canon)
            ]
        ),
        frequency=np.array([2.0 if name and name[0].startswith("eyeBlink") else 1.0 for name in canon], np.float32),
        eagerness=np.array([_TONGUE if name and name[0] == "tongueOut" else 1.0 for name in canon], np.float32),
        opposed=np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2),
        correctives=tuple(
            (i, j)
            for corrective, base in arkit.CORRECTIVES.items()
            for i in known.get(corrective, ())
            for j in known.get(base, ())
        ),
    )


def _valid(weights: np.ndarray, table: _Table) -> np.ndarray:
    """Weights (N, K) that keep the rules of `expressions`; changes with its input without jumps."""
    weights = weights.clip(0, 1)
    if len(table.opposed):
        a, b = table.opposed.T
        product = weights[:, a] * weights[:, b]  # (N, E)
        scale = np.sqrt(0.999 * BOTH / np.maximum(product, 0.999 * BOTH))
        rows, rules = np.nonzero(scale < 1)
        factor = np.ones_like(weights)
        for ends in (a, b):
            np.minimum.at(factor, (rows, ends[rules]), scale[rows, rules])
        weights = weights * factor
    for corrective, base in table.correctives:
        weights[:, corrective] = np.minimum(weights[:, corrective], weights[:, base])
    return weights


_QUANTILES = np.linspace(0, 1, 1025)
_BETA = betaincinv(1.2, 1.2, _QUANTILES)


# Tracks over time, (T, 52) in the order of arkit.NAMES ----------------------------------------------------------------


def _shapes(text: str) -> np.ndarray:
    """Weights (52,) from "jawOpen .3, mouthSmile .5", where a pair's base sets both sides."""
    weights = np.zeros(len(arkit.NAMES))
    for entry in filter(None, text.split(",")):
        name, value = entry.split()
        for part in arkit.meaning(name):
            weights[arkit.NAMES.index(part)] = float(value)
    return weights


# The mouth at the middle of a sound, in speech of ordinary clarity.
_VISEMES = {
    "sil": _shapes(""),
    "PP": _shapes("mouthPress .45, mouthRollLower .3, mouthRollUpper .25, jawOpen .04, mouthClose .04"),
    "FF": _shapes("mouthRollLower .55, mouthUpperUp .22, jawOpen .06, mouthDimple .08"),
    "TH": _shapes("jawOpen .16, mouthLowerDown .2, mouthUpperUp .1, tongueOut .22"),
    "DD": _shapes("jawOpen .14, mouthLowerDown .26, mouthUpperUp .1, mouthStretch .12"),
    "kk": _shapes("jawOpen .22, mouthLowerDown .16, mouthUpperUp .12, mouthStretch .06"),
    "CH": _shapes("mouthFunnel .5, mouthPucker .22, jawOpen .1, mouthShrugUpper .15"),
    "SS": _shapes("jawOpen .05, mouthStretch .28, mouthDimple .14, mouthLowerDown .24, mouthUpperUp .08"),
    "nn": _shapes("jawOpen .13, mouthLowerDown .2, mouthUpperUp .06, mouthStretch .08"),
    "RR": _shapes("mouthFunnel .34, mouthPucker .26, jawOpen .13"),
    "aa": _shapes("jawOpen .62, mouthLowerDown .3, mouthUpperUp .2, mouthStretch .08"),
    "E": _shapes("jawOpen .36, mouthLowerDown .28, mouthUpperUp .18, mouthStretch .25, mouthDimple .1"),
    "ih": _shapes("jawOpen .2, mouthSmile .22, mouthStretch .28, mouthLowerDown .24, mouthUpperUp .12"),
    "oh": _shapes("jawOpen .42, mouthFunnel .5, mouthPucker .2, mouthLowerDown .06"),
    "ou": _shapes("jawOpen .18, mouthPucker .68, mouthFunnel .3"),
}
_VOWELS = ("aa", "E", "ih", "oh", "ou")
_CONSONANTS = ("PP", "FF", "TH", "DD", "kk", "CH", "SS", "nn", "RR")

_EMOTIONS = {
    "joy": _shapes("mouthSmile .9, cheekSquint .6, eyeSquint .35, mouthDimple .2, mouthUpperUp .15, jawOpen .1"),
    "sadness": _shapes(
        "browInnerUp .8, mouthFrown .7, browDown .2, mouthShrugLower .35, eyeSquint .2, eyeLookDown .25"
    ),
    "anger": _shapes("browDown .9, eyeSquint .4, noseSneer .4, mouthPress .5, mouthFrown .25, jawForward .2"),
    "fear": _shapes("browInnerUp .7, browOuterUp .35, eyeWide .8, mouthStretch .6, jawOpen .25"),
    "disgust": _shapes("noseSneer .9, mouthUpperUp .55, browDown .5, cheekSquint .35, mouthFrown .3, eyeSquint .3"),
    "surprise": _shapes("browInnerUp .8, browOuterUp .85, eyeWide .75, jawOpen .5, mouthFunnel .15"),
}


def _blend(times: np.ndarray, starts: np.ndarray, widths: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Track (T, K) that goes to values[i] around starts[i], by half a cosine of that width; 0 before."""
    if len(starts) == 0:  # a clip that ends before anything begins
        return np.zeros((len(times), len(arkit.NAMES)))
    phase = ((times[:, None] - starts) / widths + 0.5).clip(0, 1)  # (T, E)
    arrived = 0.5 - 0.5 * np.cos(np.pi * phase)
    arrived = np.minimum.accumulate(arrived, axis=1)  # a wide blend is not overtaken by the next one
    left = np.concatenate([arrived[:, 1:], np.zeros((len(times), 1))], axis=1)
    return (arrived - left) @ values


def _speech(times: np.ndarray, rng: Generator) -> np.ndarray:
    starts, values = [], []
    now = float(rng.uniform(0.1, 0.4))
    while now < times[-1] + 0.2:
        for _ in range(int(rng.integers(2, 9))):  # syllables of a phrase
            effort = rng.uniform(0.7, 1.25)
            for sounds, low, high in ((_CONSONANTS, 0.07, 0.12), (_VOWELS, 0.1, 0.22)):
                starts.append(now)
                values.append(effort * _VISEMES[sounds[int(rng.integers(len(sounds)))]])
                now += float(rng.uniform(low, high))
        starts.append(now)
        values.append(_VISEMES["sil"])
        now += float(rng.uniform(0.15, 0.8))
    widths = rng.uniform(0.08, 0.12, len(starts))
    return _blend(times, np.array(starts), widths, np.array(values)).clip(0, 1)


def _emotion(times: np.ndarray, rng: Generator) -> np.ndarray:
    starts, values = [], []
    now = float(rng.uniform(0.1, 0.5))
    prototypes = list(_EMOTIONS.values())
    while now < times[-1] + 0.5:
        for index in rng.permutation(len(prototypes)):
            starts += [now, now + float(rng.uniform(1.0, 2.2))]
            values += [rng.uniform(0.35, 1.0) * prototypes[index], _VISEMES["sil"]]
            now = starts[-1] + float(rng.uniform(0.5, 1.0))
    widths = rng.uniform(0.3, 0.6, len(starts))
    return _blend(times, np.array(starts), widths, np.array(values))


def _blinks(times: np.ndarray, rng: Generator) -> np.ndarray:
    gap = 0.25  # seconds from one blink to the earliest next
    waits = gap + rng.exponential(1 / 0.3 - gap, 2 + int(times[-1]))
    middles = np.cumsum(waits)
    away = np.abs(times[:, None] - middles[middles < times[-1] + gap]).min(1, initial=np.inf)
    # 150 ms of which 35 are closed, so that at 30 fps a frame falls into each.
    closed = 0.5 + 0.5 * np.cos(np.pi * ((away - 0.0175) / 0.0575).clip(0, 1))
    return closed[:, None] * _shapes("eyeBlink 1, cheekSquint .06")


def _gaze(times: np.ndarray, rng: Generator) -> np.ndarray:
    waits = rng.uniform(0.4, 2.2, 2 + int(times[-1] / 0.4))
    starts = np.cumsum(waits)
    across = rng.normal(0, 0.28, len(starts)).clip(-0.9, 0.9)  # towards the person's left
    up = rng.normal(-0.05, 0.2, len(starts)).clip(-0.8, 0.8)
    ahead = rng.random(len(starts)) < 0.4
    across[ahead], up[ahead] = 0, 0
    directions = {
        ("eyeLookOutLeft", "eyeLookInRight"): across,
        ("eyeLookInLeft", "eyeLookOutRight"): -across,
        ("eyeLookUpLeft", "eyeLookUpRight"): up,
        ("eyeLookDownLeft", "eyeLookDownRight"): -up,
    }
    values = np.zeros((len(starts), len(arkit.NAMES)))
    for names, amount in directions.items():
        for name in names:
            values[:, arkit.NAMES.index(name)] = amount.clip(0)
    return _blend(times, starts, np.full(len(starts), 0.05), values)


def _brow_beats(times: np.ndarray, rng: Generator) -> np.ndarray:
    kinds = (_shapes("browInnerUp .5, browOuterUp .5"), _shapes("browDown .45"), _shapes("browInnerUp .4"))
    starts, values = [], []
    now = float(rng.uniform(0.2, 1.5))
    while now < times[-1] + 0.5:
        starts += [now, now + float(rng.uniform(0.2, 0.5))]
        values += [rng.uniform(0.4, 1.2) * kinds[int(rng.integers(len(kinds)))], _VISEMES["sil"]]
        now = starts[-1] + float(rng.exponential(1.3)) + 0.3
    return _blend(times, np.array(starts), np.full(len(starts), 0.18), np.array(values))


def _noise(frames: int, columns: int, rng: Generator) -> np.ndarray:
    """Noise (frames, columns) of standard deviation 0.01 whose power falls as 1/f."""
    if frames < 4:
        return np.zeros((frames, columns))
    amplitude = 1 / np.sqrt(np.maximum(np.arange(frames // 2 + 1), 1))
    amplitude[0] = 0
    phases = np.exp(2j * np.pi * rng.random((len(amplitude), columns)))
    wave = np.fft.irfft(amplitude[:, None] * phases, n=frames, axis=0)
    return 0.01 * wave / wave.std(0)


def _mixed(times: np.ndarray, rng: Generator) -> np.ndarray:
    talking = _speech(times, rng)
    # Emotion leaves the mouth to speech while there is speech.
    share = np.where([name.startswith(("mouth", "jaw")) for name in arkit.NAMES], 0.55, 0.8)
    weights = talking + share * _emotion(times, rng) + _brow_beats(times, rng) + _gaze(times, rng)
    blinks = _blinks(times, rng)
    lids = blinks.max(1, keepdims=True)
    wide = np.array([name.startswith(("eyeWide", "eyeSquint")) for name in arkit.NAMES])
    weights = weights * np.where(wide, 1 - lids, 1)  # a blink closes the eye whatever it was doing
    return np.maximum(weights, blinks) + _noise(len(times), weights.shape[1], rng)


_TRACKS = {"mixed": _mixed, "speech": _speech, "emotion": _emotion, "blinks": _blinks}


def _spread(names: tuple[str, ...]) -> np.ndarray:
    """Matrix (52, K) from ARKit weights to those of the names: the mean of the shapes that each name stands for."""
    matrix = np.zeros((len(arkit.NAMES), len(names)))
    for column, name in enumerate(names):
        parts = arkit.meaning(name)
        for part in parts:
            matrix[arkit.NAMES.index(part), column] = 1 / len(parts)
    return matrix


# Tracks of any names, (T, K) ------------------------------------------------------------------------------------------


def _springs(table: _Table, times: np.ndarray, rng: Generator) -> np.ndarray:
    """Random expressions held for 0.3 to 0.9 s, followed by critically damped springs.

    The impulse response of such a spring is never negative and sums to 1: what it makes is a weighted mean of the
    expressions, so it stays in [0, 1] and keeps every linear rule; products of opposed shapes may rise in passing.
    """
    count = 1 + int(times[-1] / 0.3)
    targets = expressions(table.names, count, rng).numpy().astype(np.float64)
    current = np.searchsorted(np.cumsum(rng.uniform(0.3, 0.9, count)), times).clip(0, count - 1)  # (T,)
    stiffness = 14.0  # radians per second: 90 % of the way in 0.28 s
    step = times[1] - times[0] if len(times) > 1 else 0.0
    decay = np.exp(-stiffness * step)
    position, velocity = np.zeros((2, len(table.names)))
    weights = np.empty((len(times), len(table.names)))
    for frame, target in enumerate(targets[current]):
        offset = position - target
        drift = velocity + stiffness * offset
        position = target + (offset + drift * step) * decay
        velocity = (velocity - stiffness * drift * step) * decay
        weights[frame] = position
    return weights


def _ramps(table: _Table, frames: int, rng: Generator) -> np.ndarray:
    length = max(3, frames // len(table.names))
    length -= 1 - length % 2  # odd, so that a frame lies on the peak
    middle = (length - 1) / 2
    ramp = 1 - np.abs(np.arange(length) - middle) / (middle + 1)
    weights = np.zeros((frames, len(table.names)))
    for place, shape in enumerate(rng.permutation(len(table.names))[: max(1, frames // length)]):
        rows = weights[place * length : (place + 1) * length]
        rows[:, shape] = ramp[: len(rows)]
        for corrective, base in table.correctives:
            if shape == corrective:
                rows[:, base] = ramp[: len(rows)]
    return weights
