"""train(): the one loop, for ReenactNet and for each rig's BPNet.

What is learnt, from which pictures and by which losses, is in `reenact.stages`. Here stages are gone through one after
the other, saved, checked and resumed. Every random number comes from (seed, stage, step): a resumed run takes the same
next step as an unbroken one, and so do several processes (`reenact.team`), which share pictures and batches, but for
the order of sums.
"""

from __future__ import annotations

import json
import math
import shlex
import signal
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
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
from reenact.data import Studio, check_device
from reenact.errors import ReenactError
from reenact.folder import migrate
from reenact.holdout import NUMBER, Holdout
from reenact.interrupts import Interrupts, Output, listening
from reenact.lock import RunLock
from reenact.losses import VertexDistance
from reenact.models import PICTURES_PER_COMPONENT, Networks
from reenact.pairs import Teacher
from reenact.preview import save_preview
from reenact.run import Run, restore_networks
from reenact.stages import CHUNK, Pool, Stage, Workshop, find_stages, torch_random
from reenact.team import Team, TeamError, team

_LOG_EVERY = 20
"""Steps between lines of metrics.jsonl; each holds the mean since the last."""


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
    shop = Workshop(config, studios, networks, run.new_keys, partners, teachers, distances, workers)
    stages = find_stages(shop)
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
                rows = stage.draw(pools, torch_random(seed))
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
def _begin(run: Run, shop: Workshop) -> None:
    """Take what the networks know before any training, from pictures and from the run that this one adds to."""
    networks, config = shop.networks, run.config

    def survey(key: str, count: int) -> Tensor:
        studio = shop.studios[key]
        chunks = studio.surveyed(count).split(CHUNK)
        return shop.team.map(lambda _, chunk: studio.show(studio.photograph(chunk)), chunks)

    count = PICTURES_PER_COMPONENT * config.reenactnet.components
    if run.base:
        networks.load_state_dict(networks.state_dict() | run.base)
        known = [key for key in shop.studios if key not in shop.learning]
        shown = {key: survey(key, max(CHUNK, count // len(known))) for key in known}
        networks.join(shown | {key: survey(key, count) for key in shop.learning}, shop.learning)
    else:
        networks.fit(list(shop.studios), lambda key: survey(key, count))
    shop.team.follow(*networks.state_dict().values())


def _holdout(shop: Workshop) -> Holdout:
    """What the networks are checked with at every save; the same whenever the run goes on."""
    training = shop.config.training
    arguments = (shop.networks, shop.teachers, shop.vertex_distances, shop.learning)
    return Holdout(shop.studios, *arguments, training.seed, training.frames)


def _read_by(keys: Iterable[str], together: bool, stage: int) -> list[str]:
    """Keys of the rigs whose BPNet has learnt by some stage, the one at work included."""
    return [key for index, key in enumerate(keys) if together or index + 1 <= stage]


def _check(holdout: Holdout | None, shop: Workshop, stage: int, console: Console) -> dict[str, float]:
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


def _optimizer(config: Config, stage: Stage) -> torch.optim.Optimizer:
    if config.training.optimizer == "adam":
        return torch.optim.Adam(stage.trained, lr=stage.learning_rate, fused=True)
    return torch.optim.AdamW(  # fused: a quarter of each step's time otherwise
        stage.trained, lr=stage.learning_rate, weight_decay=config.training.weight_decay, fused=True
    )


def _not_finite(losses: dict[str, Tensor], trained: list[Tensor]) -> str:
    """What is not finite before a step: "the loss", "the gradient", or nothing."""
    if not torch.isfinite(torch.stack(list(losses.values())).sum()):
        return "the loss"
    gradients = [each.grad for each in trained if each.grad is not None]
    return "" if torch.isfinite(torch.nn.utils.get_total_norm(gradients)) else "the gradient"


def _keep_batch(
    run: Run, pools: dict[str, Pool], rows: dict[str, Tensor], losses: dict[str, Tensor], total: int
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


def _restore(run: Run, networks: Networks, stages: list[Stage]) -> tuple[int, int, torch.optim.Optimizer | None]:
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
