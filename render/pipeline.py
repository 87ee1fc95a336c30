"""render(): vertices -> picture, in one differentiable call.

`render_by_stages` is the same five stages in plain torch: read that one first. The kernels behind `render` fuse them.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from render.antialias import antialias
from render.camera import Camera
from render.interpolate import barycentrics, interpolate
from render.kernels.function import Fused, Scene, topology
from render.rasterize import rasterize
from render.shade import Light, linear_from_srgb, sample_texture, shade, srgb_from_linear, unit, vertex_normals

BUFFERS = ("color", "mask", "normals", "depth", "parts", "attributes")


def render(
    vertices: Float[Tensor, "B V 3"],
    faces: Int[Tensor, "F 3"],
    camera: Camera,
    light: Light,
    *,
    height: int,
    width: int,
    colors: Float[Tensor, "V 3"] | None = None,
    texture: Float[Tensor, "Ht Wt 3"] | None = None,
    uv: Float[Tensor, "U 2"] | None = None,
    uv_faces: Int[Tensor, "F 3"] | None = None,
    parts: Int[Tensor, "V"] | None = None,
    attributes: Float[Tensor, "B V A"] | None = None,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    buffers: Sequence[str] = ("color",),
) -> dict[str, Tensor]:
    """Pictures of a batch of deformed copies of one mesh, from the outside: back faces are not drawn.

    Args:
        vertices: World space, metres; float32 or float64.
        faces: Triangles, counter-clockwise from outside.
        camera: Sees all copies.
        light: Lights all copies.
        height: Of the pictures, pixels.
        width: Of the pictures, pixels.
        colors: sRGB in [0, 1]; None is white.
        texture: sRGB in [0, 1], multiplies `colors`; needs `uv`.
        uv: Texture coordinates, (0, 0) top left, clamped at the borders.
        uv_faces: Triangles that index `uv`; None where they equal `faces`.
        parts: Any label of each vertex; a pixel takes that of the nearest corner of its triangle.
        attributes: Any numbers of each vertex of each copy, such as its motion.
        background: sRGB of what no triangle covers.
        buffers: Which of `BUFFERS` to make.

    Returns:
        For each requested buffer, row 0 at the top:
        `color` (B, 3, H, W), sRGB in [0, 1];
        `mask` (B, 1, H, W), share of the pixel that is covered;
        `normals` (B, 3, H, W), unit normals in camera space where covered, 0 outside;
        `depth` (B, 1, H, W), metres in front of the camera at the pixel's centre, 0 outside;
        `parts` (B, 1, H, W) int64, -1 outside;
        `attributes` (B, A, H, W), interpolated where covered, 0 outside.
        Colour, mask, normals and attributes are blended across silhouettes. Gradient reaches vertices, camera matrix,
        light position, colours, texture and attributes from all but parts; which triangle is seen has none.

    Raises:
        ValueError: A vertex is not finite, a face names a missing vertex, a buffer is unknown, a size or count
            disagrees.
    """
    _check(vertices, faces, height, width, colors, texture, uv, uv_faces, parts, attributes, background, buffers)
    dtype = vertices.dtype
    face_array, edge_array = topology(faces, vertices.shape[1])
    number = np.float64 if dtype == torch.float64 else np.float32
    if texture is None:
        uv_array, uv_face_array = np.zeros((0, 2), number), np.zeros((0, 3), np.int32)
    else:
        uv_array = np.ascontiguousarray(uv.detach().to(dtype).numpy())
        uv_face_array = face_array if uv_faces is None else np.ascontiguousarray(uv_faces.numpy(), dtype=np.int32)
    scene = Scene(
        faces=face_array,
        edges=edge_array,
        uv=uv_array,
        uv_faces=uv_face_array,
        phong=np.array([light.ambient, light.diffuse, light.specular, light.shininess], number),
        lens=np.array([camera.focal * height / 2, (width - 1) / 2, (height - 1) / 2], number),
        background=linear_from_srgb(torch.tensor(list(background), dtype=dtype)).numpy(),
        height=height,
        width=width,
        parts=np.ascontiguousarray(parts.numpy(), dtype=np.int64) if "parts" in buffers else None,
        with_normals="normals" in buffers,
        with_depth="depth" in buffers,
    )
    if "attributes" not in buffers:
        attributes = vertices.new_zeros(len(vertices), 0, 0)
    color, mask, extras, inverse_depth, part_img = Fused.apply(
        vertices,
        camera.world_to_camera.to(dtype),
        torch.ones(vertices.shape[1], 3, dtype=dtype) if colors is None else _linear(colors, dtype),
        torch.zeros(0, 0, 3, dtype=dtype) if texture is None else _linear(texture, dtype),
        attributes.to(dtype),
        camera.to_camera(light.position.to(dtype)),
        scene,
    )
    normals = 3 if "normals" in buffers else 0
    made = {"color": color, "mask": mask, "parts": part_img}
    made |= {"normals": extras[:, :normals], "attributes": extras[:, normals:]}
    if inverse_depth is not None:
        covered = inverse_depth > 0
        made["depth"] = torch.where(covered, 1 / torch.where(covered, inverse_depth, 1.0), 0.0)
    return {name: made[name] for name in buffers}


_linear_colors: OrderedDict[tuple[int, torch.dtype], tuple[Tensor, int, Tensor]] = OrderedDict()


def _linear(srgb: Tensor, dtype: torch.dtype) -> Tensor:
    """Linear light of colours; remembered for the last few tensors, since a rig's colours are the same in each call."""
    if srgb.requires_grad:
        return linear_from_srgb(srgb.to(dtype))
    key = id(srgb), dtype
    known = _linear_colors.get(key)
    # The tensor is kept, so its id is not given to another; _version counts changes in place.
    if known is None or known[0] is not srgb or known[1] != srgb._version:
        known = _linear_colors[key] = (srgb, srgb._version, linear_from_srgb(srgb.to(dtype)))
        while len(_linear_colors) > 16:
            _linear_colors.popitem(last=False)
    return known[2]


