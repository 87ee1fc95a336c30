"""Peak memory and time of a short training against vertices, shapes, resolution and batch.

python benchmarks/memory.py [--json FILE] [--method pictures|geometry|none] [--default-networks] [--only NAME=VALUE ...]

Each case is a process of its own, that trains a made-up head and the same head stretched, for a few steps with all
that a training does; its peak is what the system says (resident set, of Python and PyTorch 0.5 GiB). One setting at a
time leaves the base case; the slope is that of the line through its cases. --only measures one case instead.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

BASE = {"vertices": 10_000, "shapes": 50, "resolution": 64, "batch": 32}
SERIES = {
    "vertices": (2_500, 10_000, 40_000, 100_000),
    "shapes": (25, 50, 150, 300),
    "resolution": (64, 128, 256),
    "batch": (8, 32, 128),
}
UNITS = {"vertices": (10_000, "10,000 vertices"), "shapes": (100, "100 shapes")}
LARGE = {"vertices": 100_000, "shapes": 300, "resolution": 64, "batch": 32}
"""What has to train in 24 GiB."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path)
    parser.add_argument(
        "--method", default="pictures", help="who teaches; registration (geometry) adds minutes to a case"
    )
    parser.add_argument("--default-networks", action="store_true", help="as large as in a real training")
    parser.add_argument("--only", nargs="*", metavar="NAME=VALUE")
    parser.add_argument("--child", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        print(json.dumps(trained(json.loads(arguments.child), arguments.method, arguments.default_networks)))
        return
    if arguments.only is not None:
        chosen = dict(part.split("=") for part in arguments.only)
        cases = [("only", BASE | {name: int(value) for name, value in chosen.items()})]
    else:
        cases = [(name, BASE | {name: value}) for name, values in SERIES.items() for value in values]
        cases.append(("large", LARGE))
    found = []
    for name, case in cases:
        found.append({"series": name, **case, **measured(case, arguments.method, arguments.default_networks)})
        print(json.dumps(found[-1]), flush=True)
        if arguments.json:
            arguments.json.write_text(json.dumps(found, indent=1) + "\n")
    print()
    for line in table(found):
        print(line)


def measured(case: dict[str, int], method: str, large: bool) -> dict[str, float | str]:
    """What a process of its own says; "failed" where it died."""
    command = [sys.executable, __file__, "--child", json.dumps(case), "--method", method]
    command += ["--default-networks"] * large
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        return {"failed": (done.stderr.strip().splitlines() or [f"status {done.returncode}"])[-1]}
    return json.loads(done.stdout.splitlines()[-1])


def trained(case: dict[str, int], method: str, large: bool) -> dict[str, float]:
    """Peak (GiB) and seconds of one case, in this process; `large` networks are the default ones."""
    from reenact.config import BPNetConfig, Config, ImageConfig, PairsConfig, ReenactNetConfig, TrainingConfig
    from reenact.rigs.files import save_rig
    from reenact.training import train

    steps = 20
    reenactnet = ReenactNetConfig(components=64, color_components=32, width=128, code=64)
    bpnet = BPNetConfig(hidden=128, image_from=0.5)
    frames = 256
    if large:
        reenactnet, bpnet, frames = ReenactNetConfig(), BPNetConfig(image_from=0.5), 1024
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{name}.npz" for name in ("one", "other")]
        for path, stretch in zip(paths, (1.0, 1.2)):
            save_rig(head(path.stem, case["vertices"], case["shapes"], stretch), path)
        config = Config(
            source=str(paths[0]),
            target=str(paths[1]),
            run=f"{folder}/run",
            images=ImageConfig(resolution=case["resolution"], supersample=1),
            pairs=PairsConfig(method=method),
            reenactnet=reenactnet,
            bpnet=bpnet,
            training=TrainingConfig(
                steps=steps, batch_size=case["batch"], frames=frames, refresh=0, save_every=steps, threads=1
            ),
        )
        started = time.perf_counter()
        train(config)
        seconds = time.perf_counter() - started
        lines = (Path(folder) / "run" / "metrics.jsonl").read_text().splitlines()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # Linux counts in KiB
    rate = json.loads(lines[-1])["steps_per_second"]
    return {"peak_gib": round(peak, 3), "seconds": round(seconds, 1), "step_ms": round(1000 / rate, 1)}


def head(name: str, vertices: int, shapes: int, stretch: float):
    """A ball of about as many vertices in rings, whose shapes are bumps around eyes and mouth."""
    import numpy as np
    import torch

    from reenact.rigs.rig import Rig

    rings = max(8, round((vertices / 2) ** 0.5))
    around = max(8, vertices // rings)
    polar, turn = np.meshgrid(
        np.linspace(0.05, np.pi - 0.05, rings), np.arange(around) * 2 * np.pi / around, indexing="ij"
    )
    points = np.stack([np.sin(polar) * np.sin(turn), np.cos(polar), np.sin(polar) * np.cos(turn)], -1).reshape(-1, 3)
    ring, side = np.meshgrid(np.arange(rings - 1), np.arange(around), indexing="ij")
    here, beside = ring * around + side, ring * around + (side + 1) % around
    faces = np.concatenate(
        [np.stack([here, here + around, beside], -1), np.stack([beside, here + around, beside + around], -1)]
    ).reshape(-1, 3)
    random = np.random.default_rng(0)
    deltas = np.empty((shapes, len(points), 3), np.float32)
    size = np.array([0.1, 0.1 * stretch, 0.1])
    for index in range(shapes):
        upper = index % 2
        place = np.array([random.uniform(-0.5, 0.5), 0.4 if upper else -0.45, 0.8]) + random.normal(0, 0.05, 3)
        bump = np.exp(-np.square(points - place).sum(1, keepdims=True) / random.uniform(0.01, 0.05))
        deltas[index] = bump * random.normal(0, 0.1, 3) * size
    names = tuple(f"{('mouth', 'eyeBlink')[index % 2]}{index}" for index in range(shapes))
    tensors = [torch.tensor(each, dtype=torch.float32) for each in (points * size, deltas)]
    return Rig(name, tensors[0], tensors[1], names, torch.tensor(faces))


def table(found: list[dict]) -> list[str]:
    """Markdown: a row a case, and the slope of each series."""
    import numpy as np

    lines = ["| vertices | shapes | resolution | batch | peak | whole run | a step |", "|---|---|---|---|---|---|---|"]
    for row in found:
        case = " | ".join(f"{row[name]:,}" for name in BASE)
        numbers = row.get("failed") or f"{row['peak_gib']:.2f} GiB | {row['seconds']:.0f} s | {row['step_ms']:.0f} ms"
        lines.append(f"| {case} | {numbers} |")
    lines += ["", "| for each | memory | a step |", "|---|---|---|"]
    for name in SERIES:
        rows = [row for row in found if row["series"] == name and "failed" not in row]
        if len(rows) < 2:
            continue
        unit, words = UNITS.get(name, (1, "picture of a batch"))
        x = np.array([row[name] for row in rows], float)
        if name == "resolution":
            x, unit, words = x**2, 64**2, "64 x 64 pixels of a picture"
        memory, step = (np.polyfit(x / unit, [row[key] for row in rows], 1)[0] for key in ("peak_gib", "step_ms"))
        lines.append(f"| {words} | {1024 * memory:.0f} MiB | {step:.1f} ms |")
    return lines


if __name__ == "__main__":
    main()
