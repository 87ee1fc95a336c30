"""The commands: reenact train | add | infer | batch | evaluate | view | render | convert | inspect | rigs | doctor."""

from __future__ import annotations

import errno
import os
import sys
import traceback
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rich.console import Console
from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg
from tyro.extras import subcommand_cli_from_dict

from reenact.config import Config, PostConfig, changed_settings, check_config, load_config
from reenact.errors import MissingError, ReenactError, interruptions
from reenact.folder import check_run, load_run_config
from reenact.tables import evaluation_tables, inspection_lines, of_step

# PyTorch's threads wait for work by spinning, and would take the cores from the renderer's threads, which run between
# its operations. OpenMP reads this once, when PyTorch loads it.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

# The rest of the project is imported inside the commands: PyTorch takes seconds to load, `--help` should not.
if TYPE_CHECKING:
    from reenact.rigs.clip import Clip
    from reenact.rigs.formats.pieces import Choice
    from reenact.rigs.rig import Rig

_USD_FILES = (".usd", ".usda", ".usdc", ".usdz")
_RIG_FILES = (".glb", ".npz", ".obj", *_USD_FILES)
_CLIP_FILES = (".csv", ".npz", ".json", ".glb", ".vrm", ".py", *_USD_FILES)


def train(
    settings: Annotated[Config, arg(name="")] = Config(),  # noqa: B008 - frozen
    *,
    config: Annotated[Path | None, arg(metavar="FILE.toml")] = None,
    resume: Annotated[bool, FlagCreatePairsOff] = False,
) -> None:
    """Train networks that move expressions between two rigs, or between any two of a cast.

    A rig is a built-in name (`reenact rigs` lists them) or a file: .glb, .gltf, .vrm, .fbx, USD, .npz, or a folder of
    .obj files; `reenact inspect` shows what is in it. A clip is a file, or synthetic:SEED[:SECONDS]. Settings come from
    their defaults, then from --config, then from the options below. `torchrun --nproc-per-node N -- train.py ...`
    shares the work among N processes; docs/scale.md tells of machines and clusters.

    Args:
        settings: Every setting.
        config: TOML file with settings; see configs/.
        resume: Go on with the stopped run in --run, with the settings it began with.
    """
    check_config(settings, origin="command line")
    if resume:
        if settings.run is None:
            raise ReenactError("--resume: expected the folder of a run beside it, got none; add --run DIR")
        saved = load_run_config(settings.run)
        changed = changed_settings(saved, replace(settings, run=saved.run))
        if changed:
            raise ReenactError(
                f"{settings.run}: expected the settings that the run began with, got other {', '.join(changed)}; "
                f"leave them out, or train a new run without --resume"
            )
    from reenact.training import train

    train(settings, resume=resume)


def add(
    base: Annotated[Positional[Path], arg(metavar="RUN")],
    rigs: Annotated[Positional[tuple[str, ...]], arg(metavar="RIG [RIG ...]", help_behavior_hint="(one or more)")],
    *,
    run: Annotated[str | None, arg(metavar="DIR")] = None,
    steps: int | None = None,
) -> None:
    """Add rigs to a trained run, as a new run: all that it knows stays as it is, only what is theirs is trained.

    A run that is stopped goes on with `reenact train --run DIR --resume`.

    Args:
        base: The folder that `reenact train` wrote, of a pair or a cast.
        rigs: Built-in names or files.
        run: Folder to create; a new one below runs/ unless said.
        steps: Of the training; as many as those of RUN unless said.
    """
    check_run(base)
    if not rigs:
        raise ReenactError("add: expected at least one rig beside the run, got none; name it after the run")
    old = load_run_config(base)
    config = replace(
        old,
        cast=(*old.rigs, *rigs),
        base=str(base),
        run=run,
        source_parts=(),
        source_shapes=(),
        target_parts=(),
        target_shapes=(),
        pairs=replace(old.pairs, correspondence=None, nudges=None),
        training=old.training if steps is None else replace(old.training, steps=steps),
    )
    check_config(config, origin=str(base))
    from reenact.training import train

    train(config)