def render_by_stages(
    vertices: Float[Tensor, "B V 3"],
    faces: Int[Tensor, "F 3"],
    camera: Camera,
    light: Light,
    *,
    height: int,
    width: int,
    colors: Float[Tensor, "V 3"],
    texture: Float[Tensor, "Ht Wt 3"] | None = None,
    uv: Float[Tensor, "V 2"] | None = None,
    attributes: Float[Tensor, "B V A"] | None = None,
    background: Sequence[float] = (0.0, 0.0, 0.0),
) -> dict[str, Tensor]:
    """Colour, mask, normals and attributes as `render` makes them, stage after stage, thousands of times slower.

    For reading, and for testing the compiled kernels; gradients are those of autograd.
    """
    vertices_camera, vertices_clip = camera.to_camera(vertices), camera.project(vertices)
    face_img = rasterize(vertices_clip, faces, height, width)
    bary_img = barycentrics(vertices_clip, faces, face_img)
    points = interpolate(vertices_camera, faces, face_img, bary_img)
    normals = unit(interpolate(vertex_normals(vertices_camera, faces), faces, face_img, bary_img))
    albedo = interpolate(linear_from_srgb(colors).expand(len(vertices), -1, -1), faces, face_img, bary_img)
    if texture is not None:
        uv_img = interpolate(uv.expand(len(vertices), -1, -1), faces, face_img, bary_img)
        albedo = albedo * sample_texture(linear_from_srgb(texture), uv_img)
    covered = (face_img >= 0)[..., None]
    color_img = shade(albedo, normals, points, camera.to_camera(light.position.to(vertices)), light)
    color_img = torch.where(covered, color_img, linear_from_srgb(torch.tensor(list(background)).to(vertices)))
    if attributes is None:
        attributes = vertices.new_zeros(len(vertices), vertices.shape[1], 0)
    attribute_img = interpolate(attributes, faces, face_img, bary_img)
    everything = torch.cat([color_img, covered.to(vertices), torch.where(covered, normals, 0.0), attribute_img], -1)
    blended = antialias(everything, face_img, vertices_clip, faces).movedim(-1, 1)  # (B, 7 + A, H, W)
    color_img, mask, normals, attribute_img = blended.split([3, 1, 3, attributes.shape[-1]], 1)
    return {
        "color": srgb_from_linear(color_img),
        "mask": mask.clamp(0, 1),
        "normals": normals,
        "attributes": attribute_img,
    }


def _check(
    vertices, faces, height, width, colors, texture, uv, uv_faces, parts, attributes, background, buffers
) -> None:
    for name in buffers:
        if name not in BUFFERS:
            raise ValueError(f"buffers: expected names among {', '.join(BUFFERS)}, got {name!r}")
    if vertices.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"vertices: expected float32 or float64, got {vertices.dtype}")
    if height < 1 or width < 1:
        raise ValueError(f"picture size: expected at least 1 x 1 pixels, got {width} x {height}")
    if len(background) != 3:
        raise ValueError(f"background: expected red, green, blue, got {len(background)} numbers")
    for name, values in (("colors", colors), ("parts", parts)):
        if values is not None and len(values) != vertices.shape[1]:
            raise ValueError(f"{name}: expected one for each of {vertices.shape[1]} vertices, got {len(values)}")
    if "parts" in buffers and parts is None:
        raise ValueError("buffers: expected the argument `parts` with the buffer 'parts', got None; pass vertex labels")
    if "attributes" in buffers:
        if attributes is None:
            raise ValueError(
                "buffers: expected the argument `attributes` with the buffer 'attributes', got None; pass numbers of "
                "each vertex"
            )
        if attributes.shape[:2] != vertices.shape[:2]:
            raise ValueError(
                f"attributes: expected ({len(vertices)}, {vertices.shape[1]}, A) as vertices, got "
                f"{tuple(attributes.shape)}"
            )
    if texture is not None:
        if uv is None:
            raise ValueError("texture: expected texture coordinates with it, got uv=None; pass uv")
        corners = faces if uv_faces is None else uv_faces
        if corners.shape != faces.shape or (len(corners) and int(corners.max()) >= len(uv)):
            raise ValueError(
                f"uv_faces: expected {len(faces)} triangles of indices below {len(uv)}, got {len(corners)} "
                f"up to {int(corners.max())}; check that uv and faces belong to the same mesh"
            )
