"""render(): vertices -> picture, in one differentiable call.

`render_by_stages` is the same five stages in plain torch: read that one first. The kernels behind `render` fuse them.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from itertools import accumulate
from types import ModuleType

import torch
from jaxtyping import Float, Int
from torch import Tensor

from render.antialias import Meeting, blend, distances, edge_points, find_crossings
from render.camera import Camera
from render.interpolate import barycentrics, interpolate
from render.kernels import function
from render.rasterize import rasterize
from render.shade import (
    Light,
    level_of_detail,
    linear_from_srgb,
    mip_maps,
    sample_texture,
    shade,
    srgb_from_linear,
    texel_areas,
    unit,
    vertex_normals,
)

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

    On a GPU where the vertices are on one; camera and light may be elsewhere.

    Args:
        vertices: World space, metres; float32, or float64 on the CPU.
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
        ValueError: A vertex is not finite, a face names a missing vertex, a buffer is unknown, a size, count or
            device disagrees, or Warp is missing for the GPU.
    """
    _check(vertices, faces, height, width, colors, texture, uv, uv_faces, parts, attributes, background, buffers)
    dtype, device = vertices.dtype, vertices.device
    kernels = _kernels_for(device, dtype)
    array = kernels.array
    topology = kernels.topology(faces, vertices.shape[1])
    if texture is None:
        texels, levels = vertices.new_zeros(0, 3), array(faces.new_zeros(0, 3), torch.int64)
        none = vertices.new_zeros(0)
        uv_arrays = array(none.view(0, 2), dtype), array(faces[:0], torch.int32), array(none, dtype)
    else:
        rows, columns, corners = *texture.shape[:2], faces if uv_faces is None else uv_faces
        texels, levels = _remembered(_texels, texture, dtype=dtype, array=array)
        uv_arrays = _remembered(_texture_arrays, uv, corners, rows=rows, columns=columns, dtype=dtype, array=array)
    scene = function.Scene(
        mesh=kernels.Mesh(*topology, *uv_arrays, levels),
        axis=((width - 1) / 2, (height - 1) / 2),
        background=array(linear_from_srgb(torch.tensor(list(background), dtype=dtype)).to(device), dtype),
        height=height,
        width=width,
        parts=array(parts, torch.int64) if "parts" in buffers else None,
        with_normals="normals" in buffers,
        with_depth="depth" in buffers,
    )
    if "attributes" not in buffers:
        attributes = vertices.new_zeros(len(vertices), 0, 0)
    if colors is None:
        linear_colors = vertices.new_ones(vertices.shape[1], 3)
    else:
        linear_colors = _remembered(_linear, colors, dtype=dtype)
    color, mask, extras, inverse_depth, part_img = kernels.Fused.apply(
        vertices,
        camera.world_to_camera.to(vertices),
        torch.as_tensor(camera.focal, dtype=dtype, device=device) * (height / 2),
        linear_colors,
        texels,
        attributes.to(dtype),
        camera.to_camera(light.position.to(vertices)),
        light.coefficients.to(vertices),
        scene,
    )
    normals = 3 if "normals" in buffers else 0
    made = {"color": color, "mask": mask, "parts": part_img}
    made |= {"normals": extras[:, :normals], "attributes": extras[:, normals:]}
    if inverse_depth is not None:
        covered = inverse_depth > 0
        made["depth"] = torch.where(covered, 1 / torch.where(covered, inverse_depth, 1.0), 0.0)
    return {name: made[name] for name in buffers}


def _kernels_for(device: torch.device, dtype: torch.dtype) -> ModuleType:
    """The module of compiled stages for vertices of this kind."""
    if device.type == "cpu":
        return function
    if device.type != "cuda":
        raise ValueError(f"vertices: expected them on the CPU or on a CUDA device, got {device}; move them with .to()")
    if dtype != torch.float32:
        raise ValueError(f"vertices: expected float32 on a GPU, got {dtype}; pass vertices.float()")
    try:
        from render.kernels import cuda  # slow to import
    except ModuleNotFoundError as error:
        raise ValueError(
            f"vertices: expected Warp to render on {device}, got no module {error.name!r}; pip install warp-lang"
        ) from error
    return cuda


_known: OrderedDict[tuple, tuple[tuple[Tensor, ...], tuple[int, ...], object]] = OrderedDict()


def _remembered(function: Callable, *tensors: Tensor, **settings):
    """`function` of tensors that are the same in each call, such as a rig's colours; computed once for the last few."""
    if any(tensor.requires_grad or tensor.is_inference() for tensor in tensors):
        return function(*tensors, **settings)
    key = (function, *map(id, tensors), *settings.values())
    versions = tuple(tensor._version for tensor in tensors)  # counts changes in place
    known = _known.get(key)
    # The tensors are kept, so that an id is not given to another.
    if known is None or known[1] != versions:
        known = _known[key] = (tensors, versions, function(*tensors, **settings))
        while len(_known) > 32:
            _known.popitem(last=False)
    return known[2]