def infer(
    inputs: Annotated[Positional[tuple[str, ...]], arg(metavar="[RUN] CLIP", help_behavior_hint="")],
    *,
    out: Annotated[Path, arg(metavar="FILE")],
    method: Annotated[str | None, arg(metavar="NAME")] = None,
    source: Annotated[str | None, arg(metavar="RIG")] = None,
    target: Annotated[str | None, arg(metavar="RIG")] = None,
    correspondence: Annotated[Path | None, arg(metavar="FILE")] = None,
    training: Annotated[str | None, arg(metavar="CLIP")] = None,
    from_: Annotated[str | None, arg(name="from", metavar="RIG")] = None,
    to: Annotated[str | None, arg(metavar="RIG")] = None,
    reverse: Annotated[bool, FlagCreatePairsOff] = False,
    checkpoint: Annotated[str, arg(metavar="newest|best|STEP")] = "newest",
    device: Literal["cpu", "cuda"] = "cpu",
    fps: float | None = None,
    post: PostConfig = PostConfig(),  # noqa: B008 - frozen
) -> None:
    """Move a clip from a source rig to a target: with a trained run, or by a geometric method without any training.

    With --method the rigs are --source and --target, or those of a RUN. Without --source, CLIP
    holds markers tracked on an actor (.c3d, or .csv and .npz of positions), and --correspondence says where they lie on
    the target (.csv of marker, vertex).

    Args:
        inputs: The folder that `reenact train` wrote, where there is one, and the motion of the source rig: a .csv
            (Live Link Face or a plain table), .json (Audio2Face or a table), .npz, .glb, .vrm, .fbx or USD file, or
            synthetic:SEED[:SECONDS].
        out: File to write, by its suffix: .csv (.table.csv for a plain table), .npz, .json (.a2f.json for Audio2Face),
            .py (a script for Blender; .maya.py for Maya), .glb or .vrm (the avatar itself, animated), or USD.
        method: A geometric method instead of networks; docs/methods.md compares them.
        source: Rig that the motion comes from, with --method.
        target: Rig that it goes to, with --method.
        correspondence: Pairs of vertices for --method (.csv of source, target; or .npz); found unless given.
        training: Motion that shows the source's whole range, for methods that learn from it.
        from_: A rig of the run, by its name; the first unless said.
        to: Another; the second unless said.
        reverse: From the target to the source instead.
        checkpoint: Of the run: the newest, the best by the held-out error of its saves, or that of a step.
        device: Where the run's networks look at pictures; cuda needs an NVIDIA GPU.
        fps: Frames per second of the result; those of the clip unless said.
        post: What to do to the result.
    """
    _check_out(out, _CLIP_FILES)
    check_config(Config(post=post), origin="command line")
    if method is None:
        if len(inputs) != 2:
            raise ReenactError(
                f"infer: expected RUN and CLIP, got {len(inputs)} arguments; without a run, choose a --method"
            )
        given = {"--source": source, "--target": target, "--correspondence": correspondence, "--training": training}
        strange = [name for name, value in given.items() if value is not None]
        if strange:
            raise ReenactError(
                f"infer: expected --method beside {', '.join(strange)}, got none; a run has its own rigs"
            )
        check_run(inputs[0])
        from reenact.inference import ImageRetargeter

        with _busy("Loading the networks"):
            retargeter: Any = ImageRetargeter.load(inputs[0], reverse, from_, to, device, checkpoint)
        origins = dict(zip(retargeter.run.keys, retargeter.run.config.rigs))
        names = [origins[key] for key in retargeter.keys]
        moved, older = _moved_by_networks(retargeter, inputs[-1]), retargeter.older
    else:
        _check_unchosen("infer", checkpoint, "networks", f"--method {method}")
        older = None
        named = (from_, to)
        moved, retargeter, names = _geometric(inputs, method, source, target, correspondence, training, reverse, named)
    from reenact.postprocessing import postprocess
    from reenact.rigs.files import save_clip

    moved = postprocess(_at_rate(moved, fps), post)
    with _busy(f"Writing {out}"):
        save_clip(moved, out, retargeter.target, names[1] if Path(names[1]).is_file() else None)
    print(
        f"{out}: {len(moved)} frames, {moved.duration:.1f} s, {retargeter.source.name} -> {retargeter.target.name}"
        f"{of_step(older)}"
    )


def batch(
    manifest: Annotated[Positional[Path], arg(metavar="MANIFEST")],
    *,
    results: Annotated[Path | None, arg(metavar="FILE.csv")] = None,
    device: Literal["cpu", "cuda"] = "cpu",
) -> int:
    """Move many clips on many rigs, each as `reenact infer` would; results and failures go to one table.

    An item that fails never stops the rest. A batch that was stopped goes on where it was, and tries again what failed.
    `torchrun --nproc-per-node N -m -- reenact.cli batch MANIFEST` shares the items among N processes. The exit status
    is 3 when an item failed.

    Args:
        manifest: Items as .csv, .json (a list) or .toml ([[item]]): clip and out; run, and from and to for a cast, or
            method, source and target; checkpoint, correspondence and fps where wanted.
        results: The table; MANIFEST-results.csv beside the manifest unless said.
        device: Where the networks of runs look at pictures; cuda needs an NVIDIA GPU.
    """
    results = results or manifest.with_name(f"{manifest.stem}-results.csv")
    _check_out(results, (".csv",))
    from reenact.batch import run_batch

    failed, rows = run_batch(manifest, results, lambda text: print(text, flush=True), device)
    print(f"{results}: {len(rows) - failed} of {len(rows)} ok, {failed} failed")
    return 3 if failed else 0


