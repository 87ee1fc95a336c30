"""The compiled stages as one differentiable function of torch, spread over the cores frame by frame."""

from __future__ import annotations

import os
from collections import OrderedDict, deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from render.antialias import DEPTH_MARGIN, edges_of
from render.kernels import cpu
from render.rasterize import NEAR


@dataclass(frozen=True)
class Scene:
    """What is the same in every frame of a call and takes no gradient."""

    faces: np.ndarray  # (F, 3) int32
    edges: np.ndarray  # (E, 4) int32
    uv: np.ndarray  # (U, 2), empty without a texture
    uv_faces: np.ndarray  # (F, 3) int32, empty without a texture
    phong: np.ndarray  # ambient, diffuse, specular, shininess
    lens: np.ndarray  # focal length, column and row of the optical axis, in pixels
    background: np.ndarray  # linear
    height: int
    width: int
    parts: np.ndarray | None  # (V,) int64
    with_normals: bool
    with_depth: bool


class Fused(torch.autograd.Function):
    """World vertices, 3 x 4 camera matrix, linear colours and texture, attributes, camera-space light -> pictures.

    Returns colour, mask, extras (normals if the scene asks for them, then attributes), inverse depth and parts; None
    for the last two if the scene does not ask for them.
    """

    @staticmethod
    def forward(
        ctx,
        world: Tensor,
        matrix: Tensor,
        colors: Tensor,
        texture: Tensor,
        attributes: Tensor,
        light: Tensor,
        scene: Scene,
    ) -> tuple[Tensor | None, ...]:
        batch = len(world)
        height, width = scene.height, scene.width
        color, mask = world.new_empty(batch, 3, height, width), world.new_empty(batch, 1, height, width)
        extra_channels = (3 if scene.with_normals else 0) + attributes.shape[-1]
        extras = world.new_empty(batch, extra_channels, height, width)
        inputs = [tensor.detach().contiguous() for tensor in (world, matrix, colors, texture, attributes, light)]
        limits = np.array([NEAR, DEPTH_MARGIN], scene.lens.dtype)
        workspace = Workspace.borrow(batch, world.shape[1], 4 + extra_channels, scene)
        kept = workspace.arrays
        over_frames(
            cpu.forward, batch, *_scene_arrays(scene, *inputs), limits, scene.background,
            kept["finite"], kept["vertices"], kept["screen"], kept["vertex_normals"], kept["front"], kept["face_img"],
            kept["inverse_img"], kept["image"], kept["pair_img"], kept["crossing_img"], kept["blended"],
            color, mask, extras, kept["scratch_faces"],
        )  # fmt: skip
        if not kept["finite"].all():
            _report_not_finite(world)
        inverse_img = torch.from_numpy(kept["inverse_img"]).clone()[:, None] if scene.with_depth else None
        part_img = None
        if scene.parts is not None:
            part_img = torch.empty(batch, 1, height, width, dtype=torch.int64)
            over_frames(
                cpu.parts_at_pixels, batch, kept["vertices"], scene.faces, scene.parts, scene.lens, kept["face_img"],
                part_img,
            )  # fmt: skip
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
        world, _, colors, texture, attributes, _ = inputs
        kept = ctx.workspace.arrays
        _, wants_matrix, wants_colors, wants_texture, wants_attributes, wants_light, _ = ctx.needs_input_grad
        batch, zeros = len(world), world.new_zeros
        nothing = zeros(batch, 0, 0, 0)
        g_world = torch.empty_like(world)
        g_matrix = zeros(batch, 3 if wants_matrix else 0, 4)
        g_colors = zeros(batch, *(colors.shape if wants_colors else (0, 3)))
        g_texture = zeros(batch, *(texture.shape if wants_texture else (0, 0, 3)))
        g_attributes = zeros(batch, *(attributes.shape[1:] if wants_attributes else (0, attributes.shape[-1])))
        g_light = zeros(batch, 3)
        over_frames(
            cpu.backward, batch, *_scene_arrays(ctx.scene, *inputs),
            kept["vertices"], kept["screen"], kept["vertex_normals"], kept["face_img"], kept["image"],
            kept["pair_img"], kept["crossing_img"], kept["blended"], color,
            *(nothing if gradient is None else gradient.contiguous() for gradient in g_pictures[:4]),
            g_world, g_matrix, g_colors, g_texture, g_attributes, g_light,
            kept["scratch_blended"], kept["scratch_image"], kept["scratch_screen"], kept["scratch_vertex_normals"],
            kept["scratch_vertices"],
        )  # fmt: skip
        # Frames were kept apart up to here, so that the sums do not depend on the threads.
        return (
            g_world,
            g_matrix.sum(0) if wants_matrix else None,
            g_colors.sum(0) if wants_colors else None,
            g_texture.sum(0) if wants_texture else None,
            g_attributes if wants_attributes else None,
            g_light.sum(0) if wants_light else None,
            None,
        )


