"""Stages: what is learnt together, from which pictures, by which losses.

Kim et al. 2021 (KI21), "Deep Learning-Based Unsupervised Human Facial Retargeting", doi:10.1111/cgf.14400,
sections 3.2 and 3.3. The published training goes through stages: ReenactNet first, then one BPNet per rig. Ours is one
stage in which both learn together: each BPNet reads what ReenactNet draws, and its errors tell ReenactNet what matters
in a picture. A stage renders some thousand expressions of each rig at a time, describes them once (`reenact.models`),
and takes its batches from there until it renders others.

A cast is trained as a pair is. Each expression is shown on a few partners only (`pairs.shown`), so that from some rigs
on the next costs as much as the last.

Paper     Here
L_recon   reconstruction.KEY, in `_joint_losses` and `_reenactnet_losses`
L_w       `weight_distance`, in `_weight_losses`
L_r       `_image_loss`
L_b       weights and image, in `_joint_losses` and `_bpnet_losses`
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from reenact.config import Config
from reenact.data import Studio, jitter
from reenact.losses import VertexDistance, code_distance, weight_distance
from reenact.models import Networks
from reenact.pairs import LEAST_TRUST, Teacher
from reenact.team import Team

CHUNK = 64
"""Expressions that are photographed at once; part of what makes a run repeatable."""
_NEAR = 64
"""Expressions near each corrected one, of a quarter of all at most."""


@dataclass(frozen=True)
class Stage:
    """One network's share of the training."""

    name: str
    """`networks`; or `reenactnet`, then `bpnet.KEY`."""
    trained: list[Tensor]
    """What learns."""
    steps: int
    learning_rate: float
    render: Callable[[list[int]], dict[str, Pool]]
    """Fresh expressions of the rigs that take part; the numbers seed them."""
    draw: Callable[[dict[str, Pool], torch.Generator], dict[str, Tensor]]
    """Rows of the pools that make the batch of all processes."""
    losses: Callable[[dict[str, Pool], dict[str, Tensor], float], dict[str, Tensor]]
    """Terms whose sum is minimised, this process's part of them, on those rows; the share of the steps that are
    done."""