def evaluate(
    runs: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="RUN [RUN ...]", help_behavior_hint="(one or more)")
    ] = (),
    *,
    frames: int = 600,
    seed: int = 0,
    suite: Literal["geometric", "transfer"] | None = None,
    rigs: Annotated[tuple[str, ...], arg(metavar="RIG")] = (),
    methods: Annotated[tuple[str, ...], arg(metavar="NAME")] = (),
    from_: Annotated[str | None, arg(name="from", metavar="RIG")] = None,
    to: Annotated[str | None, arg(metavar="RIG")] = None,
    configs: Annotated[tuple[Path, ...], arg(metavar="FILE.toml")] = (),
    targets: Annotated[tuple[str, ...], arg(metavar="RIG")] = (),
    seeds: int = 3,
    checkpoint: Annotated[str, arg(metavar="newest|best|STEP")] = "newest",
    device: Literal["cpu", "cuda"] = "cpu",
    take: Annotated[Path | None, arg(metavar="CLIP")] = None,
    results: Annotated[Path | None, arg(metavar="FILE.jsonl")] = None,
    keep: Annotated[Path | None, arg(metavar="FOLDER")] = None,
) -> None:
    """Measure trained runs on clips that they have not seen, and write a report.

    Numbers go to RUN/evaluation/metrics.json. The report is one page with the table, curves and pictures.

    Args:
        runs: Folders that `reenact train` wrote.
        frames: Frames to measure on, in all.
        seed: Of the clips; the same seed gives every run on the same rigs the same clips.
        suite: Instead of runs, from anny:man to the other built-in characters: `geometric`, every geometric method by
            correspondences that are found; `transfer`, those and networks, trained by each of --configs.
        rigs: Files of further rigs for the suite, there and back.
        from_: A rig of a cast to measure from, by its name; the run's first unless said.
        to: Another; the second unless said.
        methods: Geometric methods to measure beside the runs; of the suite only these, or with the word none no such.
        configs: Settings of networks for the suite.
        targets: Only these built-in characters; the word none leaves them out.
        seeds: How many seeds of clips and training the suite takes, from --seed on.
        checkpoint: Of each run: the newest, the best by the held-out error of its saves, or that of a step.
        device: Where networks look at pictures; cuda needs an NVIDIA GPU.
        take: A recorded clip of ARKit shapes, measured as well.
        results: Finished cells of the suite: they are not made again, new ones are appended.
        keep: Keep the runs of the suite in this folder.
    """
    if suite is not None:
        _check_unchosen("evaluate", checkpoint, "runs", f"--suite {suite}")
        chosen = tuple(configs) if suite == "transfer" else ()
        _run_suite(rigs, targets, methods, chosen, frames, range(seed, seed + seeds), take, results, keep)
        return
    if not runs:
        raise ReenactError("evaluate: expected at least one run folder, got none; name the folders after the command")
    for run in runs:
        check_run(run)
    from reenact.evaluation import evaluate
    from reenact.inference import ImageRetargeter
    from reenact.report import write_report

    console, results = Console(markup=False, emoji=False), []
    for run in runs:
        with console.status(f"{run}") as status:
            results.append(
                evaluate(
                    run,
                    frames,
                    seed,
                    lambda stage, run=run, s=status: s.update(f"{run}: {stage}"),
                    methods,
                    from_,
                    to,
                    checkpoint,
                    device,
                )
            )
        for table in evaluation_tables(results[-1]):
            console.print(table)
    with console.status("Writing the report"):
        load = partial(ImageRetargeter.load, source=from_, target=to, checkpoint=checkpoint, device=device)
        page = write_report(list(runs), results, load)
    console.print(f"Report: {page}", highlight=False, soft_wrap=True)


