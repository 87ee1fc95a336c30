"""train(): the one loop, for ReenactNet and for each rig's BPNet.

Kim et al. 2021 (KI21), "Deep Learning-Based Unsupervised Human Facial Retargeting", doi:10.1111/cgf.14400,
sections 3.2 and 3.3. The published training goes through stages: ReenactNet first, then one BPNet per rig. Ours is one
stage in which both learn together: each BPNet reads what ReenactNet draws, and its errors tell ReenactNet what matters
in a picture. A stage renders some thousand expressions of each rig at a time, describes them once (`reenact.models`),
and takes its batches from there until it renders others. Every random number comes from (seed, stage, step): a resumed
run takes the same next step as an unbroken one, and so do several processes (`reenact.team`), which share pictures and
batches, but for the order of sums.

A cast is trained as a pair is. Each expression is shown on a few partners only (`pairs.shown`), so that from some rigs
on the next costs as much as the last.
"""

from __future__ import annotations

import json
import math
import shlex
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor

from reenact import tensorboard
from reenact.atomic import sweep, write_atomically
from reenact.checkpoint import (
    best_checkpoint,
    flatten_optimizer,
    load_checkpoint,
    restore_optimizer,
    save_checkpoint,
    save_tensors,
)
from reenact.config import Config, TrainingConfig
from reenact.data import Studio, check_device, jitter
from reenact.errors import ReenactError
from reenact.folder import migrate
from reenact.holdout import NUMBER, Holdout
from reenact.interrupts import Interrupts, Output, listening
from reenact.lock import RunLock
from reenact.losses import VertexDistance, code_distance, weight_distance
from reenact.models import Networks
from reenact.pairs import LEAST_TRUST, Teacher
from reenact.preview import save_preview
from reenact.run import Run, restore_networks
from reenact.team import Team, TeamError, team

_PICTURES_PER_COMPONENT = 6
"""Pictures of each rig, per principal component, from which networks learn what varies before any training."""
_CHUNK = 64
"""Expressions that are photographed at once; part of what makes a run repeatable."""
_NEAR = 64
"""Expressions near each corrected one, of a quarter of all at most."""
_LOG_EVERY = 20
"""Steps between lines of metrics.jsonl; each holds the mean since the last."""


@dataclass(frozen=True)
class _Stage:
    """One network's share of the training."""

    name: str
    """`networks`; or `reenactnet`, then `bpnet.KEY`."""
    trained: list[Tensor]
    """What learns."""
    steps: int
    learning_rate: float
    render: Callable[[list[int]], dict[str, _Pool]]
    """Fresh expressions of the rigs that take part; the numbers seed them."""
    draw: Callable[[dict[str, _Pool], torch.Generator], dict[str, Tensor]]
    """Rows of the pools that make the batch of all processes."""
    losses: Callable[[dict[str, _Pool], dict[str, Tensor], float], dict[str, Tensor]]
    """Terms whose sum is minimised, this process's part of them, on those rows; the share of the steps that are
    done."""


@dataclass(frozen=True)
class _Pool:
    """Expressions of one rig, rendered and described."""

    weights: Tensor  # (N, K)
    described: Tensor  # (N, ...), what decoders should draw
    seen: Tensor  # (N, ...), what the encoder is given: the readable part, jittered
    turn: Tensor  # (N,), place among the rig's partners of the first that each expression is shown on
    partners: dict[str, _Partners] = field(default_factory=dict)
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
class _Partners:
    """What another rig makes of some expressions of a pool, M of them."""

    index: Tensor  # (N,), row below of each expression of the pool; -1 where it is shown on others
    weights: Tensor  # (M, K)
    described: Tensor | None  # (M, ...), where they are pictured
    confidence: Tensor  # (M,)


@dataclass(frozen=True)
class _Workshop:
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


