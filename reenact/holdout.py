"""Holdout: how wrongly networks move faces in expressions that no step of their training takes. Ours.

Losses cannot choose a checkpoint: terms of a training join late, count by factors, and are taken of expressions that
change. Here the expressions stay, and so does what is asked: how far the weights that are read move the vertices
wrongly, in units of the rig's own motion (`VertexDistance`: 0 is exact, 1 an error as large as the typical motion).

The number that checkpoints are compared by is the mean over directions, source to target, of that error for pictures of
the source, as `reenact infer` takes them: drawn as the target, read, clamped; against what the teacher says, which is
all that a training knows of the truth. It is therefore an error against labels. Own pictures, whose truth is exact, say
how well a BPNet reads and nothing of what is lost between two faces; they stand for a direction only where nobody tells
how others look on a rig.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from reenact.data import Studio
from reenact.losses import VertexDistance
from reenact.models import Networks
from reenact.pairs import LEAST_TRUST, Teacher

NUMBER, OWN = "held_out", "held_out_own"
"""Of `Holdout`: the number, and by rig as `held_out.KEY`; by rig from its own pictures as `held_out_own.KEY`."""

_COUNT = 256
"""Expressions of each rig at most."""
_CHUNK = 64
"""Expressions that are looked at at once."""
_APART = 0x68656C64
"""Follows stage and chapter of a seed, where those of a training end."""


@dataclass(frozen=True)
class _Direction:
    """Expressions of one rig and what another, or the same, should make of them."""

    source: str
    target: str
    seen: Tensor  # (N, ...), readable part of the source's pictures
    weights: Tensor  # (N, Kt)
    share: Tensor  # (N,), of each in the mean


class Holdout:
    """Expressions that are photographed once, to check networks with from time to time.

    Each is shown on one partner, so that a cast costs as much as a pair, a rig. They are random ones even where a
    training takes its expressions from a clip, for it takes all of that. Nothing random is drawn but from seeds of
    their own, and no network changes.
    """

    @torch.no_grad()
    def __init__(
        self,
        studios: Mapping[str, Studio],
        networks: Networks,
        teachers: Mapping[tuple[str, str], Teacher],
        distances: Mapping[str, VertexDistance],
        learning: Collection[str],
        seed: int,
        count: int = _COUNT,
    ):
        """
        Args:
            studios: Of the rigs that take part, by key.
            networks: Describe pictures as they will to the end of the training.
            teachers: By source and target.
            distances: By key.
            learning: Keys of the rigs whose reading is checked on their own pictures.
            seed: Of the training.
            count: Expressions that the training has in memory; as many are taken, up to 256.
        """
        self.distances, net, count = distances, networks.reenactnet, min(count, _COUNT)
        self.own: dict[str, _Direction] = {}
        self.directions: list[_Direction] = []
        for place, (key, studio) in enumerate(studios.items()):
            random = np.random.default_rng([seed, 0, 0, place, _APART])
            weights = studio.expressions(count, random)
            seen = torch.cat([net.readable(net.describe(key, studio.glance(chunk))) for chunk in weights.split(_CHUNK)])
            if key in learning:
                even = seen.new_full((count,), 1 / count)
                self.own[key] = _Direction(key, key, seen, weights.to(seen), even)
            targets = [target for source, target in teachers if source == key]
            for turn, target in enumerate(targets):
                rows = torch.arange(turn, count, len(targets))
                if not len(rows):
                    continue
                teacher, shown = teachers[key, target], weights[rows]
                told = teacher.weights(shown)
                trust = teacher.confidence(shown, told).clamp_min(LEAST_TRUST)
                share = (trust / trust.sum()).to(seen)
                self.directions.append(_Direction(key, target, seen[rows.to(seen.device)], told.to(seen), share))
        reached = {direction.target for direction in self.directions}
        self.directions += [own for key, own in self.own.items() if key not in reached]

    @torch.no_grad()
    def __call__(self, networks: Networks, read: Collection[str]) -> dict[str, float]:
        """Errors by name: `held_out_own.KEY`, `held_out.KEY`, and where all can be read their mean `held_out`.

        Args:
            networks: Left in the mode in which they came.
            read: Keys of the rigs whose BPNet has learnt.
        """
        training = networks.training
        networks.eval()
        try:
            found = {f"{OWN}.{key}": self._error(networks, own) for key, own in self.own.items() if key in read}
            errors = [(each.target, self._error(networks, each)) for each in self.directions if each.target in read]
        finally:
            networks.train(training)
        for key in dict.fromkeys(target for target, _ in errors):
            found[f"{NUMBER}.{key}"] = float(np.mean([error for target, error in errors if target == key]))
        if len(errors) == len(self.directions):
            found[NUMBER] = float(np.mean([error for _, error in errors]))
        return found

    def _error(self, networks: Networks, direction: _Direction) -> float:
        net, key, wrong = networks.reenactnet, direction.target, []
        for seen, weights in zip(direction.seen.split(_CHUNK), direction.weights.split(_CHUNK)):
            own = direction.source == key
            readable = seen if own else net.readable(net(seen, direction.source, key))
            wrong.append(self.distances[key](networks.bpnets[key](readable).clamp(0, 1), weights))
        return float(torch.cat(wrong) @ direction.share)