def view(
    inputs: Annotated[Positional[tuple[str, ...]], arg(metavar="RUN|RIG [RIG ...]", help_behavior_hint="")],
    *,
    clip: Annotated[str | None, arg(metavar="CLIP")] = None,
    method: Annotated[str | None, arg(metavar="NAME")] = None,
    audio: Annotated[Path | None, arg(metavar="FILE.wav")] = None,
    nudges: Annotated[Path | None, arg(metavar="FILE.json")] = None,
    from_: Annotated[str | None, arg(name="from", metavar="RIG")] = None,
    to: Annotated[str | None, arg(metavar="RIG")] = None,
    checkpoint: Annotated[str, arg(metavar="newest|best|STEP")] = "newest",
    device: Literal["cpu", "cuda"] = "cpu",
    fps: float | None = None,
    port: int = 0,
    browser: bool = True,
) -> None:
    """Show rigs and their motion in the browser, and correct it there.

    A page of this machine: the clip plays on the source and on every target, by any method, with sliders for all
    shapes. Nothing leaves the machine. Ctrl-C ends it. docs/viewer.md tells what the page can do.

    Args:
        inputs: The folder that `reenact train` wrote, or rigs, the source first: built-in names or files.
        clip: Motion of the source; what the source's file holds unless said, or ten seconds that are made up.
        method: Shown first on the targets; the run's networks unless said, else what names tell, else shape-matching.
        audio: Sound that plays along.
        nudges: Where corrections are kept; RUN/nudges.json unless said, and nowhere without a run.
        from_: A rig of a run of a cast, by its name; the first unless said.
        to: Another; the second unless said.
        checkpoint: Of the run: the newest, also while it trains; the best by the held-out error of its saves, or that
            of a step.
        device: Where the run's networks look at pictures; cuda needs an NVIDIA GPU.
        fps: Frames per second to play at; those of the clip unless said.
        port: Of the page's address; any free one unless said.
        browser: Open the page.
    """
    if nudges is not None:
        _check_out(nudges, (".json",))
    from reenact.viewer.server import serve
    from reenact.viewer.session import Session

    with Console(stderr=True).status("Loading"):
        session = Session.open(inputs, clip, method, audio, nudges, fps, from_, to, checkpoint, device)
    if session.older is not None:
        print(f"{inputs[0]}: networks{of_step(session.older)}", flush=True)
    serve(session, port, browser)


def render(
    inputs: Annotated[Positional[tuple[str, ...]], arg(metavar="[RUN] CLIP", help_behavior_hint="")],
    *,
    out: Annotated[Path, arg(metavar="OUT")],
    rig: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="RIG", help_behavior_hint="(repeatable)")] = (),
    method: Annotated[str | None, arg(metavar="NAME")] = None,
    checkpoint: Annotated[str, arg(metavar="newest|best|STEP")] = "newest",
    device: Literal["cpu", "cuda"] = "cpu",
    size: int = 512,
    fps: float | None = None,
    audio: Annotated[Path | None, arg(metavar="FILE.wav")] = None,
    opengl: Annotated[bool, FlagCreatePairsOff] = False,
) -> None:
    """Write a film of a clip: an .mp4, a .gif or pictures of one or more rigs, side by side.

    Args:
        inputs: A clip; or the folder that `reenact train` wrote, with a clip of its source or ten seconds that are made
            up: the source and the target that follows.
        out: File to write, .mp4 or .gif, or a new folder for PNGs.
        rig: Who plays the clip, by the names of the shapes; again for another beside it. The rig in the clip's own file
            unless said.
        method: Retarget from the first rig to the others instead; with a run, in place of its networks.
        checkpoint: Of the run: the newest, the best by the held-out error of its saves, or that of a step.
        device: Where the run's networks look at pictures; cuda needs an NVIDIA GPU.
        size: Height and width of each rig in pixels.
        fps: Frames per second; those of the clip unless said.
        audio: Sound for the .mp4.
        opengl: Draw through pyrender, for large pictures.
    """
    if not 16 <= size <= 4096:
        raise ReenactError(f"--size: expected 16 to 4096 pixels, got {size}")
    from rich.progress import Progress

    from reenact.rigs.timeline import resampled
    from reenact.video import GIF_RATE, check_out, performances, save_video

    check_out(out, audio)
    console = Console(stderr=True)
    with console.status("Loading"):
        played = performances(inputs, rig, method, fps, checkpoint, device)
    if out.suffix.lower() == ".gif" and fps is None and played[0].clip.fps > GIF_RATE:
        print(f"{played[0].clip.fps:g} frames per second became 30: a .gif has at most {GIF_RATE}")
        played = [replace(each, clip=resampled(each.clip, 30.0)) for each in played]
    clip = played[0].clip
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("Drawing", total=len(clip))
        save_video(played, out, size, opengl, audio, lambda done: progress.update(task, completed=done))
    names = ", ".join(each.rig.name for each in played)
    print(f"{out}: {len(clip)} frames, {clip.duration:.1f} s, {names}{of_step(played[-1].older)}")