def train(config: Config, resume: bool = False) -> Path:
    """Train the networks of some rigs, or go on with a run that stopped.

    Under torchrun several processes share the work. Their folder must be on a disk that all of them see.

    Args:
        config: All settings; when resuming, only `run` is read, the rest comes from the run's own config.
        resume: Go on with the run in `config.run`; a finished run returns at once.

    Returns:
        The run folder.

    Raises:
        MissingError: There is no run to resume.
        ReenactError: The folder holds something and `resume` is False, another process trains in it, a rig or clip
            cannot work, the run is damaged or of another version, a loss or a network is no longer finite, another
            process of the team has ended.
        OSError: The folder cannot be written; the last checkpoint is intact.
        KeyboardInterrupt: Ctrl-C; everything up to the last finished step was saved.
        SystemExit: SIGTERM or a lost terminal, likewise saved; status 143 or 129.
    """
    if config.training.tensorboard:
        tensorboard.require()
    check_device(config.training.device)
    with listening() as interrupts, team() as workers:
        # A folder may look like markup. Only the first process speaks.
        console = Console(file=Output(), markup=False, highlight=False, emoji=False, quiet=not workers.leads)
        # Already for the layout, which sums of several threads would end in other bits from time to time.
        torch.set_num_threads(config.training.threads or torch.get_num_threads())
        with console.status("Reading rigs, finding the layout"):
            if workers.leads:
                run = Run.open(Path(config.run or "")) if resume else Run.create(config)
        with RunLock(run.folder) if workers.leads else nullcontext() as lock:
            if resume and workers.leads:
                migrate(run.folder, run.config)
                sweep(run.folder / "previews")
                for name in ("metrics.jsonl", "pairs.json"):  # not others: a viewer may be writing nudges.json
                    sweep(run.folder, name)
            folder = workers.agree(str(run.folder) if workers.leads else None)
            run = run if workers.leads else Run.open(Path(folder))
            console.print(f"To watch it, elsewhere: reenact view {_quoted(run)}", soft_wrap=True)
            _train(run, resume, lock, interrupts, console, workers)
    if workers.leads:
        _say_next(console, run)
    return run.folder


