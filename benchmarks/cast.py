"""A cast against dedicated pairs at equal steps per rig, and what one more rig costs.

python benchmarks/cast.py FOLDER [--cast RIG ...] [--added RIG] [--steps N] [--frames N] [--seed S] [--threads N]

Trains a cast, a pair of its first rig with each of the others, and the cast with one rig more, all with the same steps,
and measures the vertex error ratio (`reenact.evaluation`) on the same unseen clips. Runs are kept in FOLDER, numbers in
FOLDER/results.jsonl; what is there is not made again. Seconds are those of the wall: on a machine that others use, read
the processor's seconds beside them.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from reenact.config import BPNetConfig, Config, ImageConfig, ReenactNetConfig, TrainingConfig
from reenact.errors import ReenactError
from reenact.inference import ImageRetargeter
from reenact.metrics import vertex_error_ratio
from reenact.suite import Trial
from reenact.training import train


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument(
        "--cast", nargs="+", default=["anny:man", "anny:woman", "anny:child", "anny:toon", "anny:merged"]
    )
    parser.add_argument("--added", default="anny:units")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--frames", type=int, default=300, help="unseen ones that are measured")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    first, *others = arguments.cast
    settings = Config(
        images=ImageConfig(supersample=1),
        reenactnet=ReenactNetConfig(components=256, width=256, code=128, color_components=64),
        bpnet=BPNetConfig(hidden=256),
        training=TrainingConfig(
            steps=arguments.steps,
            batch_size=32,
            frames=1536,
            refresh=0,
            seed=arguments.seed,
            threads=arguments.threads,
            save_every=10**6,
        ),
    )
    book = Book(arguments.folder / "results.jsonl")
    whole = replace(settings, cast=tuple(arguments.cast))
    book.train("cast", whole, arguments)
    for other in others:
        book.measure("cast", first, other, arguments)
        book.train(f"pair-{other}", replace(settings, source=first, target=other), arguments)
        book.measure(f"pair-{other}", first, other, arguments)
    if len(others) > 2:
        book.measure("cast", others[0], others[-2], arguments)
    grown = replace(whole, cast=(*arguments.cast, arguments.added), base=str(arguments.folder / "cast"))
    book.train("cast-and-one", grown, arguments)
    book.measure("cast-and-one", first, arguments.added, arguments)
    book.measure("cast-and-one", arguments.added, first, arguments)
    book.train("pair-added", replace(settings, source=first, target=arguments.added), arguments)
    book.measure("pair-added", first, arguments.added, arguments)
    book.measure("pair-added", arguments.added, first, arguments)


class Book:
    """What was found, one line each, on disk at once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        lines = path.read_text().splitlines() if path.exists() else []
        self.known = {tuple(line["what"]) for line in map(json.loads, lines)}

    def train(self, name: str, config: Config, arguments: argparse.Namespace) -> None:
        def run() -> dict[str, float]:
            folder = arguments.folder / name
            wall, processor = time.perf_counter(), time.process_time()
            train(replace(config, run=str(folder)), resume=(folder / "config.toml").exists())
            return {"seconds": time.perf_counter() - wall, "processor_seconds": time.process_time() - processor}

        self._once(["train", name], run)

    def measure(self, name: str, source: str, target: str, arguments: argparse.Namespace) -> None:
        def run() -> dict[str, float | None]:
            moving = ImageRetargeter.load(arguments.folder / name, source=source, target=target)
            try:
                trial = Trial.of(moving.source, moving.target, arguments.frames, arguments.seed)
            except ReenactError:  # no shared names: nobody knows what is right
                return {"ver": None}
            moved = torch.cat([moving(clip).weights for clip in trial.clips.values()])
            return {"ver": vertex_error_ratio(moving.target, moved, trial.truth)}

        self._once(["ver", name, source, target], run)

    def _once(self, what: list[str], make: Callable[[], dict[str, float | None]]) -> None:
        if tuple(what) in self.known:
            return
        line = {"what": what, **make()}
        print(line, flush=True)
        with self.path.open("a") as file:
            file.write(json.dumps(line) + "\n")


if __name__ == "__main__":
    main()