def convert(
    input: Annotated[Positional[str], arg(metavar="IN")],
    output: Annotated[Positional[Path], arg(metavar="OUT")],
    *,
    rig: Annotated[str | None, arg(metavar="RIG")] = None,
    parts: Annotated[tuple[str, ...], arg(metavar="NAME")] = (),
    shapes: Annotated[tuple[str, ...], arg(metavar="NAME")] = (),
    fps: float | None = None,
    post: PostConfig = PostConfig(),  # noqa: B008 - frozen
) -> None:
    """Turn a rig or a clip into another format.

    Rigs: built-in names, .glb, .gltf, .vrm, .fbx, USD, .npz, and folders of .obj files, to .glb, USD, .npz or a folder
    of .obj files; an animation in the file comes along where both formats hold one. Clips: see `reenact infer`.

    Args:
        input: A file, a built-in rig, or with --rig a clip.
        output: File to write, in the format of its suffix.
        rig: Read IN as a clip of this rig, a built-in name or a file: the clip gets its shapes, and in .glb, .vrm and
            USD its mesh. A .glb or .vrm rig is kept as it is, and animated.
        parts: Meshes of the rig to take, as names or patterns; what belongs to the face unless said.
        shapes: Blendshapes of the rig to take, as names or patterns; all unless said.
        fps: Frames per second of the clip.
        post: What to do to the clip.
    """
    check_config(Config(post=post), origin="command line")
    from reenact.postprocessing import postprocess
    from reenact.rigs.files import load_clip, load_rig, read_clip, save_clip
    from reenact.rigs.formats.pieces import Choice

    choice = Choice(parts, shapes)
    if rig is None and not _is_clip(input, output):
        _convert_rig(input, output, choice, fps, post)
        return
    _check_out(output, _CLIP_FILES)
    if rig is None and (input.startswith("synthetic:") or output.suffix.lower() in (".glb", ".vrm", *_USD_FILES)):
        raise ReenactError(f"{input}: expected --rig beside this clip, got none; name the rig that it moves")
    with _busy(f"Reading {input}"):
        moved = None if rig is None else load_rig(rig, choice)
        clip = read_clip(input) if moved is None else load_clip(input, moved)
    clip = postprocess(_at_rate(clip, fps), post)
    with _busy(f"Writing {output}"):
        save_clip(clip, output, moved, rig)
    print(f"{output}: {len(clip)} frames, {clip.duration:.1f} s, {len(clip.names)} blendshapes")


def inspect(
    file: Annotated[Positional[str], arg(metavar="FILE")],
    *,
    out: Annotated[Path | None, arg(metavar="FILE.png")] = None,
    json: Annotated[Path | None, arg(metavar="FILE.json")] = None,
    parts: Annotated[tuple[str, ...], arg(metavar="NAME")] = (),
    shapes: Annotated[tuple[str, ...], arg(metavar="NAME")] = (),
    size: int = 160,
) -> None:
    """Show what is inside a rig file, what was made of it, and what looks wrong.

    Prints meshes, shapes with their strength and region, animation, textures, and draws every shape at 1.

    Args:
        file: A rig: a built-in name or a file.
        out: The contact sheet; NAME-shapes.png in this folder unless said.
        json: Write the facts here too.
        parts: Meshes to take, as names or patterns; what belongs to the face unless said.
        shapes: Blendshapes to take, as names or patterns; all unless said.
        size: Height and width of each picture of the sheet, in pixels.
    """
    for path, suffix in ((out, ".png"), (json, ".json")):
        if path is not None:
            _check_out(path, (suffix,))
    if not 16 <= size <= 1024:
        raise ReenactError(f"--size: expected 16 to 1024 pixels, got {size}")
    from json import dumps

    from reenact.atomic import write_atomically
    from reenact.inspection import inspect, save_sheet
    from reenact.rigs.files import read_rig
    from reenact.rigs.formats.pieces import Choice

    with _busy(f"Reading {file}"):
        rig, contents = read_rig(file, Choice(parts, shapes))
        facts = inspect(rig, contents)
    console = Console(markup=False, emoji=False, highlight=False)
    for line in inspection_lines(facts):
        console.print(line, soft_wrap=True)
    if json is not None:
        write_atomically(json, dumps(facts.to_dict(), indent=1, ensure_ascii=False).encode())
    if facts.face is None:
        console.print("\nNo contact sheet: eyes and mouth were not found, so nothing can be framed")
        return
    sheet = out or Path(f"{_plain(rig.name)}-shapes.png")
    with console.status("Drawing") as status:
        save_sheet(rig, facts, sheet, size, lambda done: status.update(f"Drawing {done} of {len(rig.names) + 1}"))
    console.print(f"\nEvery shape at 1: {sheet}", soft_wrap=True)


def rigs(
    *,
    out: Annotated[Path | None, arg(metavar="FILE.png")] = None,
    size: int = 192,
) -> None:
    """List the built-in rigs, and draw them.

    Args:
        out: Write a contact sheet: a row per rig, its neutral first, then expressions.
        size: Height and width of each picture of the sheet, in pixels.
    """
    if out is not None:
        _check_out(out, (".png",))
    if not 16 <= size <= 1024:
        raise ReenactError(f"--size: expected 16 to 1024 pixels, got {size}")
    from reenact.rigs.anny import BUILT_IN

    console = Console(emoji=False)
    for name, description in BUILT_IN.items():
        console.print(f"[bold]{name:<12}[/bold] {description}", highlight=False, soft_wrap=True)
    if out is None:
        console.print("\nTo see them: reenact rigs --out rigs.png", highlight=False)
        return
    with console.status("Drawing"):
        from reenact.rig_sheet import draw_rigs

        draw_rigs(list(BUILT_IN), size, out)
    console.print(f"\nContact sheet: {out}", highlight=False, soft_wrap=True)


