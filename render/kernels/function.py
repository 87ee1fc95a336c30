"""The compiled stages as one differentiable function of torch, spread over the cores frame by frame."""

from __future__ import annotations

import os
from collections import OrderedDict, deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from threading import Lock
from typing import ClassVar

import numba
import numpy as np
import torch
from torch import Tensor

from render.antialias import DEPTH_MARGIN, VALLEY, edges_of, neighbours_of
from render.kernels import cpu
from render.kernels.announce import announced
from render.kernels.cpu import Mesh as Mesh
from render.rasterize import NEAR

CORES = os.cpu_count() or 1


@dataclass(frozen=True)
class Scene:
    """What is the same in every frame of a call and takes no gradient."""

    mesh: tuple  # the `Mesh` of the kernels; here and below arrays for `cpu`, tensors for `cuda`
    axis: tuple[float, float]  # column and row of the optical axis
    background: np.ndarray | Tensor  # linear
    height: int
    width: int
    parts: np.ndarray | Tensor | None  # (V,) int64
    with_normals: bool
    with_depth: bool


class Fused(torch.autograd.Function):
    """World vertices, camera matrix, focal length in pixels, colours and texels (both linear), attributes, camera-space
    light and its four coefficients -> pictures.

    Returns colour, mask, extras (normals if the scene asks for them, then attributes), inverse depth and parts; None
    for the last two if the scene does not ask for them.
    """

    @staticmethod
    def forward(
        ctx,
        world: Tensor,
        matrix: Tensor,
        focal: Tensor,
        colors: Tensor,
        texels: Tensor,
        attributes: Tensor,
        light: Tensor,
        phong: Tensor,
        scene: Scene,
    ) -> tuple[Tensor | None, ...]:
        batch = len(world)
        height, width, mesh = scene.height, scene.width, scene.mesh
        color, mask = world.new_empty(batch, 3, height, width), world.new_empty(batch, 1, height, width)
        extra_channels = (3 if scene.with_normals else 0) + attributes.shape[-1]
        extras = world.new_empty(batch, extra_channels, height, width)
        inputs = [
            tensor.detach().contiguous() for tensor in (world, matrix, focal, colors, texels, attributes, light, phong)
        ]
        look, attributes = _look(inputs, scene), inputs[5]
        number = look.lens.dtype
        workspace = Workspace(batch, world.shape[1], 4 + extra_channels, scene, number)
        kept, limits = workspace.memory.kept, tuple(map(number.type, (NEAR, DEPTH_MARGIN, VALLEY)))
        candidates, tiles = workspace.memory.candidates, tile_count(batch, height)
        world, pictures = inputs[0], (color.numpy(), mask.numpy(), extras.numpy())
        if tiles == 1:
            spread(cpu.forward, batch, world.numpy(), mesh, look, attributes.numpy(), limits, kept, candidates,
                   *pictures)  # fmt: skip
        else:
            spread(cpu.forward_vertices, batch, world.numpy(), mesh, look, limits[0], kept)
            spread(cpu.forward_pixels, batch * tiles, tiles, mesh, look, attributes.numpy(), kept, candidates)
            spread(cpu.forward_silhouettes, batch, mesh, look, attributes.numpy(), limits, kept)
            spread(cpu.forward_encoding, batch * tiles, tiles, kept, *pictures)
        if not kept.finite.all():
            _report_not_finite(world)
        inverse_img = torch.from_numpy(kept.inverse_img).clone()[:, None] if scene.with_depth else None
        part_img = None
        if scene.parts is not None:
            part_img = torch.empty(batch, 1, height, width, dtype=torch.int64)
            spread(cpu.parts_at_pixels, batch, kept.vertices, mesh.faces, scene.parts, look.lens, kept.face_img,
                   part_img.numpy())  # fmt: skip
            ctx.mark_non_differentiable(part_img)
        if any(ctx.needs_input_grad):
            ctx.scene, ctx.workspace = scene, workspace
            ctx.save_for_backward(*inputs, color)
            ctx.set_materialize_grads(False)
        return color, mask, extras, inverse_img, part_img

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *g_pictures: Tensor | None) -> tuple:
        *inputs, color = ctx.saved_tensors
        world, _, _, colors, texels, attributes, _, _ = inputs
        scene, kept = ctx.scene, ctx.workspace.memory.kept
        _, wants_matrix, wants_focal, wants_colors, wants_texels, wants_attributes, wants_light, wants_phong, _ = (
            ctx.needs_input_grad
        )
        batch, look = len(world), _look(inputs, scene)
        tiles = tile_count(batch, scene.height)
        pieces, number = batch * tiles, look.lens.dtype
        scratch, (g_vertices, g_normals, g_screen) = ctx.workspace.memory.backward(tiles)
        zeros = partial(np.zeros, dtype=number)
        sums = cpu.Sums(
            vertices=g_vertices,
            normals=g_normals,
            screen=g_screen,
            colors=zeros((pieces, *(colors.shape if wants_colors else (0, 3)))),
            texels=zeros((pieces, *(texels.shape if wants_texels else (0, 3)))),
            attributes=zeros((pieces, *(attributes.shape[1:] if wants_attributes else (0, attributes.shape[-1])))),
            light=zeros((pieces, 3)),
            phong=zeros((pieces, 4)),
            lens=zeros((pieces, 3)),
        )
        g_world, g_matrix = torch.empty_like(world), zeros((batch, 3 if wants_matrix else 0, 4))
        nothing = zeros((batch, 0, 0, 0))
        g_color, g_mask, g_extras, g_inverse = (
            nothing if gradient is None else gradient.contiguous().numpy() for gradient in g_pictures[:4]
        )
        shared = scene.mesh, look, attributes.numpy(), wants_light or wants_phong, kept
        if tiles == 1:
            spread(cpu.backward, batch, world.numpy(), *shared, color.numpy(), g_color, g_mask, g_extras, g_inverse,
                   scratch, sums, g_world.numpy(), g_matrix)  # fmt: skip
        else:
            spread(cpu.backward_encoding, pieces, tiles, kept, color.numpy(), g_color, g_mask, g_extras, scratch, sums)
            spread(cpu.backward_silhouettes, batch, tiles, *shared, scratch, sums)
            spread(cpu.backward_pixels, pieces, tiles, *shared, g_inverse, scratch, sums)
            spread(cpu.backward_vertices, batch, tiles, world.numpy(), scene.mesh, look, kept, sums, g_world.numpy(),
                   g_matrix)  # fmt: skip
        # Pieces were kept apart up to here, so that the sums do not depend on the threads.
        total = {name: torch.from_numpy(getattr(sums, name)) for name in cpu.Sums._fields[3:]}
        return (
            g_world,
            torch.from_numpy(g_matrix).sum(0) if wants_matrix else None,
            total["lens"].sum(0)[0] if wants_focal else None,
            total["colors"].sum(0) if wants_colors else None,
            total["texels"].sum(0) if wants_texels else None,
            total["attributes"].unflatten(0, (batch, tiles)).sum(1) if wants_attributes else None,
            total["light"].sum(0) if wants_light else None,
            total["phong"].sum(0) if wants_phong else None,
            None,
        )


