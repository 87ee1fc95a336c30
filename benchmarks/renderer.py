"""How fast the renderer is beside its peers, and how true its gradients are.

A head-like geodesic mesh with 52 blendshapes, vertex colours and a point light; 16 expressions in a batch. `--json
FILE` writes what the tables say:

    ours["10k/128"].forward_ms, .forward_backward_ms    medians, milliseconds a frame
    slopes.vertices, .pixels, .batch                    exponents: 1 is twice the time for twice as many
    peers["10k/128"].NAME                               the same numbers of others, or a sentence why there are none
    gradient["10k"].cosine, .relative_error             of 52 weights, 128 pixels; "10k/64" and so on for other sizes
    gradient["camera"], ["light"], ["texture"]          5k vertices, 128 pixels
    face["eyes + lips x4"]                              anny:man, drawn 1, 2, 4 times as large and averaged

A gradient of a smooth picture loss is held against central differences of a picture made from 8 x 8 samples a pixel;
means over `--seeds` expressions.

    python benchmarks/renderer.py [--json FILE] [--sizes 5k 10k 26k] [--pixels 64 128 256] [--threads N] [--seeds N]
                                  [--skip speed|peers|gradient|face ...]
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import statistics
import sys
import time
from collections.abc import Callable
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


def supersampled(picture: Tensor, samples: int) -> Tensor:
    """The mean light of samples x samples points of an sRGB picture (B, 3, H, W) as one, in sRGB."""
    return srgb_from_linear(torch.nn.functional.avg_pool2d(linear_from_srgb(picture), samples))


def agreement(analytic: Tensor, numeric: Tensor) -> dict[str, float]:
    """Cosine and relative error of a gradient against another, both flat."""
    cosine = torch.nn.functional.cosine_similarity(analytic, numeric, dim=0).item()
    return {"cosine": cosine, "relative_error": ((analytic - numeric).norm() / numeric.norm()).item()}


def compare(
    draw: Callable[[Tensor, int], Tensor],
    point: Tensor,
    steps: Tensor,
    target: Tensor,
    pixels: int,
    samples: int = 8,
    internal: int = 1,
    region: Tensor | None = None,
) -> dict[str, float]:
    """Cosine and relative error of the gradient of a smooth loss, against central differences.

    Args:
        draw: Numbers (N,) and a size in pixels -> sRGB picture (1, 3, size, size).
        point: Where the gradient is taken, (N,).
        steps: Of the differences, one for each number; numbers with a step of 0 are left out.
        target: Numbers that make the picture from which the loss counts.
        pixels: Height and width of the pictures that are compared.
        samples: Of the picture for the differences, along each side of a pixel.
        internal: The same of the picture that is differentiated.
        region: Where the loss counts, (pixels, pixels).
    """
    goal = _smooth(supersampled(draw(target, pixels * samples), samples))
    counts = 1.0 if region is None else region[4:-4, 4:-4]

    def loss(numbers: Tensor, factor: int) -> Tensor:
        picture = draw(numbers, pixels * factor)
        return (counts * (_smooth(supersampled(picture, factor) if factor > 1 else picture) - goal) ** 2).sum()

    leaf = point.clone().requires_grad_()
    (analytic,) = torch.autograd.grad(loss(leaf, internal), leaf)
    moved = steps.nonzero()[:, 0]
    numeric = torch.zeros(len(moved))
    with torch.no_grad():
        for place, n in enumerate(moved.tolist()):
            offset = torch.zeros_like(point)
            offset[n] = steps[n]
            after, before = (loss(point + sign * offset, samples) for sign in (1, -1))
            numeric[place] = (after - before) / (2 * steps[n])
    scale = steps[moved]  # numbers of different units count by what a step of each does
    return agreement(analytic[moved] * scale, numeric * scale)


def gradient_accuracy(
    head: Head, pixels: int, step: float = 0.02, seed: int = 1, shapes: int = 52, samples: int = 8
) -> tuple[float, float]:
    """Cosine and relative error of the gradient for the weights of a smooth loss, against central differences."""
    point, target = _expressions(seed)
    steps = torch.where(torch.arange(52) < shapes, step, 0.0)
    found = compare(lambda w, size: head.render(w[None], size)["color"], point, steps, target, pixels, samples)
    return found["cosine"], found["relative_error"]


def _expressions(seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(2, 52, generator=generator) * (torch.rand(2, 52, generator=generator) < 0.3)


def scene_accuracy(head: Head, pixels: int, kind: str, seed: int) -> dict[str, float]:
    """The same for camera (matrix and focal length), light (position and coefficients) or 12 places of a texture."""
    generator = torch.Generator().manual_seed(seed)
    vertices = head.vertices(_expressions(seed)[:1])
    camera, light = head.camera, head.light
    arguments = {"colors": head.colors, "background": (0.2, 0.25, 0.35)}
    if kind == "camera":
        point = torch.cat([camera.world_to_camera.flatten(), torch.tensor([camera.focal])])
        # About a tenth of a pixel each: rotation and shear act at 0.1 m from the middle, distances at 0.8 m.
        steps = torch.tensor([0.002, 0.002, 0.002, 0.0002] * 2 + [0.002, 0.002, 0.002, 0.001] + [0.01])

        def draw(numbers: Tensor, size: int) -> Tensor:
            moved = Camera(numbers[:12].view(3, 4), numbers[12])
            return render(vertices, head.faces, moved, light, height=size, width=size, **arguments)["color"]
    elif kind == "light":
        point = torch.cat([light.position, light.coefficients])
        steps = torch.tensor([0.02, 0.02, 0.02, 0.01, 0.01, 0.01, 0.5])

        def draw(numbers: Tensor, size: int) -> Tensor:
            lit = Light(numbers[:3], *numbers[3:])
            return render(vertices, head.faces, camera, lit, height=size, width=size, **arguments)["color"]
    else:
        # White noise for each texel, which is what a renderer without mip maps draws wrong; brighter in round places.
        x, y, _ = torch.nn.functional.normalize(head.neutral, dim=-1).unbind(-1)
        arguments = {"uv": torch.stack([0.5 + 0.45 * x, 0.5 - 0.45 * y], -1), "background": (0.2, 0.25, 0.35)}
        noise = 0.2 + 0.5 * torch.rand(512, 512, 3, generator=generator)
        rows, columns = torch.meshgrid(torch.linspace(0, 1, 512), torch.linspace(0, 1, 512), indexing="ij")
        centres = 0.25 + 0.5 * torch.rand(12, 2, generator=generator)
        spots = torch.exp(-((rows - centres[:, :1, None]) ** 2 + (columns - centres[:, 1:, None]) ** 2) / 0.05**2)
        point, steps = torch.zeros(12), torch.full((12,), 0.05)

        def draw(numbers: Tensor, size: int) -> Tensor:
            texture = noise + (numbers[:, None, None] * spots).sum(0)[..., None]
            return render(
                vertices, head.faces, camera, light, height=size, width=size, texture=texture, **arguments
            )["color"]  # fmt: skip

    target = point + 8 * steps * torch.randn(len(point), generator=generator)
    return compare(draw, point, steps, target.abs() if kind == "light" else target, pixels)


def face_accuracy(pixels: int, internal: int, region: str, seed: int) -> dict[str, float]:
    """The same for the weights of anny:man, over the whole picture or within boxes around the eyes and the lips."""
    from reenact.portrait import Portrait
    from reenact.rigs import anny, motion

    rig = anny.build("anny:man")
    portrait = Portrait.of(rig)
    point, target = motion.expressions(rig.names, 2, seed)
    mask = None
    if region == "eyes + lips":
        mask = torch.zeros(pixels, pixels)
        places = portrait.project(rig.vertices(point[None])[0], pixels)
        for part in region.split(" + "):
            corners = places[rig.part(part)]
            left, top = (corners.amin(0) - pixels / 64).floor().int().tolist()
            right, bottom = (corners.amax(0) + pixels / 64).ceil().int().tolist()
            mask[top:bottom, left:right] = 1
    return compare(
        lambda w, size: portrait.render(rig.vertices(w[None]), size)["color"], point, torch.full_like(point, 0.02),
        target, pixels, internal=internal, region=mask,
    )  # fmt: skip


def _mean(found: list[dict[str, float]]) -> dict[str, float]:
    """Means over seeds, and the worst."""
    means = {key: statistics.mean(each[key] for each in found) for key in found[0]}
    return {
        **means,
        "worst_cosine": min(each["cosine"] for each in found),
        "worst_relative_error": max(each["relative_error"] for each in found),
    }


def _smooth(picture: Tensor) -> Tensor:
    return torch.nn.functional.avg_pool2d(torch.nn.functional.avg_pool2d(picture, 5, 1), 5, 1)


def time_ms(head: Head, pixels: int, repeats: int = 15, batch: int = BATCH) -> tuple[float, float]:
    """Median milliseconds a frame, forward and forward + backward to the vertices."""
    weights = torch.rand(batch, 52, generator=torch.Generator().manual_seed(0)) * 0.5
    vertices = head.vertices(weights)
    picture_gradient = torch.randn(batch, 3, pixels, pixels, generator=torch.Generator().manual_seed(0))
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
    return tuple(statistics.median(times) * 1000 / batch for times in (forward, both))


def slope(sizes: list[float], times: list[float]) -> float:
    """Exponent of the power law nearest to the times."""
    x, y = torch.tensor(sizes).log(), torch.tensor(times).log()
    return ((x - x.mean()) * (y - y.mean())).sum().item() / ((x - x.mean()) ** 2).sum().item()


def measure_speed(sizes: list[str], pixels: list[int]) -> dict:
    """`ours` and `slopes` of the JSON file."""
    ours = {}
    print("size / pixels   forward  forward + backward  (ms a frame)")
    for size in sizes:
        head = Head(FREQUENCIES[size])
        for each in pixels:
            forward, both = time_ms(head, each)
            ours[f"{size}/{each}"] = {"forward_ms": forward, "forward_backward_ms": both}
            print(f"{size + ' / ' + str(each):15s} {forward:7.3f}  {both:18.3f}", flush=True)
    slopes = {}
    by_vertices = {10 * n * n + 2: time_ms(Head(n), 128) for n in FREQUENCIES.values()}
    by_pixels = {each**2: time_ms(Head(FREQUENCIES["10k"]), each) for each in (64, 128, 256, 512)}
    by_batch = {
        each: [each * ms for ms in time_ms(Head(FREQUENCIES["10k"]), 128, batch=each)] for each in (1, 2, 4, 8, 16, 32)
    }
    for name, times in (("vertices", by_vertices), ("pixels", by_pixels), ("batch", by_batch)):
        keys = [float(key) for key in times]
        slopes[name] = {
            which: slope(keys, [pair[n] for pair in times.values()])
            for n, which in enumerate(("forward", "forward_backward"))
        }
        slopes[name]["ms"] = {str(key): list(pair) for key, pair in times.items()}
        print(
            f"{name:10s} time ~ n^{slopes[name]['forward']:.2f} forward, n^{slopes[name]['forward_backward']:.2f} both"
        )
    return {"ours": ours, "slopes": slopes}


def measure_beside_peers(scenes: list[str]) -> dict:
    """`peers` of the JSON file, and ours in the same minute."""
    from peers import measure_peers

    results: dict = {}
    for scene in scenes:
        size, pixels = scene.split("/")
        head = Head(FREQUENCIES[size])
        ours = dict(zip(("forward_ms", "forward_backward_ms"), time_ms(head, int(pixels))))
        results[scene] = {"ours": ours, **measure_peers(head, int(pixels))}
        print(f"{scene}: milliseconds a frame (times ours)")
        for name, numbers in results[scene].items():
            print(f"  {name:20s}{_row(numbers, ours)}", flush=True)
    return {"peers": results}


def _row(numbers: dict[str, float] | str, ours: dict[str, float]) -> str:
    if isinstance(numbers, str):
        return numbers
    cells = []
    for key, label in (("forward_ms", "forward"), ("forward_backward_ms", "forward + backward")):
        if key in numbers:
            cells.append(f"{label} {numbers[key]:8.3f} ({numbers[key] / ours[key]:7.1f})")
    if "difference" in numbers:
        cells.append(f"differs by {numbers['difference'] * 255:.4f} / 255")
    return "  ".join(cells)


def measure_gradients(sizes: list[str], pixels: list[int], seeds: int) -> dict:
    """`gradient` of the JSON file."""
    gradient = {}
    print(f"gradient against differences of 8 x 8 samples a pixel, {seeds} seeds")
    for size in sizes:
        head = Head(FREQUENCIES[size])
        for each in pixels:
            found = [gradient_accuracy(head, each, seed=seed) for seed in range(1, seeds + 1)]
            numbers = _mean([{"cosine": cosine, "relative_error": error} for cosine, error in found])
            gradient[f"{size}/{each}"] = numbers
            if each == 128:
                gradient[size] = numbers
            _say(f"weights {size}/{each}", numbers)
    for kind in ("camera", "light", "texture"):
        head = Head(FREQUENCIES["5k"])
        gradient[kind] = _mean([scene_accuracy(head, 128, kind, seed) for seed in range(1, seeds + 1)])
        _say(f"{kind} 5k/128", gradient[kind])
    return {"gradient": gradient}


def measure_face(seeds: int) -> dict:
    """`face` of the JSON file."""
    face = {}
    for region in ("all", "eyes + lips"):
        for internal in (1, 2, 4):
            name = f"{region} x{internal}"
            face[name] = _mean([face_accuracy(128, internal, region, seed) for seed in range(1, seeds + 1)])
            _say(f"anny:man {name}", face[name])
    return {"face": face}


def _say(name: str, numbers: dict[str, float]) -> None:
    print(
        f"{name:26s} cosine {numbers['cosine']:.4f} (worst {numbers['worst_cosine']:.4f})  relative error "
        f"{numbers['relative_error']:.3f} (worst {numbers['worst_relative_error']:.3f})",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write the numbers there")
    parser.add_argument("--sizes", nargs="+", choices=FREQUENCIES, default=["5k", "10k", "26k", "41k"])
    parser.add_argument("--pixels", nargs="+", type=int, default=[64, 128, 256])
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument(
        "--seeds", type=int, default=1, help="expressions over which the gradients' errors are averaged"
    )
    parser.add_argument("--skip", nargs="+", choices=["speed", "peers", "gradient", "face"], default=[])
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    results: dict = {"threads": arguments.threads, "batch": BATCH}
    start = time.perf_counter()
    Head(8).render(torch.zeros(2, 52, requires_grad=True), 16)["color"].sum().backward()
    results["first_call_s"] = time.perf_counter() - start
    print(f"{arguments.threads} threads, batch {BATCH}; first call {results['first_call_s']:.1f} s")
    if "speed" not in arguments.skip:
        results |= measure_speed(arguments.sizes, arguments.pixels)
    if "peers" not in arguments.skip:
        results |= measure_beside_peers(["10k/128", "41k/128", "10k/512"])
    if "gradient" not in arguments.skip:
        results |= measure_gradients(
            [size for size in arguments.sizes if size != "41k"], arguments.pixels, arguments.seeds
        )
    if "face" not in arguments.skip:
        results |= measure_face(arguments.seeds)
    if arguments.json:
        arguments.json.parent.mkdir(parents=True, exist_ok=True)
        arguments.json.write_text(json.dumps(results, indent=2) + "\n")


if __name__ == "__main__":
    main()