def doctor(*, json: Annotated[bool, FlagCreatePairsOff] = False) -> int:
    """Check the installation, and say what to do where something is missing or wrong.

    Versions, threads, the compiler, the renderer against a stored picture, the GPU, the disk here, the cache, optional
    extras. The exit status is 1 when something is wrong that is needed.

    Args:
        json: Print the findings as JSON.
    """
    from dataclasses import asdict
    from json import dumps

    from reenact.doctor import examine, healthy

    console = Console(markup=False, emoji=False, highlight=False)
    with Console(stderr=True).status("Looking; the first time the renderer is compiled, which takes a minute"):
        findings = examine(Path.cwd())
    if json:
        print(dumps([asdict(finding) for finding in findings], indent=1, ensure_ascii=False))
        return 0 if healthy(findings) else 1
    width = max(len(finding.name) for finding in findings)
    for finding in findings:
        color = {"ok": "green", "missing": "yellow" if not finding.needed else "red", "wrong": "red"}[finding.state]
        console.print(f"{finding.state:<7}", style=color, end="  ")
        console.print(f"{finding.name:<{width}}  {finding.found}", soft_wrap=True)
        if finding.remedy:
            console.print(f"{'':<{width + 11}}{finding.remedy}", soft_wrap=True)
    said = "All that is needed is there" if healthy(findings) else "Something that is needed is missing or wrong"
    console.print(f"\n{said}")
    return 0 if healthy(findings) else 1