class Memory:
    """What the forward pass leaves for the backward pass, and what both work in; contents are undefined at first."""

    def __init__(
        self, batch: int, vertices: int, faces: int, height: int, width: int, channels: int, number: str
    ) -> None:
        self._shape = batch, vertices, height, width, channels, number
        pixels, crossings, empty = height * width, 2 * height * width, np.empty
        # There are as many places for crossings as pairs of pixels; what is not used is never touched, and so not real.
        self.kept = cpu.Kept(
            finite=empty(batch, np.bool_),
            vertices=empty((batch, vertices, 3), number),
            screen=empty((batch, vertices, 3), number),
            normals=empty((batch, vertices, 4), number),
            sides=empty((batch, faces), np.uint8),
            face_img=empty((batch, height, width), np.int32),
            inverse_img=empty((batch, height, width), number),
            samples=empty((batch, pixels + crossings, channels), number),
            pair_img=empty((batch, 2, height, width), np.int32),
            places=empty((batch, crossings, 6), np.int32),
            crossings=empty((batch, crossings, 2), number),
            mixed=empty((batch, crossings, 2, channels), number),
            counts=empty(batch, np.int64),
        )
        self.candidates = empty((CORES, faces + 1), np.int32)
        self._backward: dict[int, tuple] = {}

    def backward(self, tiles: int) -> tuple[cpu.Scratch, tuple[np.ndarray, ...]]:
        """One piece for each thread, or with tiles for each frame and tile."""
        if tiles not in self._backward:
            batch, vertices, height, width, channels, number = self._shape
            frames, pieces = (CORES, CORES) if tiles == 1 else (batch, batch * tiles)
            crossings = 2 * height * width
            scratch = cpu.Scratch(
                samples=np.empty((frames, height * width + crossings, channels), number),
                mixed=np.empty((frames, crossings, 2, channels), number),
            )
            self._backward[tiles] = scratch, tuple(np.empty((pieces, vertices, 3), number) for _ in range(3))
        return self._backward[tiles]


class Workspace:
    """Memory borrowed from that of earlier calls of the same sizes.

    Fresh memory costs as much as all arithmetic (page faults, 160 a frame at 7,000 vertices and 64 pixels). It goes
    back when the last graph that holds the workspace is gone.
    """

    _idle: ClassVar[OrderedDict[tuple, list[Memory]]] = OrderedDict()
    _KINDS_KEPT = 4

    def __init__(self, batch: int, vertices: int, channels: int, scene: Scene, number: np.dtype) -> None:
        self._key = batch, vertices, len(scene.mesh.faces), scene.height, scene.width, channels, number.str
        try:
            self.memory = self._idle[self._key].pop()
        except (KeyError, IndexError):
            self.memory = Memory(*self._key)

    def __del__(self) -> None:
        idle = self._idle.setdefault(self._key, [])
        if len(idle) < 2:
            idle.append(self.memory)
        while len(self._idle) > self._KINDS_KEPT:
            self._idle.popitem(last=False)


