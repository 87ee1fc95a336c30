"""The compiled stages as one differentiable function of torch, spread over the cores frame by frame."""

from __future__ import annotations

import os
from collections import OrderedDict
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
    """Camera-space vertices and light, linear colours and texture -> colour, mask, normals, depth, faces."""

    @staticmethod
    def forward(ctx, vertices: Tensor, colors: Tensor, texture: Tensor, light: Tensor, scene: Scene) -> tuple:
        batch, count, _ = vertices.shape
        height, width = scene.height, scene.width
        channels = 7 if scene.with_normals else 4
        new = vertices.new_empty
        screen, vertex_normals = new(batch, count, 3), new(batch, count, 4)
        front = new((batch, len(scene.faces)), dtype=torch.uint8)
        face_img = new((batch, height, width), dtype=torch.int32)
        inverse_img = new(batch, height, width)
        image, blended = new(batch, height, width, channels), new(batch, height, width, channels)
        pair_img, crossing_img = new((batch, 2, height, width), dtype=torch.int32), new(batch, 2, height, width)
        color, mask = new(batch, 3, height, width), new(batch, 1, height, width)
        normals = new(batch, channels - 4, height, width)
        inputs = [tensor.detach().contiguous() for tensor in (vertices, colors, texture, light)]
        limits = np.array([NEAR, DEPTH_MARGIN], scene.lens.dtype)
        over_frames(
            cpu.forward, batch, *_scene_arrays(scene, *inputs), limits, scene.background,
            screen, vertex_normals, front, face_img, inverse_img, image, pair_img, crossing_img, blended, color, mask,
            normals,
        )  # fmt: skip
        depth = torch.where(inverse_img > 0, 1 / inverse_img, 0.0)[:, None]
        ctx.scene = scene
        ctx.save_for_backward(*inputs, screen, vertex_normals, face_img, image, pair_img, crossing_img, blended, color)
        ctx.mark_non_differentiable(face_img)
        return color, mask, normals, depth, face_img

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, g_color: Tensor, g_mask: Tensor, g_normals: Tensor, g_depth: Tensor, _) -> tuple:
        inputs, buffers = ctx.saved_tensors[:4], ctx.saved_tensors[4:]
        vertices, colors, texture, _ = inputs
        batch = len(vertices)
        _, wants_colors, wants_texture, _, _ = ctx.needs_input_grad
        g_vertices = torch.zeros_like(vertices)
        g_colors = vertices.new_zeros(batch, *(colors.shape if wants_colors else (0, 3)))
        g_texture = vertices.new_zeros(batch, *(texture.shape if wants_texture else (0, 0, 3)))
        g_light = vertices.new_zeros(batch, 3)
        over_frames(
            cpu.backward, batch, *_scene_arrays(ctx.scene, *inputs), *buffers,
            *(gradient.contiguous() for gradient in (g_color, g_mask, g_normals, g_depth)),
            g_vertices, g_colors, g_texture, g_light,
        )  # fmt: skip
        return (
            g_vertices,
            g_colors.sum(0) if wants_colors else None,
            g_texture.sum(0) if wants_texture else None,
            g_light.sum(0),
            None,
        )


def _scene_arrays(scene: Scene, vertices: Tensor, colors: Tensor, texture: Tensor, light: Tensor) -> tuple:
    return (
        vertices, scene.faces, scene.edges, colors, scene.uv, scene.uv_faces, texture, light, scene.phong, scene.lens,
    )  # fmt: skip


def parts_at_pixels(vertices: Tensor, scene: Scene, parts: Tensor, face_img: Tensor) -> Tensor:
    """Label of the nearest corner of the face in each pixel, -1 on the background: (B, 1, H, W) int64."""
    part_img = torch.empty(len(vertices), 1, scene.height, scene.width, dtype=torch.int64)
    vertices, parts = vertices.detach().contiguous(), parts.long().contiguous()
    over_frames(cpu.parts_at_pixels, len(vertices), vertices, scene.faces, parts, scene.lens, face_img, part_img)
    return part_img


_pool: ThreadPoolExecutor | None = None


def over_frames(kernel, batch: int, *arrays: np.ndarray | Tensor) -> None:
    """Run `kernel(first, last, *arrays)` over all frames on as many threads as torch uses."""
    arrays = tuple(array.numpy() if isinstance(array, Tensor) else array for array in arrays)
    threads = min(torch.get_num_threads(), batch)
    if threads == 1:
        kernel(0, batch, *arrays)
        return
    # Twice as many pieces as threads even out frames of different cost.
    bounds = np.linspace(0, batch, min(batch, 2 * threads) + 1).round().astype(int).tolist()
    pieces = list(pairwise(bounds))
    if not kernel.signatures:
        kernel(*pieces.pop(0), *arrays)  # compiles once, not in every thread
    futures = [_workers().submit(kernel, first, last, *arrays) for first, last in pieces]
    for future in futures:
        future.result()


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
