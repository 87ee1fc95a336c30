"""The same pictures through OpenGL, by pyrender: a second opinion on `render`, without gradients.

pyrender is optional and needs a GL library that draws without a screen: OSMesa (Debian: libosmesa6) or EGL. pyrender
0.1.45 asks for PyOpenGL 3.1.0, which cannot open OSMesa (it lacks OSMesaCreateContextAttribs), and an extra cannot
overrule what another package asks for. So two commands install it, the second without its own list of requirements:

    pip install "reenact[opengl]"
    pip install --no-deps pyrender==0.1.45

PYOPENGL_PLATFORM says which library draws, "osmesa" or "egl". Where it is not set, the first call here sets it: to
OSMesa where that is installed, else to EGL.
"""

from __future__ import annotations

import ctypes.util
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from render.camera import Camera
from render.kernels.function import _report_not_finite, topology
from render.pipeline import _check
from render.rasterize import NEAR
from render.shade import Light, linear_from_srgb, srgb_from_linear, vertex_normals

SHADERS = Path(__file__).parent / "shaders"


def render_opengl(
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
    background: Sequence[float] = (0.0, 0.0, 0.0),
    samples: int = 4,
) -> Float[Tensor, "B 3 H W"]:
    """The colour buffer of `render`, in which every argument but `samples` is explained.

    What differs: the card counts colours in steps of 1/255, textures too; and a pixel is the mean, in linear light, of
    `samples` x `samples` points (EGL splits each in four at edges), where `render` takes its middle and blends across
    silhouettes. Inside a face the two differ by 0.6 / 255 in the mean and 0.1 in the median (ours, 256 x 256 pixels).

    Returns:
        sRGB in [0, 1], float32, row 0 at the top.

    Raises:
        ValueError: pyrender or its GL library is missing, `samples` is not positive, or `render` refuses the arguments.
    """
    _check(vertices, faces, height, width, colors, texture, uv, uv_faces, None, None, background, ("color",))
    if samples < 1:
        raise ValueError(f"samples: expected 1 or more along each side of a pixel, got {samples}")
    topology(faces, vertices.shape[1])
    vertices = vertices.detach().float()
    if not vertices.isfinite().all():
        _report_not_finite(vertices)
    pyrender = _pyrender()
    points = camera.to_camera(vertices)  # so that all matrices but the projection are the identity
    normals = vertex_normals(points, faces)
    albedo = torch.ones(vertices.shape[1], 3) if colors is None else linear_from_srgb(colors.detach().float())
    lens = pyrender.PerspectiveCamera(yfov=2 * np.arctan(1 / camera.focal), aspectRatio=width / height)
    lens.znear, lens.zfar = _depth_range(points)
    material = pyrender.MetallicRoughnessMaterial(alphaMode="OPAQUE")
    # A corner of the card's triangles has one texture coordinate, so that seams come apart: one vertex a pair.
    pairs = faces.reshape(-1, 1)
    if texture is not None:
        pairs = torch.stack([faces, faces if uv_faces is None else uv_faces], -1).reshape(-1, 2)
        texels = (texture.detach().float().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
        material.baseColorTexture = pyrender.Texture(source=texels, source_channels="RGBA")
    pairs, corners = torch.unique(pairs, dim=0, return_inverse=True)
    triangles = corners.reshape(-1, 3)
    pictures = []
    with _opened(pyrender, _phong(camera, light), height * samples, width * samples) as renderer:
        for frame in range(len(points)):
            seen = triangles[(points[frame, :, 2] < -NEAR)[faces].all(1)]
            scene = pyrender.Scene(bg_color=[*background, 1.0])
            scene.add(lens)
            if len(seen):
                primitive = pyrender.Primitive(
                    positions=points[frame, pairs[:, 0]].numpy(),
                    normals=normals[frame, pairs[:, 0]].numpy(),
                    texcoord_0=None if texture is None else uv.detach().float()[pairs[:, 1]].numpy(),
                    color_0=albedo[pairs[:, 0]].numpy(),
                    indices=seen.numpy(),
                    material=material,
                )
                scene.add(pyrender.Mesh([primitive]))
            pictures.append(torch.from_numpy(renderer.render(scene)[0].copy()))
    fine = linear_from_srgb(torch.stack(pictures).movedim(-1, 1).float() / 255)
    return srgb_from_linear(torch.nn.functional.avg_pool2d(fine, samples))


def _pyrender() -> ModuleType:
    """pyrender, with a platform chosen that needs no screen."""
    has_osmesa = ctypes.util.find_library("OSMesa") is not None
    os.environ.setdefault("PYOPENGL_PLATFORM", "osmesa" if has_osmesa else "egl")
    try:
        import pyrender
    except ModuleNotFoundError as error:
        raise ValueError(
            f"OpenGL: expected pyrender, got no module {error.name!r}; install the extra `reenact[opengl]`, "
            "then `pip install --no-deps pyrender==0.1.45`"
        ) from error
    except (ImportError, AttributeError, OSError) as error:  # what PyOpenGL raises varies with what is missing
        raise _no_library(error) from error
    return pyrender


def _no_library(error: Exception) -> ValueError:
    platform = os.environ["PYOPENGL_PLATFORM"]
    return ValueError(
        f"OpenGL: expected a library that draws without a screen by PYOPENGL_PLATFORM={platform}, got "
        f"{type(error).__name__} ({error}); install libosmesa6 or an EGL driver"
    )


@contextmanager
def _opened(pyrender: ModuleType, phong: dict[str, str], height: int, width: int) -> Iterator:
    """A renderer of one size that draws with our shaders."""
    from pyrender.shader_program import ShaderProgramCache

    class Shaders(ShaderProgramCache):
        def get_program(self, vertex_shader, fragment_shader, geometry_shader=None, defines=None):
            return super().get_program(vertex_shader, fragment_shader, geometry_shader, {**(defines or {}), **phong})

    try:
        renderer = pyrender.OffscreenRenderer(width, height)
    except Exception as error:  # each platform has its own kinds
        raise _no_library(error) from error
    try:
        renderer._renderer._program_cache = Shaders(str(SHADERS))
        yield renderer
    finally:
        renderer.delete()


def _phong(camera: Camera, light: Light) -> dict[str, str]:
    """Words of the fragment shader and the numbers that stand for them."""
    x, y, z = camera.to_camera(light.position.detach().float()).tolist()
    numbers = {f"PHONG_{name.upper()}": f"{float(getattr(light, name)):.9e}" for name in _COEFFICIENTS}
    return {"PHONG_POSITION": f"vec3({x:.9e}, {y:.9e}, {z:.9e})", **numbers}


_COEFFICIENTS = ("ambient", "diffuse", "specular", "shininess")


def _depth_range(points: Float[Tensor, "B V 3"]) -> tuple[float, float]:
    """Metres between which all that can be seen lies, with a margin: close bounds keep the 24 bits of depth exact."""
    depths = -points[..., 2]
    depths = depths[depths > NEAR]
    if not len(depths):
        return NEAR, 1.0
    return max(NEAR / 2, 0.9 * float(depths.min())), 1.1 * float(depths.max())
