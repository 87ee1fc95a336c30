"""The compiled stages as one differentiable function of torch, spread over the cores frame by frame."""

from __future__ import annotations

import os
from collections import OrderedDict, deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

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
    with_normals: bool


class Fused(torch.autograd.Function):
    """World vertices, 3 x 4 camera matrix, linear colours and texture, camera-space light -> pictures.

    Returns colour, mask, normals (no channels unless asked for), inverse depth, and the face of each pixel; then the
    camera-space vertices, for whoever wants to look up more.
    """

    @staticmethod
    def forward(
        ctx, world: Tensor, matrix: Tensor, colors: Tensor, texture: Tensor, light: Tensor, scene: Scene
    ) -> tuple[Tensor, ...]:
        batch, count, _ = world.shape
        height, width = scene.height, scene.width
        channels = 7 if scene.with_normals else 4
        new = world.new_empty
        finite = new(batch, dtype=torch.bool)
        vertices, screen, vertex_normals = new(batch, count, 3), new(batch, count, 3), new(batch, count, 4)
        front = new((batch, len(scene.faces)), dtype=torch.uint8)
        face_img = new((batch, height, width), dtype=torch.int32)
        inverse_img = new(batch, height, width)
        image, blended = new(batch, height, width, channels), new(batch, height, width, channels)
        pair_img, crossing_img = new((batch, 2, height, width), dtype=torch.int32), new(batch, 2, height, width)
        color, mask = new(batch, 3, height, width), new(batch, 1, height, width)
        normals = new(batch, channels - 4, height, width)
        inputs = [tensor.detach().contiguous() for tensor in (world, matrix, colors, texture, light)]
        limits = np.array([NEAR, DEPTH_MARGIN], scene.lens.dtype)
        over_frames(
            cpu.forward, batch, *_scene_arrays(scene, *inputs), limits, scene.background,
            finite, vertices, screen, vertex_normals, front, face_img, inverse_img, image, pair_img, crossing_img,
            blended, color, mask, normals,
        )  # fmt: skip
        if not bool(finite.all()):
            _report_not_finite(world)
        ctx.scene = scene
        ctx.save_for_backward(
            *inputs, vertices, screen, vertex_normals, face_img, image, pair_img, crossing_img, blended, color
        )
        ctx.mark_non_differentiable(face_img, vertices)
        # depth = 1 / inverse_img is left to the caller: few ask for it.
        return color, mask, normals, inverse_img[:, None], face_img, vertices

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g_color: Tensor, g_mask: Tensor, g_normals: Tensor, g_inverse: Tensor, *_) -> tuple:
        inputs, buffers = ctx.saved_tensors[:5], ctx.saved_tensors[5:]
        world, _, colors, texture, _ = inputs
        _, wants_matrix, wants_colors, wants_texture, wants_light, _ = ctx.needs_input_grad
        batch, zeros = len(world), world.new_zeros
        g_world = torch.empty_like(world)
        g_matrix = zeros(batch, 3 if wants_matrix else 0, 4)
        g_colors = zeros(batch, *(colors.shape if wants_colors else (0, 3)))
        g_texture = zeros(batch, *(texture.shape if wants_texture else (0, 0, 3)))
        g_light = zeros(batch, 3)
        over_frames(
            cpu.backward, batch, *_scene_arrays(ctx.scene, *inputs), *buffers,
            *(gradient.contiguous() for gradient in (g_color, g_mask, g_normals, g_inverse)),
            g_world, g_matrix, g_colors, g_texture, g_light,
        )  # fmt: skip
        # Frames were kept apart up to here, so that the sums do not depend on the threads.
        return (
            g_world,
            g_matrix.sum(0) if wants_matrix else None,
            g_colors.sum(0) if wants_colors else None,
            g_texture.sum(0) if wants_texture else None,
            g_light.sum(0) if wants_light else None,
            None,
        )


def _scene_arrays(scene: Scene, world, matrix, colors, texture, light) -> tuple:
    return (
        world, matrix, scene.faces, scene.edges, colors, scene.uv, scene.uv_faces, texture, light, scene.phong,
        scene.lens,
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


def parts_at_pixels(vertices: Tensor, scene: Scene, parts: Tensor, face_img: Tensor) -> Tensor:
    """Label of the nearest corner of the face in each pixel, -1 on the background: (B, 1, H, W) int64."""
    part_img = torch.empty(len(vertices), 1, scene.height, scene.width, dtype=torch.int64)
    over_frames(
        cpu.parts_at_pixels, len(vertices), vertices, scene.faces, parts.long().contiguous(), scene.lens, face_img,
        part_img,
    )  # fmt: skip
    return part_img


_pool: ThreadPoolExecutor | None = None


def over_frames(kernel, batch: int, *arrays: np.ndarray | Tensor) -> None:
    """Run `kernel(first, last, *arrays)` over all frames on as many threads as torch uses."""
    arrays = tuple(array.numpy() if isinstance(array, Tensor) else array for array in arrays)
    threads = min(torch.get_num_threads(), batch)
    if threads <= 1:
        kernel(0, batch, *arrays)
        return
    # Small pieces, the calling thread among those who take them: a core that is busy with something else takes fewer.
    bounds = np.linspace(0, batch, min(batch, 4 * threads) + 1).round().astype(int).tolist()
    pieces = deque(pairwise(bounds))

    def work() -> None:
        while True:
            try:
                first, last = pieces.popleft()
            except IndexError:
                return
            kernel(first, last, *arrays)

    if not kernel.signatures:
        kernel(*pieces.popleft(), *arrays)  # compiles once, not in every thread
    helpers = [_workers().submit(work) for _ in range(threads - 1)]
    work()
    for helper in helpers:
        helper.result()


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