def _train(
    run: Run, resume: bool, lock: RunLock | None, interrupts: Interrupts, console: Console, workers: Team
) -> None:
    """The loop, for all stages that are left; interrupts end it at once until its first step, then after a save."""
    config = run.config
    _check_team(config, workers)
    torch.set_num_threads(config.training.threads or torch.get_num_threads())
    partners = {key: run.partners(key) for key in run.keys}
    device = config.training.device
    with console.status("Photographing neutrals"):
        studios = {key: run.studio(key, device) for key in run.keys if partners[key]}
    networks = run.networks().to(device)
    with console.status("Comparing shapes"):
        teachers = _find_teachers(run, studios, partners, console, workers)
    distances = {key: VertexDistance(studio.rig, studio.typical, device) for key, studio in studios.items()}
    shop = _Workshop(config, studios, networks, run.new_keys, partners, teachers, distances, workers)
    stages = _stages(shop)
    stage_index, first, optimizer = _restore(run, networks, stages) if resume else (0, 0, None)
    if (stage_index, first) == (0, 0):
        with console.status("Finding what varies in each rig's pictures"):
            _begin(run, shop)
    with console.status("Photographing expressions to check by"):
        holdout = _holdout(shop) if workers.leads else None
    done = sum(stage.steps for stage in stages[:stage_index])
    board = tensorboard.Board(run.folder, config.training.tensorboard and workers.leads, done + first)

    def keep(log: _Log, optimizer: torch.optim.Optimizer, index: int, step: int) -> None:
        """Save so many steps of a stage, if this process is the one that writes."""
        if workers.leads:
            numbers = _check(holdout, shop, index, console)
            log.flush(numbers)
            _save(run, lock, networks, optimizer, index, step, done + step, numbers.get(NUMBER))
            _say_saved(console, run, stages[index].name, done + step, numbers)

    with _progress(console) as show, interrupts.patiently(), board:
        for index, stage in list(enumerate(stages))[stage_index:]:
            optimizer = optimizer or _optimizer(config, stage)
            path = run.folder / "metrics.jsonl" if workers.leads else None
            log = _Log(path, stage.name, first, partial(board.scalars, stage.name, done))
            pools, saved = None, first
            networks.train()
            for step in range(first, stage.steps):
                seed = [config.training.seed, index, step]
                chapter = step // (config.training.refresh or stage.steps)
                if pools is None or step == chapter * config.training.refresh:
                    console.print(f"{stage.name}: rendering {config.training.frames:,} fresh expressions per rig")
                    try:
                        with interrupts.promptly():
                            pools = stage.render([config.training.seed, index, chapter])
                    except (KeyboardInterrupt, SystemExit, TeamError):  # no step is half done: what was learnt is kept
                        if step > saved:
                            keep(log, optimizer, index, step)
                        _say_stopped(console, run)
                        raise
                for group in optimizer.param_groups:
                    group["lr"] = learning_rate(step, stage.steps, stage.learning_rate, config.training.schedule)
                rows = stage.draw(pools, _torch_random(seed))
                losses = stage.losses(pools, rows, step / stage.steps)
                loss = torch.stack(list(losses.values())).sum()
                optimizer.zero_grad(set_to_none=True)
                loss.backward()
                try:
                    losses, stop = _summed(workers, stage.trained, losses, interrupts.asked is not None)
                except TeamError:
                    if step > saved:
                        keep(log, optimizer, index, step)
                    raise
                wrong = _not_finite(losses, stage.trained)
                if wrong:
                    kept = _keep_batch(run, pools, rows, losses, done + step)
                    raise ReenactError(
                        f"{run.folder}: {wrong} of {stage.name} became infinite or no number at step {step}; {kept}the "
                        "last checkpoint is intact, lower the learning rate and train again"
                    )
                optimizer.step()
                due = stop or next_save(config.training, step, stage.steps, done) == step + 1
                log.add(step, losses, hold=due)
                show(stage.name, step + 1, stage.steps, log.recent)
                if due:
                    saved = step + 1
                    keep(log, optimizer, index, step + 1)
                    if workers.leads and not stop:
                        _preview(run, networks, studios, index, done + step + 1, console, board)
                if stop:
                    _say_stopped(console, run)
                    raise interrupts.asked or SystemExit(128 + signal.SIGTERM)  # another process was asked
            done, first, optimizer = done + stage.steps, 0, None