class Workspace:
    """What the forward pass leaves for the backward pass, borrowed from those of earlier calls of the same sizes.

    Fresh memory costs as much as all arithmetic (page faults, 160 a frame at 7,000 vertices and 64 pixels). A workspace
    goes back when the last graph that holds it is gone.
    """

    _idle: ClassVar[OrderedDict[tuple, list[dict[str, np.ndarray]]]] = OrderedDict()
    _KINDS_KEPT = 4

    def __init__(self, key: tuple, arrays: dict[str, np.ndarray]) -> None:
        self._key = key
        self.arrays = arrays

    @classmethod
    def borrow(cls, batch: int, vertices: int, channels: int, scene: Scene) -> Workspace:
        """A workspace that nobody else uses; its contents are undefined."""
        number, height, width = scene.lens.dtype, scene.height, scene.width
        workers = os.cpu_count() or 1  # the backward pass may run on more threads than the forward pass
        key = (batch, vertices, len(scene.faces), height, width, channels, number.str)
        try:
            return cls(key, cls._idle[key].pop())
        except (KeyError, IndexError):
            pass
        pixels = (batch, height, width)
        arrays = {
            "finite": np.empty(batch, np.bool_),
            "vertices": np.empty((batch, vertices, 3), number),
            "screen": np.empty((batch, vertices, 3), number),
            "vertex_normals": np.empty((batch, vertices, 4), number),
            "front": np.empty((batch, len(scene.faces)), np.uint8),
            "face_img": np.empty(pixels, np.int32),
            "inverse_img": np.empty(pixels, number),
            "image": np.empty((*pixels, channels), number),
            "blended": np.empty((*pixels, channels), number),
            "pair_img": np.empty((batch, 2, height, width), np.int32),
            "crossing_img": np.empty((batch, 2, height, width), number),
            "scratch_faces": np.empty((workers, len(scene.faces) + 1), np.int32),
            "scratch_blended": np.empty((workers, height, width, channels), number),
            "scratch_image": np.empty((workers, height, width, channels), number),
            "scratch_screen": np.empty((workers, vertices, 2), number),
            "scratch_vertex_normals": np.empty((workers, vertices, 3), number),
            "scratch_vertices": np.empty((workers, vertices, 3), number),
        }
        return cls(key, arrays)

    def __del__(self) -> None:
        idle = self._idle.setdefault(self._key, [])
        if len(idle) < 2:
            idle.append(self.arrays)
        while len(self._idle) > self._KINDS_KEPT:
            self._idle.popitem(last=False)


def _scene_arrays(scene: Scene, world, matrix, colors, texture, attributes, light) -> tuple:
    return (
        world, matrix, scene.faces, scene.edges, colors, scene.uv, scene.uv_faces, texture, attributes, light,
        scene.phong, scene.lens,
    )  # fmt: skip


def _report_not_finite(world: Tensor) -> None:
    bad = (~torch.isfinite(world)).any(-1).nonzero()
    if not len(bad):
        raise ValueError("camera: expected finite numbers, got NaN or infinity in the matrix or vertices out of range")
    frame, vertex = bad[0].tolist()
    raise ValueError(
        f"vertices: expected finite numbers, got {world[frame, vertex].tolist()} at vertex {vertex} of frame {frame}; "
        f"{len(bad)} vertices of the batch are not finite"
    )


_pool: ThreadPoolExecutor | None = None


def over_frames(kernel, batch: int, *arrays: np.ndarray | Tensor) -> None:
    """Run `kernel(worker, first, last, *arrays)` over all frames on as many threads as torch uses."""
    arrays = tuple(array.numpy() if isinstance(array, Tensor) else array for array in arrays)
    threads = min(_worker_count(), batch)
    if threads <= 1:
        kernel(0, 0, batch, *arrays)
        return
    # Small pieces, the calling thread among those who take them: a core that is busy with something else takes fewer.
    bounds = np.linspace(0, batch, min(batch, 4 * threads) + 1).round().astype(int).tolist()
    pieces = deque(pairwise(bounds))

    def work(worker: int) -> None:
        while True:
            try:
                first, last = pieces.popleft()
            except IndexError:
                return
            kernel(worker, first, last, *arrays)

    if not kernel.signatures:
        kernel(0, *pieces.popleft(), *arrays)  # compiles once, not in every thread
    helpers = [_workers().submit(work, worker) for worker in range(1, threads)]
    work(0)
    for helper in helpers:
        helper.result()


def _worker_count() -> int:
    return max(1, min(torch.get_num_threads(), os.cpu_count() or 1))


def _workers() -> ThreadPoolExecutor:
    global _pool
    if _pool is None:
        _pool = ThreadPoolExecutor(os.cpu_count(), thread_name_prefix="render")
    return _pool


def _forget_workers() -> None:
    global _pool
    _pool = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_workers)  # threads do not survive a fork; the child starts its own

_topologies: OrderedDict[int, tuple[Tensor, int, np.ndarray, np.ndarray]] = OrderedDict()


def topology(faces: Tensor, vertex_count: int) -> tuple[np.ndarray, np.ndarray]:
    """Faces and edges as the kernels want them; remembered for the last few `faces` tensors.

    Raises:
        ValueError: A face names a vertex that is not there.
    """
    known = _topologies.get(id(faces))
    # The tensor is kept, so its id is not given to another; _version counts changes in place.
    if known is None or known[0] is not faces or known[1] != faces._version:
        known = (faces, faces._version, _indices(faces), _indices(edges_of(faces)))
        _topologies[id(faces)] = known
        while len(_topologies) > 16:
            _topologies.popitem(last=False)
    largest = int(known[3][:, :2].max()) if len(known[3]) else -1
    if largest >= vertex_count or (len(known[2]) and int(known[2].min()) < 0):
        raise ValueError(
            f"faces: expected vertex indices in 0..{vertex_count - 1}, got {int(known[2].min())}..{largest}; "
            "check that faces and vertices belong to the same mesh"
        )
    return known[2], known[3]


def _indices(tensor: Tensor) -> np.ndarray:
    return np.ascontiguousarray(tensor.numpy(), dtype=np.int32)