COMMANDS = {
    "train": train,
    "add": add,
    "infer": infer,
    "batch": batch,
    "evaluate": evaluate,
    "view": view,
    "render": render,
    "convert": convert,
    "inspect": inspect,
    "rigs": rigs,
    "doctor": doctor,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; the exit status: 0 for success, 2 for the user's mistake, 130 for Ctrl-C.

    Anything else that goes wrong is our mistake: status 1, its traceback, and how to report it.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    console = Console(stderr=True, emoji=False)  # a message may hold ":x:"
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_: _say(console, "yellow", "warning", str(message))
        try:
            commands = {
                **COMMANDS,
                "train": partial(train, settings=_train_defaults(arguments)),
                "infer": partial(infer, post=_infer_defaults(arguments)),
            }
            with interruptions():
                status = subcommand_cli_from_dict(
                    commands,
                    prog="reenact",
                    description="Any two blendshape rigs and a clip for the first: returns the clip on the second.",
                    args=arguments,
                )
        except KeyboardInterrupt:
            with suppress(KeyboardInterrupt):  # who is impatient presses it twice
                _say(console, "red", "stopped", "by the keyboard")
            return 130
        except ReenactError as error:
            _say(console, "red", "error", str(error))
            return 2
        except BrokenPipeError:  # whoever read our words has gone, as `head` does
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is still buffered goes nowhere
            return 141  # what shells say of those that a closed pipe ends
        except OSError as error:  # a file that is missing or forbidden, a full disk
            where = f"{error.filename}: " if error.filename else ""
            remedy = _REMEDIES.get(error.errno or 0, "")
            _say(console, "red", "error", f"{where}{error.strerror}{remedy}" if error.strerror else str(error))
            return 2
        except MemoryError:
            words = "expected more memory than there is; take fewer vertices, shapes or frames, or smaller images"
            _say(console, "red", "error", f"{' '.join(arguments[:1])}: {words}")
            return 2
        except Exception:
            traceback.print_exc()
            _say(console, "red", "our mistake", _PLEA)
            return 1
    return status or 0


_REMEDIES = {
    errno.ENOSPC: "; free some space there (what was saved before is intact, and a training goes on with --resume)",
    errno.EDQUOT: "; free some space there (what was saved before is intact, and a training goes on with --resume)",
    errno.EACCES: "; name a place where you may read and write",
    errno.EPERM: "; name a place where you may read and write",
    errno.EROFS: "; name a place on a disk that can be written",
    errno.EIO: "; the disk or the network failed: what was saved before is intact, try again or elsewhere",
}
"""What to do, by number of the system's error."""

_PLEA = (
    "this is a fault in Reenact, not in what you gave it; please report it with the lines above, the command, and what "
    "`reenact doctor` prints. Nothing that was saved is lost"
)


def _say(console: Console, color: str, kind: str, message: str) -> None:
    with suppress(OSError):  # nobody is there any more
        console.print(f"[{color}]{kind}:[/{color}]", end=" ", highlight=False)
        console.print(message, markup=False, highlight=False, soft_wrap=True)  # a name may look like markup


def _train_defaults(arguments: list[str]) -> Config:
    """Where the settings of `train` start: the file in --config, or the stopped run that --resume goes on with."""
    if arguments[:1] != ["train"]:
        return Config()
    config, run = _option(arguments, "--config"), _option(arguments, "--run")
    if config is not None:
        return load_config(config)
    if run is not None and "--resume" in arguments:
        return load_run_config(run)
    return Config()


def _run_suite(
    rigs: tuple[str, ...],
    targets: tuple[str, ...],
    methods: tuple[str, ...],
    configs: tuple[Path, ...],
    frames: int,
    seeds: Sequence[int],
    take: Path | None,
    results: Path | None,
    keep: Path | None,
) -> None:
    from reenact.retargeting import METHODS
    from reenact.suite import TARGETS, run_suite, table, versions

    if results is not None:
        _check_out(results, (".jsonl",))
    pairs = [("anny:man", name) for name in targets or TARGETS if name != "none"]
    pairs += [pair for name in rigs for pair in (("anny:man", name), (name, "anny:man"))]
    console = Console(markup=False, emoji=False, highlight=False)
    with console.status("") as status:
        cells = run_suite(
            pairs,
            tuple(name for name in methods or tuple(METHODS) if name != "none"),
            frames,
            tuple(seeds),
            say=status.update,
            configs={path.stem: load_config(path) for path in configs},
            take=None if take is None else str(take),
            results=results,
            runs=keep,
        )
    for key in _SUITE_NUMBERS:
        console.print(f"\n{table(cells, key)}", soft_wrap=True)
    console.print(f"\n{versions(cells)}", soft_wrap=True)
    for cell in cells:
        if cell.failed:
            console.print(f"{cell.method}: {cell.failed}", soft_wrap=True)


_SUITE_NUMBERS = (
    *("ver", "ver_mouth", "ver_eyes", "ver_brows", "wmae", "correlation", "gain", "jitter"),
    *("lips.contact_f1", "lids.blink_f1", "single.right", "single.elsewhere", "take.ver", "take.jitter"),
    *("cyclic.mae", "cyclic.ssim", "cyclic.skill", "cyclic.skill_masked"),
)
"""Tables that a suite prints; see `reenact.suite.measure`."""


def _busy(words: str) -> Any:
    """Says what takes a while, on a terminal, and takes it back."""
    return Console(stderr=True, markup=False, emoji=False).status(words)


def _moved(retargeter: Any, clip: str) -> Clip:
    from reenact.rigs.files import load_clip

    with _busy("Retargeting"):
        return retargeter(load_clip(clip, retargeter.source))


def _moved_by_networks(retargeter: Any, clip: str) -> Clip:
    """As `_moved`, with a bar: networks look at each frame by itself."""
    from rich.progress import track

    from reenact.rigs.files import load_clip

    console = Console(stderr=True)
    bar = partial(track, description="Retargeting", console=console, transient=True, disable=not console.is_terminal)
    return retargeter(load_clip(clip, retargeter.source), bar)


def _geometric(
    inputs: tuple[str, ...],
    method: str,
    source: str | None,
    target: str | None,
    pairs: Path | None,
    training: str | None,
    reverse: bool,
    named: tuple[str | None, str | None],
) -> tuple[Clip, Any, list[str]]:
    """A clip moved by a geometric method, the retargeter, and where the two rigs came from."""
    from reenact.retargeting import METHODS
    from reenact.retargeting.correspondence import find_correspondence, load_correspondence
    from reenact.rigs.files import load_clip, load_rig
    from reenact.run import Run

    rigs: list[Rig] = []
    if method not in METHODS:
        raise ReenactError(f"--method: expected one of {', '.join(METHODS)}, got {method}")
    if len(inputs) == 2:
        if source is not None or target is not None:
            raise ReenactError("infer: expected either a RUN or --source and --target, got both")
        run = Run.open(inputs[0])
        origins, keys = dict(zip(run.keys, run.config.rigs)), run.pair(*named)
        source, target = (origins[key] for key in keys)
        rigs = [run.rigs[key] for key in keys]
    elif named != (None, None):
        raise ReenactError("infer: expected a RUN beside --from and --to, got none; name rigs by --source and --target")
    if len(inputs) not in (1, 2) or target is None:
        raise ReenactError(
            f"infer: expected CLIP with --source and --target, or RUN and CLIP, beside --method; got "
            f"{len(inputs)} arguments, --source {source or 'not given'}, --target {target or 'not given'}"
        )
    if source is None:
        return _captured(inputs[-1], method, target, pairs, training)
    names = [source, target]
    with _busy("Reading the rigs"):
        rigs = rigs or [load_rig(name) for name in names]
    if reverse:
        names, rigs = names[::-1], rigs[::-1]
    found = None
    if method not in ("copy", "neutral"):
        with _busy("Finding the correspondence"):
            found = find_correspondence(*rigs, 300) if pairs is None else load_correspondence(pairs, *rigs)
    with _busy(f"Preparing {method}"):
        shown = None if training is None else load_clip(training, rigs[0])
        retargeter = METHODS[method](*rigs, found, shown)
    return _moved(retargeter, inputs[-1]), retargeter, names


def _captured(
    take: str, method: str, target: str, places: Path | None, training: str | None
) -> tuple[Clip, Any, list[str]]:
    """A clip from markers, with what stands for a retargeter: the names to print."""
    from types import SimpleNamespace

    from reenact.retargeting.capture import drive, load_places
    from reenact.retargeting.markers import load_markers
    from reenact.rigs.files import load_rig

    presets = {"ribera-paper": "paper", "ribera-robust": "robust", "quantile": "quantile", "residual": "residual"}
    if method not in presets:
        raise ReenactError(f"--method: expected one of {', '.join(presets)} for markers without --source, got {method}")
    if places is None:
        raise ReenactError("infer: expected --correspondence beside markers, a .csv of marker and vertex; got none")
    rig = load_rig(target)
    names, vertices = load_places(places, rig)
    shown = None if training is None else load_markers(training)
    with _busy("Retargeting"):
        clip = drive(rig, load_markers(take), names, vertices, presets[method], shown)
    return clip, SimpleNamespace(source=SimpleNamespace(name=f"{len(names)} markers"), target=rig), [take, target]


def _check_unchosen(command: str, checkpoint: str, what: str, given: str) -> None:
    """Refuse a checkpoint where there is nothing that it is of."""
    if checkpoint != "newest":
        raise ReenactError(f"{command}: expected {what} beside --checkpoint, got {given}; leave one of them out")


def _infer_defaults(arguments: list[str]) -> PostConfig:
    """Where the post-processing of `infer` starts: as the run's settings say."""
    if arguments[:1] != ["infer"]:
        return PostConfig()
    runs = [argument for argument in arguments[1:] if (Path(argument) / "config.toml").is_file()]
    return load_run_config(runs[0]).post if runs else PostConfig()


def _option(arguments: list[str], name: str) -> str | None:
    """The value of an option, before the settings that it chooses can be parsed with the rest."""
    for index, argument in enumerate(arguments):
        if argument == name and index + 1 < len(arguments):
            return arguments[index + 1]
        if argument.startswith(f"{name}="):
            return argument.removeprefix(f"{name}=")
    return None


def _is_clip(input: str, output: Path) -> bool:
    """Whether a conversion is of a clip; a file that may hold both is a rig unless its clip is asked for."""
    from reenact.rigs.formats import npz

    path = Path(input)
    if path.suffix.lower() == ".npz" and path.is_file():
        return "weights" in npz.contents(path)
    tables = (".csv", ".json", ".py")
    return path.suffix.lower() in tables or output.suffix.lower() in tables or input.startswith("synthetic:")


def _convert_rig(input: str, output: Path, choice: Choice, fps: float | None, post: PostConfig) -> None:
    """A rig, with the animation that its file has where the other format holds one."""
    from reenact.postprocessing import postprocess
    from reenact.rigs.files import load_clip, read_rig, save_rig

    folder = output.suffix == "" and output.parent.is_dir()
    if not folder:
        _check_out(output, _RIG_FILES)
    with _busy(f"Reading {input}"):
        rig, contents = read_rig(input, choice)
    clip = None
    if contents.animations and output.suffix.lower() in (".glb", *_USD_FILES):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a still shape or a choice of shapes is no news here
            try:
                clip = postprocess(_at_rate(load_clip(input, rig), fps), post)
            except ReenactError:
                clip = None  # an animation of bones only
    with _busy(f"Writing {output}"):
        save_rig(rig, output.with_suffix(".obj") if folder else output, clip)
    motion = f", {len(clip)} frames at {clip.fps:g} fps" if clip is not None else ""
    print(f"{output}: {len(rig.neutral)} vertices, {len(rig.faces)} faces, {len(rig.names)} blendshapes{motion}")


def _at_rate(clip: Clip, fps: float | None) -> Clip:
    """The clip at the rate that was asked for, and a word about it."""
    if fps is None or fps == clip.fps:
        return clip
    from reenact.rigs.timeline import resampled

    made = resampled(clip, fps)
    print(f"{len(clip)} frames at {clip.fps:g} fps became {len(made)} at {fps:g}")
    return made


def _plain(name: str) -> str:
    """A name that can begin a file name."""
    return "".join(each if each.isalnum() or each in "-_." else "-" for each in name)[:80] or "rig"


def _check_out(path: Path, suffixes: tuple[str, ...]) -> None:
    """Refuse a file that cannot be written, before the work whose result it should hold."""
    if path.suffix.lower() not in suffixes:
        raise ReenactError(
            f"{path}: expected a name that ends in {' or '.join(suffixes)}, got {path.suffix or 'no suffix'}"
        )
    if path.is_dir():
        raise ReenactError(f"{path}: expected a file to write, got a folder; name a file in it")
    if not path.parent.is_dir():
        raise MissingError(f"{path}: the folder {path.parent} does not exist; make it first")


if __name__ == "__main__":
    sys.exit(main())