def next_save(training: TrainingConfig, step: int, steps: int, before: int) -> int:
    """At which step of a stage the next checkpoint is due: its end, what the settings say, or a milestone.

    Args:
        training: Says how often.
        step: Steps of the stage that are done.
        steps: Of the whole stage.
        before: Steps of the stages before it.
    """
    due = [steps, (step // training.save_every + 1) * training.save_every]
    if training.milestones:
        due.append(((before + step) // training.milestones + 1) * training.milestones - before)
    return min(due)


def learning_rate(step: int, steps: int, peak: float, schedule: str) -> float:
    """The rate at a step: constant, or one cycle (cosine up over the first 15 %, cosine down to nothing).

    Args:
        step: From 0 to `steps` - 1.
        steps: Of the whole stage.
        peak: The constant rate, or the highest.
        schedule: "constant" or "one-cycle".

    Source: one cycle after Smith & Topin 2019, "Super-Convergence", arXiv:1708.07120; cosines instead of lines.
    """
    if schedule == "constant":
        return peak
    warm = 0.15 * steps
    if step < warm:
        return peak * (0.04 + 0.96 * (1 - math.cos(math.pi * step / warm)) / 2)
    return peak * (1e-4 + (1 - 1e-4) * (1 + math.cos(math.pi * (step - warm) / (steps - warm))) / 2)


def _check_team(config: Config, workers: Team) -> None:
    """Refuse what several processes cannot share."""
    smallest = config.training.batch_size if config.training.together else config.bpnet.batch_size
    if workers.size > smallest:
        raise ReenactError(
            f"processes: expected at most one for each of {smallest} pictures of a batch, got {workers.size}; start "
            "fewer, or raise the batch_size"
        )
    if workers.size > 1 and config.training.align_loss:
        raise ReenactError(
            f"processes: expected one, for training.align_loss compares whole batches, got {workers.size}; set it to 0"
        )


@torch.no_grad()
def _begin(run: Run, shop: _Workshop) -> None:
    """Take what the networks know before any training, from pictures and from the run that this one adds to."""
    networks, config = shop.networks, run.config

    def survey(key: str, count: int) -> Tensor:
        studio = shop.studios[key]
        chunks = studio.surveyed(count).split(_CHUNK)
        return shop.team.map(lambda _, chunk: studio.show(studio.photograph(chunk)), chunks)

    count = _PICTURES_PER_COMPONENT * config.reenactnet.components
    if run.base:
        networks.load_state_dict(networks.state_dict() | run.base)
        known = [key for key in shop.studios if key not in shop.learning]
        shown = {key: survey(key, max(_CHUNK, count // len(known))) for key in known}
        networks.join(shown | {key: survey(key, count) for key in shop.learning}, shop.learning)
    else:
        networks.fit(list(shop.studios), lambda key: survey(key, count))
    shop.team.follow(*networks.state_dict().values())


def _holdout(shop: _Workshop) -> Holdout:
    """What the networks are checked with at every save; the same whenever the run goes on."""
    training = shop.config.training
    arguments = (shop.networks, shop.teachers, shop.vertex_distances, shop.learning)
    return Holdout(shop.studios, *arguments, training.seed, training.frames)


def _read_by(keys: Iterable[str], together: bool, stage: int) -> list[str]:
    """Keys of the rigs whose BPNet has learnt by some stage, the one at work included."""
    return [key for index, key in enumerate(keys) if together or index + 1 <= stage]


def _check(holdout: Holdout | None, shop: _Workshop, stage: int, console: Console) -> dict[str, float]:
    """What the holdout says, as far as it is finite; a failing check never stops training, and no save."""
    if holdout is None:
        return {}
    try:
        numbers = holdout(shop.networks, _read_by(shop.studios, shop.config.training.together, stage))
    except Exception as error:
        console.print(f"check skipped: {error}", soft_wrap=True)
        return {}
    return {name: value for name, value in numbers.items() if math.isfinite(value)}


def _summed(
    workers: Team, trained: list[Tensor], losses: dict[str, Tensor], asked: bool
) -> tuple[dict[str, Tensor], bool]:
    """Gradients and losses of all processes, and whether any was asked to stop."""
    if workers.size == 1:
        return losses, asked
    values = torch.stack([value.detach() for value in losses.values()])
    used = values.new_tensor([each.grad is not None for each in trained])
    stop = values.new_tensor([float(asked)])
    workers.add(values, used, stop)
    learnt = [each for each, count in zip(trained, used.tolist()) if count]
    for each in learnt:
        each.grad = torch.zeros_like(each) if each.grad is None else each.grad
    workers.add(*[each.grad for each in learnt])
    return dict(zip(losses, values)), bool(stop)


def _find_teachers(
    run: Run, studios: dict[str, Studio], partners: dict[str, list[str]], console: Console, workers: Team
) -> dict[tuple[str, str], Teacher]:
    """Teachers from each rig to its partners; what they say of single shapes goes to pairs.json, for people to read."""
    if run.config.pairs.method == "none":
        return {}
    teachers, words = {}, {}
    for source in studios:
        for target in partners[source]:
            teacher = run.teacher(studios[source], studios[target], source, target)
            teachers[source, target] = teacher
            names = studios[source].rig.names, studios[target].rig.names
            single = torch.eye(len(names[0]))
            told = teacher.weights(single)
            trust = teacher.confidence(single, told)
            words[f"{source} -> {target}"] = {
                names[0][k]: {
                    "agreed": k in teacher.agreed,
                    "confidence": round(float(trust[k]), 3),
                    "shapes": {names[1][j]: round(value, 3) for j, value in enumerate(row) if value > 0.005},
                }
                for k, row in enumerate(told.tolist())
            }
            console.print(
                f"{source} -> {target}: {len(teacher.agreed)} of {len(names[0])} shapes have partners there, "
                "the rest are mixtures",
                soft_wrap=True,
            )
    if workers.leads:
        write_atomically(run.folder / "pairs.json", (json.dumps(words, indent=1, ensure_ascii=False) + "\n").encode())
    return teachers


def _stages(shop: _Workshop) -> list[_Stage]:
    training, bpnet, keys = shop.config.training, shop.config.bpnet, list(shop.studios)
    networks = shop.networks
    trained = list(networks.parameters())
    if shop.learning != list(shop.partners):
        networks.requires_grad_(False)
        trained = [each.requires_grad_() for key in shop.learning for each in networks.own(key)]

    def render_all(seed: list[int]) -> dict[str, _Pool]:
        return {key: _render(shop, key, seed, shop.partners[key], _count(shop, key, training.frames)) for key in keys}

    def draw_all(pools: dict[str, _Pool], random: torch.Generator) -> dict[str, Tensor]:
        return {
            key: torch.randint(len(pool.weights), (_count(shop, key, training.batch_size),), generator=random)
            for key, pool in pools.items()
        }

    steps = planned_steps(shop.config, keys)
    if training.together:
        return [
            _Stage(
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
        _Stage(
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
            _Stage(
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


def _count(shop: _Workshop, key: str, count: int) -> int:
    """How many of so many expressions are a rig's: all, or a part where rigs that are trained already share them."""
    if key in shop.learning:
        return count
    return -(-count // (len(shop.studios) - len(shop.learning)))


@torch.no_grad()
def _render(
    shop: _Workshop, key: str, seed: list[int], partners: list[str], count: int, pictured: bool = True
) -> _Pool:
    """Fresh expressions of a rig, and how each looks on one of its partners; `pictured` draws it there too."""
    place = list(shop.studios).index(key)
    elastic = shop.config.training.elastic
    weights = shop.studios[key].draw(count, np.random.default_rng([*seed, place]))
    weights = _corrected_first(shop, key, weights, seed)
    chunks, net = weights.split(_CHUNK), shop.networks.reenactnet

    def describe(_number: int, chunk: Tensor) -> Tensor:
        return net.describe(key, shop.studios[key].show(shop.studios[key].photograph(chunk)))

    def look(number: int, chunk: Tensor) -> Tensor:
        """Both what `describe` says and what the encoder is given instead, side by side."""
        shown = shop.studios[key].show(shop.studios[key].photograph(chunk))
        bent = jitter(shown, elastic, _torch_random([*seed, place, 2, number]))
        return torch.cat([net.describe(key, shown), net.readable(net.describe(key, bent))], dim=1)

    if elastic:
        both = shop.team.map(look, chunks)
        bent = net.readable(both).shape[1]
        described, seen = both[:, :-bent], both[:, -bent:]
    else:
        described = shop.team.map(describe, chunks)
        seen = net.readable(described)
    turn = torch.randperm(count, generator=_torch_random([*seed, place, 3])) % max(1, len(partners))
    found = {}
    for number, other in enumerate(partners):
        if (key, other) in shop.teachers:
            chosen = (number - turn) % len(partners) < shop.config.pairs.shown
            found[other] = _shown_on(shop, (key, other), weights, chosen, pictured)
    return _Pool(weights.to(described), described, seen, turn, found)


def _shown_on(shop: _Workshop, pair: tuple[str, str], weights: Tensor, chosen: Tensor, pictured: bool) -> _Partners:
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
            lambda _, chunk: net.describe(other, studio.show(studio.photograph(chunk))), theirs.split(_CHUNK)
        )
    return _Partners(index, theirs.to(studio.device), described, trust)


def _corrected_first(shop: _Workshop, key: str, weights: Tensor, seed: list[int]) -> Tensor:
    """Expressions of which the first are drawn towards corrected ones: half to all of the way, `_NEAR` per correction.

    Random ones would hardly ever come near. Ours.
    """
    teachers = [teacher for (source, _), teacher in shop.teachers.items() if source == key]
    corrected = [teacher.corrections.source_weights for teacher in teachers if teacher.corrections is not None]
    if not corrected:
        return weights
    random = _torch_random([*seed, list(shop.studios).index(key), 1])
    centres = torch.cat(corrected).repeat(_NEAR, 1)[: len(weights) // 4]
    share = 0.5 + 0.5 * torch.rand(len(centres), 1, generator=random)
    return torch.cat([torch.lerp(weights[: len(centres)], centres, share), weights[len(centres) :]])


def _draw_for_bpnet(shop: _Workshop, key: str, pools: dict[str, _Pool], random: torch.Generator) -> dict[str, Tensor]:
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


def _joint_losses(shop: _Workshop, pools: dict[str, _Pool], batch: dict[str, Tensor], done: float) -> dict[str, Tensor]:
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


def _weight_losses(shop: _Workshop, key: str, predicted: Tensor, weights: Tensor) -> Tensor:
    """(N,), how wrong predicted weights are: L_w of KI21, and by how far they move the vertices (ours)."""
    bpnet, moved = shop.config.bpnet, shop.vertex_distances[key](predicted, weights)
    return bpnet.weight_loss * weight_distance(predicted, weights) + bpnet.vertex_loss * moved


def _image_loss(shop: _Workshop, key: str, predicted: Tensor, described: Tensor) -> Tensor:
    """(N,), L_r of KI21: how far the render of predicted weights is from the picture that they were read from."""
    if not len(predicted):  # this process has none of those pictures
        return predicted.sum(1)
    again = shop.studios[key].show(shop.studios[key].photograph(predicted))
    net = shop.networks.reenactnet
    return net.distances(key, net.describe(key, again), described)


def _cycle_loss(shop: _Workshop, key: str, features: Tensor, described: Tensor, turn: Tensor) -> Tensor:
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


def _reenactnet_losses(shop: _Workshop, pools: dict[str, _Pool], batch: dict[str, Tensor]) -> dict[str, Tensor]:
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
    shop: _Workshop, key: str, pools: dict[str, _Pool], batch: dict[str, Tensor], done: float
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


def _optimizer(config: Config, stage: _Stage) -> torch.optim.Optimizer:
    if config.training.optimizer == "adam":
        return torch.optim.Adam(stage.trained, lr=stage.learning_rate, fused=True)
    return torch.optim.AdamW(  # fused: a quarter of each step's time otherwise
        stage.trained, lr=stage.learning_rate, weight_decay=config.training.weight_decay, fused=True
    )


def _torch_random(seed: list[int]) -> torch.Generator:
    return torch.Generator().manual_seed(int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0] >> 1))


def _not_finite(losses: dict[str, Tensor], trained: list[Tensor]) -> str:
    """What is not finite before a step: "the loss", "the gradient", or nothing."""
    if not torch.isfinite(torch.stack(list(losses.values())).sum()):
        return "the loss"
    gradients = [each.grad for each in trained if each.grad is not None]
    return "" if torch.isfinite(torch.nn.utils.get_total_norm(gradients)) else "the gradient"


def _keep_batch(
    run: Run, pools: dict[str, _Pool], rows: dict[str, Tensor], losses: dict[str, Tensor], total: int
) -> str:
    """Write the batch that went wrong beside the checkpoints; half a sentence about where it lies."""
    kept = {f"loss.{name}": value for name, value in losses.items()}
    for key, chosen in rows.items():
        pool = pools[key]
        for name in ("weights", "described", "seen"):
            values = getattr(pool, name)
            if len(values) == len(pool.weights):  # a pool that is not pictured has none
                kept[f"{key}.{name}"] = values[chosen]
    path = run.folder / "failed" / f"step-{total:08d}.safetensors"
    try:
        path.parent.mkdir(exist_ok=True)
        save_tensors(kept, path)
    except OSError as error:
        return f"the batch could not be kept ({error}), "
    return f"the batch is in {path}, "


def _save(
    run: Run,
    lock: RunLock,
    networks: Networks,
    optimizer: torch.optim.Optimizer,
    stage: int,
    step: int,
    total: int,
    error: float | None = None,
) -> None:
    """`stage` and `step` are where to go on; `total` counts steps over all stages and names the checkpoint, `error` is
    what the best is chosen by.

    Raises:
        ReenactError: Another process trains in the folder by now, or a number in a network or optimizer is not finite.
        OSError: The checkpoint cannot be written.
    """
    lock.check()
    tensors = {f"networks.{name}": tensor for name, tensor in networks.state_dict().items()}
    optimizer_tensors, optimizer_state = flatten_optimizer(optimizer)
    tensors |= optimizer_tensors
    strange = [name for name, tensor in tensors.items() if not bool(torch.isfinite(tensor).all())]
    if strange:
        raise ReenactError(
            f"{run.folder}: {strange[0]} became infinite or no number by step {step} and was not saved; the last "
            "checkpoint is intact, lower the learning rate and train again"
        )
    state = {"stage": stage, "step": step, "optimizer": optimizer_state}
    keep, milestones = run.config.training.keep, run.config.training.milestones
    save_checkpoint(run.folder, total, tensors, state, error=error, keep=keep, milestones=milestones)


def _restore(run: Run, networks: Networks, stages: list[_Stage]) -> tuple[int, int, torch.optim.Optimizer | None]:
    """Networks as they were saved; the stage and step to go on with, and that stage's optimizer if it had begun."""
    try:
        checkpoint = load_checkpoint(run.folder)
    except FileNotFoundError:  # stopped before the first save: nothing to restore
        return 0, 0, None
    restore_networks(networks, checkpoint.tensors, run.folder)
    stage, step = checkpoint.state["stage"], checkpoint.state["step"]
    if step >= stages[stage].steps:
        return stage + 1, 0, None
    optimizer = _optimizer(run.config, stages[stage])
    restore_optimizer(optimizer, checkpoint.tensors, checkpoint.state["optimizer"])
    return stage, step, optimizer


def parsed_line(text: str) -> dict[str, Any] | None:
    """A line of metrics.jsonl, or None where a power cut or a full disk tore it."""
    try:
        line = json.loads(text)
    except (ValueError, RecursionError):
        return None
    whole = isinstance(line, dict) and isinstance(line.get("stage"), str) and type(line.get("step")) is int
    return line if whole else None


class _Log:
    """Means of the losses, appended to a JSONL file; lines of steps that will be taken again are dropped first."""

    def __init__(
        self, path: Path | None, stage: str, step: int, tell: Callable[[int, dict[str, float]], None] = lambda *_: None
    ):
        """`tell` hears of each line as well; without a path nothing is written."""
        self.path, self.stage, self.tell = path, stage, tell
        self.pending: dict[str, list[float]] = {}
        self.recent: dict[str, float] = {}
        self.started, self.step, self.last = time.perf_counter(), step, step
        if path is not None and path.exists():
            lines = [line for text in path.read_text(errors="replace").splitlines() if (line := parsed_line(text))]
            kept = [line for line in lines if line["stage"] != stage or line["step"] <= step]
            write_atomically(path, "".join(json.dumps(line) + "\n" for line in kept).encode())

    def add(self, step: int, losses: dict[str, Tensor], hold: bool = False) -> None:
        """Take in the losses of a step; `hold` leaves the line to a `flush` that follows at once."""
        for name, value in losses.items():
            self.pending.setdefault(name, []).append(float(value.detach()))
        self.step = step + 1
        if self.step - self.last >= _LOG_EVERY and not hold:
            self.flush()

    def flush(self, beside: dict[str, float] | None = None) -> None:
        """Write a line where there is anything to tell; numbers `beside` the losses are not summed with them."""
        if not self.pending and not beside:
            return
        now, numbers = time.perf_counter(), dict(beside or {})
        if self.pending:
            self.recent = {name: float(np.mean(values)) for name, values in self.pending.items()}
            speed = (self.step - self.last) / (now - self.started)
            numbers = {"loss": sum(self.recent.values()), **self.recent, **numbers, "steps_per_second": speed}
        line = {"stage": self.stage, "step": self.step, **numbers}
        self.tell(self.step, numbers)
        if self.path is not None:
            with self.path.open("a") as file:
                file.write(json.dumps(line) + "\n")
        self.pending, self.started, self.last = {}, now, self.step


def _preview(
    run: Run,
    networks: Networks,
    studios: dict[str, Studio],
    stage: int,
    total: int,
    console: Console,
    board: tensorboard.Board,
) -> None:
    """A failing preview never stops training."""
    try:
        together = run.config.training.together
        trained = _read_by(studios, together, stage)
        networks.eval()
        path = run.folder / "previews" / f"{total:06d}.png"
        save_preview(path, studios, networks, trained)
        board.picture(path, total)
    except Exception as error:
        console.print(f"preview skipped: {error}", soft_wrap=True)
    finally:
        networks.train()


@contextmanager
def _progress(console: Console) -> Iterator[Callable[[str, int, int, dict[str, float]], None]]:
    """A live line on a terminal; a line every few hundred steps elsewhere."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed}/{task.total} {task.fields[speed]} {task.fields[losses]}"),
        TimeRemainingColumn(),
    )
    progress, tasks, started = Progress(*columns, console=console), {}, {}

    def show(stage: str, step: int, steps: int, losses: dict[str, float]) -> None:
        if stage not in tasks:
            tasks[stage] = progress.add_task(stage, total=steps, completed=step - 1, speed="", losses="")
            started[stage] = (time.perf_counter(), step - 1)
        begun, first = started[stage]
        speed = f"{(step - first) / (time.perf_counter() - begun):.1f} steps/s"
        text = " ".join(f"{name.removeprefix('reconstruction.')} {value:.4f}" for name, value in losses.items())
        progress.update(tasks[stage], completed=step, speed=speed, losses=text)
        if not console.is_terminal and (step % 200 == 0 or step == steps):
            left = (steps - step) * (time.perf_counter() - begun) / (step - first)
            console.print(f"{stage} {step}/{steps}  {speed}  {left:.0f} s left  {text}", soft_wrap=True)

    if console.is_terminal:
        with progress:
            yield show
    else:
        yield show


def _say_saved(console: Console, run: Run, stage: str, total: int, numbers: dict[str, float]) -> None:
    """What a save is worth, where it was checked."""
    found = best_checkpoint(run.folder) if NUMBER in numbers else None
    if found is not None:
        step, least = found
        place = "the best so far" if step == total else f"the best is {least:.4f} of step {step:,}"
        words = f"{stage}: saved step {total:,}, held-out error {numbers[NUMBER]:.4f}, {place}"
        console.print(words, soft_wrap=True)


def _say_stopped(console: Console, run: Run) -> None:
    console.print(f"Stopped and saved. Go on with: reenact train --run {_quoted(run)} --resume", soft_wrap=True)


def _say_next(console: Console, run: Run) -> None:
    folder, between = _quoted(run), ""
    console.print(f"Trained: {run.folder}", soft_wrap=True)
    if run.config.cast:
        between = f" --from {shlex.quote(run.keys[0])} --to {shlex.quote(run.keys[-1])}"
        console.print(f"Any of {', '.join(run.keys)} moves any other:", soft_wrap=True)
    console.print(f"  reenact infer {folder} CLIP{between} --out result.glb", soft_wrap=True)
    console.print(f"  reenact evaluate {folder}{between}", soft_wrap=True)
    console.print(f"  reenact view {folder}{between}", soft_wrap=True)


def _quoted(run: Run) -> str:
    """The folder as one word of a command."""
    return shlex.quote(str(run.folder))
