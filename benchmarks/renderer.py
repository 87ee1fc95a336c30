"""How fast the renderer is, and how true its gradients are.

A head-like geodesic mesh with 52 blendshapes, vertex colours and a point light; 16 expressions in a batch. Prints two
tables; `--json FILE` writes `ours["10k/128"].forward_ms` and `.forward_backward_ms` (medians, milliseconds a frame) and
`gradient["10k"].cosine` and `.relative_error`: the gradient of a smooth picture loss for the weights, against central
differences of a picture made from 8 x 8 samples a pixel.

    python benchmarks/renderer.py [--json FILE] [--sizes 5k 10k 26k] [--pixels 64 128 256] [--threads N]
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import statistics
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch starts: its idle threads would spin on our cores
sys.path.insert(0, str(Path(__file__).parents[1]))

import torch
from torch import Tensor

from render import Camera, Light, render
from render.shade import linear_from_srgb, srgb_from_linear

FREQUENCIES = {"5k": 22, "10k": 32, "26k": 51, "41k": 64}  # 10 n^2 + 2 vertices
BATCH = 16


def geodesic_sphere(frequency: int) -> tuple[Tensor, Tensor]:
    """Unit vertices (10 n^2 + 2, 3) and faces (20 n^2, 3) of an icosahedron whose edges are cut into n."""
    golden = (1 + 5**0.5) / 2
    corners = [(0, s, t * golden) for s, t in itertools.product((-1, 1), repeat=2)]
    corners = torch.tensor([c[i:] + c[:i] for c in corners for i in range(3)], dtype=torch.float64)
    distances = torch.cdist(corners, corners)
    points, faces = [], []
    for a, b, c in itertools.combinations(range(12), 3):
        if max(distances[a, b], distances[b, c], distances[a, c]) > 2.01:
            continue
        if torch.linalg.det(corners[[a, b, c]]) < 0:
            b, c = c, b
        index = {}
        for i, j in itertools.product(range(frequency + 1), repeat=2):
            if i + j <= frequency:
                index[i, j] = len(points)
                points.append(((frequency - i - j) * corners[a] + i * corners[b] + j * corners[c]) / frequency)
        for i, j in itertools.product(range(frequency), repeat=2):
            if i + j < frequency:
                faces.append((index[i, j], index[i + 1, j], index[i, j + 1]))
            if i + j < frequency - 1:
                faces.append((index[i + 1, j], index[i + 1, j + 1], index[i, j + 1]))
    vertices = torch.stack(points)
    # Neighbouring big faces share their border.
    _, first, merged = _unique_rows((vertices * 1e6).round().long())
    return torch.nn.functional.normalize(vertices[first], dim=-1), merged[torch.tensor(faces)]


def _unique_rows(rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    unique, inverse = rows.unique(dim=0, return_inverse=True)
    first = torch.full((len(unique),), len(rows)).scatter_reduce(0, inverse, torch.arange(len(rows)), "amin")
    return unique, first, inverse


class Head:
    """A mesh with a nose, brows, cheeks and lips of sorts, and 52 bumps as blendshapes."""

    def __init__(self, frequency: int, dtype: torch.dtype = torch.float32, seed: int = 0) -> None:
        generator = torch.Generator().manual_seed(seed)
        sphere, self.faces = geodesic_sphere(frequency)
        bumps = [(0, 0, 0.14, 0.25), (0, -0.35, 0.08, 0.4), (0.35, 0.3, -0.06, 0.2), (-0.35, 0.3, -0.06, 0.2)]
        bumps += [(0, 0.5, 0.05, 0.3), (0, -0.75, 0.08, 0.3), (0.9, 0, 0.25, 0.15), (-0.9, 0, 0.25, 0.15)]
        radius = torch.ones(len(sphere), dtype=torch.float64)
        for x, y, height, width in bumps:
            radius += height * torch.exp(-self._squared_distance(sphere, x, y) / width**2)
        neutral = sphere * radius[:, None] * torch.tensor([0.075, 0.105, 0.09], dtype=torch.float64)
        deltas = []
        for _ in range(52):
            x, y, width = (torch.rand(3, generator=generator) * torch.tensor([1.8, 1.8, 0.3])).tolist()
            direction = torch.randn(3, generator=generator).double()
            profile = torch.exp(-self._squared_distance(sphere, x - 0.9, y - 0.9) / (0.2 + width) ** 2)
            deltas.append(0.012 * profile[:, None] * direction / direction.norm())
        x, y, z = sphere.unbind(-1)
        colors = torch.stack([0.7 + 0.15 * torch.sin(5 * x), 0.5 + 0.15 * torch.sin(4 * y + 1), 0.45 + 0.15 * z], -1)
        self.neutral, self.deltas, self.colors = neutral.to(dtype), torch.stack(deltas).to(dtype), colors.to(dtype)
        self.camera = Camera.look_at(torch.tensor([0.01, 0.02, 0.8]), torch.tensor([0.0, 0.0, 0.0]), 7.2)
        self.light = Light(torch.tensor([0.3, 0.5, 0.9]), ambient=0.3, diffuse=0.55, specular=0.08, shininess=12.0)

    @staticmethod
    def _squared_distance(sphere: Tensor, x: float, y: float) -> Tensor:
        z = max(1 - x * x - y * y, 0.0) ** 0.5
        return ((sphere - torch.tensor([x, y, z], dtype=sphere.dtype)) ** 2).sum(-1)

    def vertices(self, weights: Tensor) -> Tensor:
        """(B, 52) weights -> (B, V, 3)."""
        return self.neutral + (weights @ self.deltas.flatten(1)).unflatten(-1, (-1, 3))

    def render(self, weights: Tensor, pixels: int, buffers: tuple[str, ...] = ("color", "mask")) -> dict[str, Tensor]:
        """Square pictures of expressions on grey."""
        return render(
            self.vertices(weights), self.faces, self.camera, self.light, height=pixels, width=pixels,
            colors=self.colors, background=(0.2, 0.25, 0.35), buffers=buffers,
        )  # fmt: skip

    def render_supersampled(self, weights: Tensor, pixels: int, samples: int = 8) -> Tensor:
        """(B, 3, pixels, pixels): the mean light of samples x samples points in each pixel, in sRGB."""
        fine = self.render(weights, pixels * samples, ("color",))["color"]
        return srgb_from_linear(torch.nn.functional.avg_pool2d(linear_from_srgb(fine), samples))


def gradient_accuracy(
    head: Head, pixels: int, step: float = 0.02, seed: int = 1, shapes: int = 52, samples: int = 8
) -> tuple[float, float]:
    """Cosine and relative error of the gradient for the weights of a smooth loss, against central differences."""
    generator = torch.Generator().manual_seed(seed)
    draw = torch.rand(2, 52, generator=generator) * (torch.rand(2, 52, generator=generator) < 0.3)
    draw = draw.to(head.neutral.dtype)
    target = _smooth(head.render_supersampled(draw[1:], pixels, samples))

    def loss(picture: Tensor) -> Tensor:
        return ((_smooth(picture) - target) ** 2).flatten(1).sum(1)

    weights = draw[:1].clone().requires_grad_()
    loss(head.render(weights, pixels)["color"]).sum().backward()
    analytic = weights.grad[0, :shapes]
    numeric = torch.zeros_like(analytic)
    for k in range(shapes):
        offset = torch.nn.functional.one_hot(torch.tensor(k), 52) * step
        after, before = (loss(head.render_supersampled(draw[:1] + sign * offset, pixels, samples)) for sign in (1, -1))
        numeric[k] = (after - before).item() / (2 * step)
    cosine = torch.nn.functional.cosine_similarity(analytic, numeric, dim=0).item()
    return cosine, ((analytic - numeric).norm() / numeric.norm()).item()


def _smooth(picture: Tensor) -> Tensor:
    return torch.nn.functional.avg_pool2d(torch.nn.functional.avg_pool2d(picture, 5, 1), 5, 1)


def time_ms(head: Head, pixels: int, repeats: int = 15) -> tuple[float, float]:
    """Median milliseconds a frame, forward and forward + backward to the vertices, batch of 16."""
    weights = torch.rand(BATCH, 52, generator=torch.Generator().manual_seed(0)) * 0.5
    vertices = head.vertices(weights)
    picture_gradient = torch.randn(BATCH, 3, pixels, pixels, generator=torch.Generator().manual_seed(0))
    forward, both = [], []
    for repeat in range(repeats + 2):
        vertices = vertices.detach().requires_grad_()
        start = time.perf_counter()
        color = render(
            vertices, head.faces, head.camera, head.light, height=pixels, width=pixels, colors=head.colors,
        )["color"]  # fmt: skip
        middle = time.perf_counter()
        color.backward(picture_gradient)
        if repeat >= 2:
            forward.append(middle - start)
            both.append(time.perf_counter() - start)
    return tuple(statistics.median(times) * 1000 / BATCH for times in (forward, both))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write the numbers there")
    parser.add_argument("--sizes", nargs="+", choices=FREQUENCIES, default=["5k", "10k", "26k"])
    parser.add_argument("--pixels", nargs="+", type=int, default=[64, 128, 256])
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    results = {"threads": arguments.threads, "batch": BATCH, "ours": {}, "gradient": {}}
    heads = {size: Head(FREQUENCIES[size]) for size in arguments.sizes}
    start = time.perf_counter()
    first = next(iter(heads.values()))
    first.render(torch.zeros(1, 52, requires_grad=True), 16)["color"].sum().backward()
    results["first_call_s"] = time.perf_counter() - start
    print(f"{arguments.threads} threads, batch {BATCH}; first call {results['first_call_s']:.1f} s")
    print("size / pixels   forward  forward + backward  (ms a frame)")
    for size, head in heads.items():
        for pixels in arguments.pixels:
            forward, both = time_ms(head, pixels)
            results["ours"][f"{size}/{pixels}"] = {"forward_ms": forward, "forward_backward_ms": both}
            print(f"{size + ' / ' + str(pixels):15s} {forward:7.3f}  {both:18.3f}", flush=True)
    print("gradient for 52 weights against 8 x 8 supersampled differences, 128 pixels")
    for size, head in heads.items():
        cosine, error = gradient_accuracy(head, 128)
        results["gradient"][size] = {"cosine": cosine, "relative_error": error}
        print(f"{size:15s} cosine {cosine:.4f}  relative error {error:.3f}", flush=True)
    if arguments.json:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