def _look(inputs: list[Tensor], scene: Scene) -> cpu.Look:
    _, matrix, focal, colors, texels, _, light, phong = (tensor.numpy() for tensor in inputs)
    lens = np.array([focal, *scene.axis], focal.dtype)
    return cpu.Look(matrix, lens, light, phong, colors, texels, scene.background)


def _report_not_finite(world: Tensor) -> None:
    bad = (~torch.isfinite(world)).any(-1).nonzero()
    if not len(bad):
        raise ValueError("camera: expected finite numbers, got NaN or infinity in the matrix or vertices out of range")
    frame, vertex = bad[0].tolist()
    raise ValueError(
        f"vertices: expected finite numbers, got {world[frame, vertex].tolist()} at vertex {vertex} of frame {frame}; "
        f"{len(bad)} vertices of the batch are not finite"
    )


def tile_count(batch: int, height: int) -> int:
    """Bands of rows into which each frame is cut: one, unless there are fewer frames than cores.

    It depends on the cores of the machine and not on the threads in use, so that sums do not either.
    """
    return max(1, min(CORES // batch, height // 8, 8)) if batch else 1


_pool: ThreadPoolExecutor | None = None


def spread(kernel, pieces: int, *arguments) -> None:
    """Run `kernel(worker, first, last, *arguments)` over all pieces on as many threads as torch uses."""
    run = _machine_code(kernel, arguments)
    threads = min(_worker_count(), pieces)
    if threads <= 1:
        run(0, 0, pieces, *arguments)
        return
    # Small parts, the calling thread among those who take them: a core that is busy with something else takes fewer.
    count = min(pieces, 4 * threads)
    parts = deque(pairwise(part * pieces // count for part in range(count + 1)))

    def work(worker: int) -> None:
        while True:
            try:
                first, last = parts.popleft()
            except IndexError:
                return
            run(worker, first, last, *arguments)

    helpers = [_workers().submit(work, worker) for worker in range(1, threads)]
    work(0)
    for helper in helpers:
        helper.result()


_found: dict[tuple, Callable] = {}
_compiling = Lock()


def _machine_code(kernel, arguments: tuple) -> Callable:
    """The kernel compiled for arguments of these types; numba's own look-up takes 60 us with tuples of arrays."""
    key = (kernel, *map(_kind, arguments))
    if key not in _found:
        types = tuple(map(numba.typeof, (0, 0, 0, *arguments)))
        with _compiling, announced():
            kernel.compile(types)
        _found[key] = kernel.overloads[types].entry_point
    return _found[key]


def _kind(value) -> tuple | type:
    """What tells types of the kernels' arguments apart."""
    if isinstance(value, tuple):
        return tuple(map(_kind, value))
    return (value.dtype.num, value.ndim, value.flags.num) if isinstance(value, np.ndarray) else type(value)


def _worker_count() -> int:
    return max(1, min(torch.get_num_threads(), CORES))


def _workers() -> ThreadPoolExecutor:
    global _pool
    if _pool is None:
        _pool = ThreadPoolExecutor(CORES, thread_name_prefix="render")
    return _pool


def _forget_workers() -> None:
    global _pool
    _pool = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_workers)  # threads do not survive a fork; the child starts its own


def array(tensor: Tensor, dtype: torch.dtype) -> np.ndarray:
    """As the kernels want what takes no gradient."""
    return tensor.detach().to(dtype).contiguous().numpy()


def _arrays(faces: Tensor, edges: Tensor, neighbours: Tensor, vertex_count: int) -> tuple[np.ndarray, ...]:
    return tuple(array(tensor, torch.int32) for tensor in (faces, edges, neighbours))


_topologies: OrderedDict[tuple, tuple[Tensor, int, tuple]] = OrderedDict()


def topology(faces: Tensor, vertex_count: int, arrays: Callable[..., tuple] = _arrays) -> tuple:
    """What `arrays` makes of faces, edges, neighbours and the number of vertices; remembered for the last few `faces`.

    Without `arrays` it is the first three, as `cpu` wants them.

    Raises:
        ValueError: A face names a vertex that is not there.
    """
    key = id(faces), vertex_count, arrays
    known = _topologies.get(key)
    # The tensor is kept, so its id is not given to another; _version counts changes in place.
    if known is None or known[0] is not faces or known[1] != _version(faces):
        lowest, largest = (int(faces.min()), int(faces.max())) if len(faces) else (0, -1)
        if lowest < 0 or largest >= vertex_count:
            raise ValueError(
                f"faces: expected vertex indices in 0..{vertex_count - 1}, got {lowest}..{largest}; "
                "check that faces and vertices belong to the same mesh"
            )
        edges = edges_of(faces)
        known = faces, _version(faces), arrays(faces, edges, neighbours_of(faces, edges), vertex_count)
        _topologies[key] = known
        while len(_topologies) > 16:
            _topologies.popitem(last=False)
    return known[2]


def _version(tensor: Tensor) -> int:
    """Counts changes in place; tensors made for inference are not changed by anyone."""
    return 0 if tensor.is_inference() else tensor._version