def _linear(srgb: Tensor, dtype: torch.dtype) -> Tensor:
    return linear_from_srgb(srgb.to(dtype))


def _texels(texture: Tensor, dtype: torch.dtype, array: Callable) -> tuple:
    """All levels of an sRGB texture in one row of linear texels; first texel, rows and columns of each level."""
    levels = mip_maps(linear_from_srgb(texture.to(dtype)))
    sizes = [tuple(level.shape[:2]) for level in levels]
    starts = accumulate((rows * columns for rows, columns in sizes), initial=0)
    table = torch.tensor([(start, *size) for start, size in zip(starts, sizes)], device=texture.device)
    return torch.cat([level.flatten(0, 1) for level in levels]), array(table, torch.int64)


def _texture_arrays(
    uv: Tensor, uv_faces: Tensor, rows: int, columns: int, dtype: torch.dtype, array: Callable
) -> tuple:
    uv = uv.detach().to(dtype)
    areas = texel_areas(uv, uv_faces, rows, columns)
    return array(uv, dtype), array(uv_faces, torch.int32), array(areas, dtype)


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
    vertex_attributes = torch.cat([vertices_camera, vertex_normals(vertices_camera, faces)], -1)
    texture_levels = None if texture is None else mip_maps(linear_from_srgb(texture))

    def look(frames: slice, face_img: Tensor, bary_img: Tensor) -> Tensor:
        """Colour, coverage, normal and attributes at points of faces; (B, H, W) -> (B, H, W, 7 + A)."""

        def at_points(values: Tensor) -> Tensor:
            return interpolate(values[frames], faces, face_img, bary_img)

        covered = (face_img >= 0)[..., None]
        points, normals = at_points(vertex_attributes).split(3, -1)
        normals = unit(normals)
        albedo = at_points(linear_from_srgb(colors).expand(len(vertices), -1, -1))
        if texture_levels is not None:
            uv_img = at_points(uv.expand(len(vertices), -1, -1))
            owners = face_img.clamp(min=0)
            areas = texel_areas(uv, faces, *texture.shape[:2])[owners]
            corners = vertices_camera[frames][torch.arange(len(face_img))[:, None, None, None], faces[owners]]
            volumes = torch.linalg.det(torch.where(covered[..., None], corners, torch.eye(3).to(corners)))
            volumes, depths = -volumes, torch.where(covered[..., 0], -points[..., 2], 1.0)
            focal = torch.as_tensor(camera.focal) * height / 2
            level = level_of_detail(areas, volumes, depths, focal, len(texture_levels))
            albedo = albedo * sample_texture(texture_levels, uv_img, level)
        color = shade(albedo, normals, points, camera.to_camera(light.position.to(vertices)), light)
        color = torch.where(covered, color, linear_from_srgb(torch.tensor(list(background)).to(vertices)))
        parts = [color, covered.to(vertices), torch.where(covered, normals, 0.0)]
        return torch.cat(parts if attributes is None else [*parts, at_points(attributes)], -1)

    face_img = rasterize(vertices_clip, faces, height, width)
    everything = look(slice(None), face_img, barycentrics(vertices_clip, faces, face_img))
    blended = []
    for frame, crossings in enumerate(find_crossings(face_img, vertices_clip, faces, float(camera.focal) * height / 2)):
        owners, coordinates = edge_points(crossings, vertices_clip[frame], faces, height, width)
        edge_colors = look(slice(frame, frame + 1), owners[None, None], coordinates[None, None])[0, 0]
        meets = [n for n, crossing in enumerate(crossings) if isinstance(crossing, Meeting)]
        if meets:  # there the colour stays as it is up to the crossing
            rows, columns = torch.tensor([crossings[n].surface for n in meets]).T
            edge_colors = edge_colors.index_put((torch.tensor(meets),), everything[frame, rows, columns])
        places = distances(crossings, vertices_clip[frame], faces, height, width)
        blended.append(blend(everything[frame], edge_colors, places, crossings))
    channels = torch.stack(blended).movedim(-1, 1)  # (B, 7 + A, H, W)
    return {
        "color": srgb_from_linear(channels[:, :3]),
        "mask": channels[:, 3:4].clamp(0, 1),
        "normals": channels[:, 4:7],
        "attributes": channels[:, 7:],
    }


def _check(
    vertices, faces, height, width, colors, texture, uv, uv_faces, parts, attributes, background, buffers
) -> None:
    for name in buffers:
        if name not in BUFFERS:
            raise ValueError(f"buffers: expected names among {', '.join(BUFFERS)}, got {name!r}")
    if vertices.dtype not in (torch.float32, torch.float64):
        raise ValueError(f"vertices: expected float32 or float64, got {vertices.dtype}")
    for name, values in (
        ("faces", faces), ("colors", colors), ("texture", texture), ("uv", uv), ("uv_faces", uv_faces),
        ("parts", parts), ("attributes", attributes),
    ):  # fmt: skip
        if values is not None and values.device != vertices.device:
            raise ValueError(
                f"{name}: expected it on {vertices.device}, where the vertices are, got {values.device}; move it with "
                ".to()"
            )
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