@dataclass(frozen=True)
class Pool:
    """Expressions of one rig, rendered and described."""

    weights: Tensor  # (N, K)
    described: Tensor  # (N, ...), what decoders should draw
    seen: Tensor  # (N, ...), what the encoder is given: the readable part, jittered
    turn: Tensor  # (N,), place among the rig's partners of the first that each expression is shown on
    partners: dict[str, Partners] = field(default_factory=dict)
    """By key of another rig: how the expressions look there that are shown there."""

    def shown_on(self, other: str, rows: Tensor, mine: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The expressions of a batch that are shown on another rig.

        Args:
            other: Key of the rig.
            rows: Of this pool, the whole batch.
            mine: Places in the batch that are this process's.

        Returns:
            Places among `mine`, rows of `partners[other]`, and the share of each in a mean over the batch, by
            confidence among those of one rig.
        """
        partners = self.partners[other]
        index = partners.index[rows]
        trust = torch.where(index >= 0, partners.confidence[index.clamp_min(0)], 0.0)
        share = trust / trust.sum().clamp_min(1e-12) * (index >= 0).float().mean()
        chosen = (index[mine] >= 0).nonzero().flatten()
        return chosen, index[mine][chosen], share[mine][chosen]


@dataclass(frozen=True)
class Partners:
    """What another rig makes of some expressions of a pool, M of them."""

    index: Tensor  # (N,), row below of each expression of the pool; -1 where it is shown on others
    weights: Tensor  # (M, K)
    described: Tensor | None  # (M, ...), where they are pictured
    confidence: Tensor  # (M,)


@dataclass(frozen=True)
class Workshop:
    """All that the stages work with."""

    config: Config
    studios: dict[str, Studio]
    networks: Networks
    learning: list[str]
    """Keys of the rigs that learn: all, or those that are added to a run."""
    partners: dict[str, list[str]]
    """By key: the rigs that one is compared with."""
    teachers: dict[tuple[str, str], Teacher]
    """By (source, target); empty where the settings ask for none."""
    vertex_distances: dict[str, VertexDistance]
    team: Team


def find_stages(shop: Workshop) -> list[Stage]:
    training, bpnet, keys = shop.config.training, shop.config.bpnet, list(shop.studios)
    networks = shop.networks
    trained = list(networks.parameters())
    if shop.learning != list(shop.partners):
        networks.requires_grad_(False)
        trained = [each.requires_grad_() for key in shop.learning for each in networks.own(key)]

    def render_all(seed: list[int]) -> dict[str, Pool]:
        return {key: _render(shop, key, seed, shop.partners[key], _count(shop, key, training.frames)) for key in keys}

    def draw_all(pools: dict[str, Pool], random: torch.Generator) -> dict[str, Tensor]:
        return {
            key: torch.randint(len(pool.weights), (_count(shop, key, training.batch_size),), generator=random)
            for key, pool in pools.items()
        }

    steps = planned_steps(shop.config, keys)
    if training.together:
        return [
            Stage(
                "networks",
                trained,
                steps["networks"],
                training.learning_rate,
                render_all,
                draw_all,
                lambda pools, rows, done: _joint_losses(shop, pools, rows, done),
            )
        ]
    stages = [
        Stage(
            "reenactnet",
            list(networks.reenactnet.parameters()),
            steps["reenactnet"],
            training.learning_rate,
            render_all,
            draw_all,
            lambda pools, rows, _done: _reenactnet_losses(shop, pools, rows),
        )
    ]
    for key in keys:
        others = [source for source, target in shop.teachers if target == key]
        stages.append(
            Stage(
                f"bpnet.{key}",
                list(networks.bpnets[key].parameters()),
                steps[f"bpnet.{key}"],
                bpnet.learning_rate,
                lambda seed, key=key, others=others: {
                    key: _render(shop, key, seed, [], training.frames),
                    **{
                        other: _render(shop, other, seed, [key], -(-training.frames // len(others)), pictured=False)
                        for other in others
                    },
                },
                lambda pools, random, key=key: _draw_for_bpnet(shop, key, pools, random),
                lambda pools, rows, done, key=key: _bpnet_losses(shop, key, pools, rows, done),
            )
        )
    return stages


def _count(shop: Workshop, key: str, count: int) -> int:
    """How many of so many expressions are a rig's: all, or a part where rigs that are trained already share them."""
    if key in shop.learning:
        return count
    return -(-count // (len(shop.studios) - len(shop.learning)))


@torch.no_grad()
def _render(shop: Workshop, key: str, seed: list[int], partners: list[str], count: int, pictured: bool = True) -> Pool:
    """Fresh expressions of a rig, and how each looks on one of its partners; `pictured` draws it there too."""
    place = list(shop.studios).index(key)
    elastic = shop.config.training.elastic
    weights = shop.studios[key].draw(count, np.random.default_rng([*seed, place]))
    weights = _corrected_first(shop, key, weights, seed)
    chunks, net = weights.split(CHUNK), shop.networks.reenactnet

    def describe(_number: int, chunk: Tensor) -> Tensor:
        return net.describe(key, shop.studios[key].show(shop.studios[key].photograph(chunk)))

    def look(number: int, chunk: Tensor) -> Tensor:
        """Both what `describe` says and what the encoder is given instead, side by side."""
        shown = shop.studios[key].show(shop.studios[key].photograph(chunk))
        bent = jitter(shown, elastic, torch_random([*seed, place, 2, number]))
        return torch.cat([net.describe(key, shown), net.readable(net.describe(key, bent))], dim=1)

    if elastic:
        both = shop.team.map(look, chunks)
        bent = net.readable(both).shape[1]
        described, seen = both[:, :-bent], both[:, -bent:]
    else:
        described = shop.team.map(describe, chunks)
        seen = net.readable(described)
    turn = torch.randperm(count, generator=torch_random([*seed, place, 3])) % max(1, len(partners))
    found = {}
    for number, other in enumerate(partners):
        if (key, other) in shop.teachers:
            chosen = (number - turn) % len(partners) < shop.config.pairs.shown
            found[other] = _shown_on(shop, (key, other), weights, chosen, pictured)
    return Pool(weights.to(described), described, seen, turn, found)


def _shown_on(shop: Workshop, pair: tuple[str, str], weights: Tensor, chosen: Tensor, pictured: bool) -> Partners:
    """How those of the expressions look on another rig that are chosen."""
    teacher, other = shop.teachers[pair], pair[1]
    studio, net = shop.studios[other], shop.networks.reenactnet
    index = torch.where(chosen, chosen.cumsum(0) - 1, -1)
    weights = weights[chosen]
    theirs = teacher.weights(weights)
    trust = teacher.confidence(weights, theirs).clamp_min(LEAST_TRUST)
    described = None
    if pictured:
        described = shop.team.map(
            lambda _, chunk: net.describe(other, studio.show(studio.photograph(chunk))), theirs.split(CHUNK)
        )
    return Partners(index, theirs.to(studio.device), described, trust)


def _corrected_first(shop: Workshop, key: str, weights: Tensor, seed: list[int]) -> Tensor:
    """Expressions of which the first are drawn towards corrected ones: half to all of the way, `_NEAR` per correction.

    Random ones would hardly ever come near. Ours.
    """
    teachers = [teacher for (source, _), teacher in shop.teachers.items() if source == key]
    corrected = [teacher.corrections.source_weights for teacher in teachers if teacher.corrections is not None]
    if not corrected:
        return weights
    random = torch_random([*seed, list(shop.studios).index(key), 1])
    centres = torch.cat(corrected).repeat(_NEAR, 1)[: len(weights) // 4]
    share = 0.5 + 0.5 * torch.rand(len(centres), 1, generator=random)
    return torch.cat([torch.lerp(weights[: len(centres)], centres, share), weights[len(centres) :]])


def _draw_for_bpnet(shop: Workshop, key: str, pools: dict[str, Pool], random: torch.Generator) -> dict[str, Tensor]:
    """Rows of the rig's own pool; and of the others', whose pictures take the place of the first, by confidence."""
    bpnet = shop.config.bpnet
    rows = {key: torch.randint(len(pools[key].weights), (bpnet.batch_size,), generator=random)}
    sources = [other for other in pools if key in pools[other].partners]
    count = round(bpnet.decoded_fraction * bpnet.batch_size)
    for source, part in zip(sources, torch.arange(count).tensor_split(max(1, len(sources)))):
        if len(part):
            confidence = pools[source].partners[key].confidence
            rows[source] = torch.multinomial(confidence, len(part), replacement=True, generator=random)
    return rows


def _joint_losses(shop: Workshop, pools: dict[str, Pool], batch: dict[str, Tensor], done: float) -> dict[str, Tensor]:
    """Each rig redraws itself and is read back, and the others where a teacher tells how. Ours, after KI21.

    L_recon and L_b of KI21, with one more term: the weights that BPNet reads from what ReenactNet draws of another
    rig's pictures, whose error reaches both. Without a teacher BPNet reads what is drawn of the rig itself. A rig that
    is trained already only shows its expressions, on those that learn.
    """
    training, bpnet, networks, losses = shop.config.training, shop.config.bpnet, shop.networks, {}
    net, codes, zero = networks.reenactnet, {}, next(iter(pools.values())).described.new_zeros(())
    rendered = done >= bpnet.image_from  # these terms cost more than all the rest

    def add(name: str, value: Tensor) -> None:
        losses[name] = losses.get(name, 0) + value

    for key, pool in pools.items():
        mine = shop.team.share(len(batch[key]))
        rows, size = batch[key][mine], len(batch[key])
        code, described = net.code(pool.seen[rows], key), pool.described[rows]
        features = net.unfold(code)
        codes[key] = code
        for other, partners in pool.partners.items():
            add(f"pairs.{other}", zero)
            add(f"read.{other}", zero)
            chosen, index, share = pool.shown_on(other, batch[key], mine)
            if not len(chosen):
                continue
            share = share.to(zero) * (_count(shop, key, training.batch_size) / training.batch_size)
            theirs = net.decoders[other](features[chosen])
            distances = net.distances(other, theirs, partners.described[index])
            add(f"pairs.{other}", training.pair_loss * (distances @ share))
            read = networks.bpnets[other](net.readable(theirs))
            errors = _weight_losses(shop, other, read, partners.weights[index])
            add(f"read.{other}", training.read_loss * (errors @ share))
        if key not in shop.learning:
            continue
        drawn = net.decoders[key](features)
        add(f"reconstruction.{key}", net.distances(key, drawn, described).sum() / size)
        predicted = networks.bpnets[key](net.readable(described))
        add(f"weights.{key}", _weight_losses(shop, key, predicted, pool.weights[rows]).sum() / size)
        if not pool.partners and training.read_loss:
            read = networks.bpnets[key](net.readable(drawn))
            add(f"read.{key}", training.read_loss * _weight_losses(shop, key, read, pool.weights[rows]).sum() / size)
        few = max(1, round(bpnet.image_fraction * size))
        some = (mine < few).nonzero().flatten()
        if bpnet.image_loss and rendered:
            errors = _image_loss(shop, key, predicted[some], described[some])
            add(f"image.{key}", bpnet.image_loss * errors.sum() / few)
        if training.cycle_loss and rendered:
            misses = _cycle_loss(shop, key, features[some], described[some], pool.turn[rows[some]])
            add(f"cycle.{key}", training.cycle_loss * misses.sum() / few)
    if training.align_loss:
        first, *others = codes.values()
        add("align", training.align_loss * torch.stack([code_distance(first, other) for other in others]).mean())
    return losses


def _weight_losses(shop: Workshop, key: str, predicted: Tensor, weights: Tensor) -> Tensor:
    """(N,), how wrong predicted weights are: L_w of KI21, and by how far they move the vertices (ours)."""
    bpnet, moved = shop.config.bpnet, shop.vertex_distances[key](predicted, weights)
    return bpnet.weight_loss * weight_distance(predicted, weights) + bpnet.vertex_loss * moved


def _image_loss(shop: Workshop, key: str, predicted: Tensor, described: Tensor) -> Tensor:
    """(N,), L_r of KI21: how far the render of predicted weights is from the picture that they were read from."""
    if not len(predicted):  # this process has none of those pictures
        return predicted.sum(1)
    again = shop.studios[key].show(shop.studios[key].photograph(predicted))
    net = shop.networks.reenactnet
    return net.distances(key, net.describe(key, again), described)


def _cycle_loss(shop: Workshop, key: str, features: Tensor, described: Tensor, turn: Tensor) -> Tensor:
    """How far what comes back of pictures by way of another rig is from them: drawn, read, rendered, drawn back. Ours.

    The render between both halves lets only faces pass that the other rig can make. Each picture goes by way of the
    partner whose turn it is.
    """
    networks, net, misses = shop.networks, shop.networks.reenactnet, []
    for number, other in enumerate(shop.partners[key]):
        chosen = turn == number
        if not bool(chosen.any()):
            continue
        weights = networks.bpnets[other](net.readable(net.decoders[other](features[chosen])))
        rendered = shop.studios[other].show(shop.studios[other].photograph(weights))
        back = net(net.readable(net.describe(other, rendered)), other, key)
        misses.append(net.distances(key, back, described[chosen]))
    return torch.cat(misses) if misses else features.flatten(1).sum(1)


def _reenactnet_losses(shop: Workshop, pools: dict[str, Pool], batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """Each rig redraws itself through the shared encoder, and another where pairs tell how. Source: KI21, L_recon.

    Ours: residuals against the neutral, jitter of the encoder's input only, pairs.
    """
    training, net, losses = shop.config.training, shop.networks.reenactnet, {}
    for key, pool in pools.items():
        mine = shop.team.share(len(batch[key]))
        rows, size = batch[key][mine], len(batch[key])
        features = net.encode(pool.seen[rows], key)
        drawn = net.decoders[key](features)
        losses[f"reconstruction.{key}"] = net.distances(key, drawn, pool.described[rows]).sum() / size
        for other, partners in pool.partners.items():
            chosen, index, share = pool.shown_on(other, batch[key], mine)
            name = f"pairs.{other}"
            losses.setdefault(name, pool.described.new_zeros(()))
            if len(chosen):
                distances = net.distances(other, net.decoders[other](features[chosen]), partners.described[index])
                losses[name] = losses[name] + training.pair_loss * (distances @ share.to(distances))
    return losses


def _bpnet_losses(
    shop: Workshop, key: str, pools: dict[str, Pool], batch: dict[str, Tensor], done: float
) -> dict[str, Tensor]:
    """Weights are read back from pictures of the rig's own expressions. Source: KI21, L_b = L_w + L_r.

    Ours: part of the pictures is drawn by ReenactNet, from other rigs' where there are pairs; errors also count by how
    far they move the vertices; L_r is taken on part of the pictures.
    """
    bpnet, net, own, size = shop.config.bpnet, shop.networks.reenactnet, pools[key], len(batch[key])
    mine = shop.team.share(size)
    rows = batch[key][mine]
    weights, described = own.weights[rows], own.described[rows]
    read = net.readable(described)
    count = round(bpnet.decoded_fraction * bpnet.batch_size)
    sources = [other for other in pools if key in pools[other].partners] or [key]
    for source, part in zip(sources, torch.arange(count).tensor_split(len(sources))):
        place = torch.isin(mine, part).nonzero().flatten()
        if not len(place):
            continue
        there = place.to(read.device)
        with torch.no_grad():
            if source == key:
                drawn = net(own.seen[rows[place]], key, key)
            else:
                partners, chosen = pools[source].partners[key], batch[source][mine[place] - part[0]]
                drawn = net(pools[source].seen[chosen], source, key)
                weights = weights.index_copy(0, there, partners.weights[partners.index[chosen]])
            read = read.index_copy(0, there, net.readable(drawn))
    predicted = shop.networks.bpnets[key](read)
    losses = {}
    if bpnet.weight_loss:
        losses["weights"] = bpnet.weight_loss * weight_distance(predicted, weights).sum() / size
    if bpnet.vertex_loss:
        losses["vertices"] = bpnet.vertex_loss * shop.vertex_distances[key](predicted, weights).sum() / size
    others = 0 if sources == [key] else count  # the first pictures are then of expressions that were not rendered
    rendered = min(max(1, round(bpnet.image_fraction * bpnet.batch_size)), bpnet.batch_size - others)
    if bpnet.image_loss and done >= bpnet.image_from and rendered:
        last = (mine >= size - rendered).nonzero().flatten()
        errors = _image_loss(shop, key, predicted[last], described[last])
        losses["image"] = bpnet.image_loss * errors.sum() / rendered
    return losses


def planned_steps(config: Config, keys: list[str]) -> dict[str, int]:
    """Steps of each stage of a training of these rigs, in their order."""
    training, bpnet = config.training, config.bpnet
    steps = _step_count(training.steps, training.epochs, training.frames, training.batch_size)
    if training.together:
        return {"networks": steps}
    each = _step_count(bpnet.steps, bpnet.epochs, training.frames, bpnet.batch_size)
    return {"reenactnet": steps, **{f"bpnet.{key}": each for key in keys}}


def _step_count(steps: int, epochs: float | None, frames: int, batch_size: int) -> int:
    """Steps, or as many as make the epochs over a fixed set."""
    if epochs is None:
        return steps
    return math.ceil(epochs * frames / batch_size)


def torch_random(seed: list[int]) -> torch.Generator:
    return torch.Generator().manual_seed(int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0] >> 1))
