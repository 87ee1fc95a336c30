"""How fast other renderers draw the same heads: the mesh, view and light of `renderer.py`, new vertices in each frame.

`renderer.py` runs them beside ours. A peer that is not installed, or cannot start, is reported in one sentence. Each
runs in a process of its own, since some abort where a library does not suit them. What differs between them, and from
`render`:

    moderngl     OpenGL by EGL (without a GPU: llvmpipe), shaders of `render.opengl`, 8 bits; no antialiasing
    pyrender     the same by pyrender (PYOPENGL_PLATFORM, else OSMesa, else EGL)
    mitsuba      Mitsuba 3 on LLVM, integrator `direct`, 1 sample a pixel: casts shadows, has no ambient light and no
                 highlight; its gradient misses silhouettes
    mitsuba projective    the same with `direct_projective`, 4 samples: its gradient has silhouettes
    pytorch3d    PyTorch3D on the CPU, hard Phong, 1 face a pixel; its gradient misses silhouettes
    nvdiffrast   CUDA, shading in torch; blends silhouettes, of which its gradient sees those that its rule finds

To install them, beside what `render.opengl` says of pyrender: `pip install moderngl mitsuba`. Mitsuba needs LLVM 15 or
newer, on some CPUs 19 (Debian: libllvm19; DRJIT_LIBLLVM_PATH names the library). PyTorch3D and nvdiffrast are built
from their sources.
"""

from __future__ import annotations

import importlib.util
import math
import multiprocessing
import os
import pickle
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch starts: its idle threads would spin on our cores
sys.path.insert(0, str(Path(__file__).parents[1]))

import numba
import numpy as np
import torch
from torch import Tensor

from render import opengl
from render.shade import linear_from_srgb, shade, srgb_from_linear, vertex_normals

if TYPE_CHECKING:
    from renderer import Head

BACKGROUND = (0.2, 0.25, 0.35)
"""sRGB behind the head, as `Head.render` has it."""
SECONDS = 20.0
"""After that long no further call of a peer is timed."""


class Peer(Protocol):
    """Another renderer, made ready for one head and one size of square pictures.

    One with gradients has a second method, `gradient(vertices, picture_gradient)`: it draws, and returns the gradient
    of sum(picture * picture_gradient) for the vertices, all shaped as in the call. Mitsuba's picture is linear there.
    """

    frames: int
    """Pictures in a timed call: fewer where one takes long."""
    looks_alike: bool
    """Whether its picture should equal that of `render` but for silhouettes."""

    def __init__(self, head: Head, pixels: int) -> None: ...

    def __call__(self, vertices: Tensor) -> Tensor:
        """(B, V, 3) in world space, metres -> (B, 3, pixels, pixels) in sRGB, in the CPU's memory, row 0 at the top."""
        ...


def measure_peers(head: Head, pixels: int, repeats: int = 9) -> dict[str, dict[str, float] | str]:
    """Milliseconds a frame of each peer in `PEERS`, or the sentence that says why it draws nothing.

    Numbers are `forward_ms`, from vertices to a picture in the CPU's memory; where the peer has gradients
    `forward_backward_ms`, to the vertices' gradient; and where its picture should equal ours `difference`, the mean
    absolute difference of sRGB values where `render` says that the head covers the whole pixel. Times are medians of at
    most `repeats` calls, after two that are not counted, and of fewer where a peer is slow (`SECONDS`). The process of
    a peer imports the script that calls this, which therefore is a file, and guards what it does by its `__name__`.

    Args:
        head: A `Head` of benchmarks/renderer.py.
        pixels: Height and width.
        repeats: Timed calls.
    """
    return {name: _measure_apart(name, pickle.dumps(head), pixels, repeats) for name in PEERS}


def _measure_apart(name: str, head: bytes, pixels: int, repeats: int) -> dict[str, float] | str:
    """`_measure` in a new process, since a peer may abort it."""
    package = PEERS[name][0]
    if importlib.util.find_spec(package) is None:
        return f"{name}: not installed"
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        try:
            return pool.submit(_measure, name, head, pixels, repeats, torch.get_num_threads()).result()
        except BrokenProcessPool:
            return f"{name}: it aborted its process, whose own message stands above"


def _measure(name: str, head: bytes, pixels: int, repeats: int, threads: int) -> dict[str, float] | str:
    torch.set_num_threads(threads)
    os.environ["LP_NUM_THREADS"] = str(threads)  # of llvmpipe
    head: Head = pickle.loads(head)
    weights = torch.rand(16, 52, generator=torch.Generator().manual_seed(0)) * 0.5
    vertices = head.vertices(weights)
    try:
        peer = PEERS[name][1](head, pixels)
        picture = peer(vertices[:1])
    except Exception as error:  # each library has its own kinds
        return f"{name}: cannot start, {type(error).__name__}: {(str(error).strip() or 'no message').splitlines()[0]}"
    vertices = vertices[: peer.frames]
    results = {"forward_ms": _median_ms(lambda: peer(vertices), repeats) / peer.frames}
    if hasattr(peer, "gradient"):
        random = torch.randn(peer.frames, 3, pixels, pixels, generator=torch.Generator().manual_seed(0))
        results["forward_backward_ms"] = _median_ms(lambda: peer.gradient(vertices, random), repeats) / peer.frames
    if peer.looks_alike:
        ours = head.render(weights[:1], pixels)
        inside = (ours["mask"] > 0.999).expand_as(picture)
        results["difference"] = (picture - ours["color"])[inside].abs().mean().item()
    return results


def _median_ms(draw: Callable[[], Tensor], repeats: int) -> float:
    begin = time.perf_counter()
    times = []
    while len(times) < repeats + 2 and not (len(times) > 2 and time.perf_counter() - begin > SECONDS):
        start = time.perf_counter()
        draw()
        times.append(time.perf_counter() - start)
    return 1000 * statistics.median(times[2:])


class ModernGL:
    """moderngl: buffers and shaders that stay; positions and normals of each frame are written anew.

    8 bits are faster than floating point (`dtype` "f4"), with which the picture equals ours to 1e-6.
    """

    frames = 16
    looks_alike = True

    def __init__(self, head: Head, pixels: int, dtype: str = "f1") -> None:
        import moderngl

        context = moderngl.create_context(standalone=True, backend="egl")
        context.enable(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        self.camera, self.faces, self.pixels = head.camera, head.faces.numpy().astype(np.int32), pixels
        words = opengl._phong(head.camera, head.light) | {"NORMAL_LOC": "1", "COLOR_0_LOC": "2"}
        first, defines = "#version 330 core\n", "".join(f"#define {word} {text}\n" for word, text in words.items())
        sources = ((opengl.SHADERS / f"mesh.{kind}").read_text() for kind in ("vert", "frag"))
        program = context.program(*(source.replace(first, first + defines) for source in sources))
        program["P"].write(_projection(head).T.contiguous().numpy())  # OpenGL's columns are our rows
        self.geometry = context.buffer(reserve=len(head.neutral) * 24, dynamic=True)
        colors = context.buffer(linear_from_srgb(head.colors).numpy())
        layout = [(self.geometry, "3f 3f", "position", "normal"), (colors, "3f", "linear_color")]
        self.mesh = context.vertex_array(program, layout, context.buffer(self.faces))
        image = context.renderbuffer((pixels, pixels), 4, dtype=dtype)
        self.screen = context.framebuffer([image], context.depth_renderbuffer((pixels, pixels)))
        self.context, self.dtype = context, dtype

    def __call__(self, vertices: Tensor) -> Tensor:
        is_float = self.dtype == "f4"
        size = (len(vertices), self.pixels, self.pixels, 4)
        pictures = np.empty(size, np.float32 if is_float else np.uint8)
        self.screen.use()
        for frame, geometry in enumerate(_geometry(self.camera.to_camera(vertices).numpy(), self.faces)):
            self.geometry.orphan()
            self.geometry.write(geometry)
            self.screen.clear(*BACKGROUND, 1.0)
            self.mesh.render()
            self.screen.read_into(pictures[frame], components=4, dtype=self.dtype)
        pictures = torch.from_numpy(pictures)[..., :3].flip(1).movedim(-1, 1)  # OpenGL's rows point up
        return pictures if is_float else pictures / 255


class PyRender:
    """pyrender as `render.opengl` uses it, with one renderer for all frames and a new scene for each."""

    frames = 16
    looks_alike = True

    def __init__(self, head: Head, pixels: int) -> None:
        self.pyrender = opengl._pyrender()
        self.camera, self.faces = head.camera, head.faces.numpy().astype(np.int32)
        self.colors = linear_from_srgb(head.colors).numpy()
        self.lens = self.pyrender.PerspectiveCamera(yfov=2 * math.atan(1 / head.camera.focal), aspectRatio=1.0)
        self.lens.znear, self.lens.zfar = _depth_range(head)
        self.material = self.pyrender.MetallicRoughnessMaterial(alphaMode="OPAQUE")
        self.opened = opengl._opened(self.pyrender, opengl._phong(head.camera, head.light), pixels, pixels)
        self.renderer = self.opened.__enter__()  # the process ends with it

    def __call__(self, vertices: Tensor) -> Tensor:
        pictures = []
        for geometry in _geometry(self.camera.to_camera(vertices).numpy(), self.faces):
            primitive = self.pyrender.Primitive(
                positions=geometry[:, :3], normals=geometry[:, 3:], color_0=self.colors, indices=self.faces,
                material=self.material,
            )  # fmt: skip
            scene = self.pyrender.Scene(bg_color=[*BACKGROUND, 1.0])
            scene.add(self.lens)
            scene.add(self.pyrender.Mesh([primitive]))
            pictures.append(self.renderer.render(scene)[0].copy())
        return torch.from_numpy(np.stack(pictures)).movedim(-1, 1) / 255


class Mitsuba:
    """Mitsuba 3, variant llvm_ad_rgb: one scene whose vertices change; it makes normals and its search tree anew."""

    frames = 2
    looks_alike = False

    def __init__(self, head: Head, pixels: int, integrator: str = "direct", samples: int = 1) -> None:
        import drjit
        import mitsuba

        mitsuba.set_variant("llvm_ad_rgb")
        mitsuba.set_log_level(mitsuba.LogLevel.Error)
        drjit.set_thread_count(torch.get_num_threads())
        self.drjit, self.mitsuba, self.samples, self.seed = drjit, mitsuba, samples, 0
        material = {"type": "diffuse", "reflectance": {"type": "mesh_attribute", "name": "vertex_color"}}
        properties = mitsuba.Properties()
        properties["bsdf"] = mitsuba.load_dict(material)
        mesh = mitsuba.Mesh("head", len(head.neutral), len(head.faces), has_vertex_normals=True, props=properties)
        arrays = mitsuba.traverse(mesh)
        arrays["faces"] = mitsuba.UInt32(head.faces.numpy().astype(np.uint32).ravel())
        arrays["vertex_positions"] = mitsuba.Float(head.neutral.numpy().ravel())
        arrays.update()
        mesh.add_attribute("vertex_color", 3, linear_from_srgb(head.colors).numpy().ravel())
        to_camera = torch.eye(4, dtype=torch.float64)
        to_camera[:3] = head.camera.world_to_camera
        turned = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64))  # its cameras look along +Z
        brightness = math.pi * head.light.diffuse * float(head.light.position.square().sum())  # as ours in the middle
        near, far = _depth_range(head)
        # Of the silhouettes that matter to the second, shadows' are left out ("sppi"): ours has no shadows.
        integrators = {
            "direct": {"type": "direct"},
            "direct_projective": {"type": "direct_projective", "sppi": 0},
        }
        self.scene = mitsuba.load_dict(
            {
                "type": "scene",
                "integrator": integrators[integrator],
                "head": mesh,
                "light": {
                    "type": "point",
                    "position": head.light.position.tolist(),
                    "intensity": {"type": "rgb", "value": brightness},
                },
                "camera": {
                    "type": "perspective",
                    "fov": math.degrees(2 * math.atan(1 / head.camera.focal)),
                    "fov_axis": "y",
                    "near_clip": near,
                    "far_clip": far,
                    "to_world": mitsuba.ScalarTransform4f((torch.linalg.inv(to_camera) @ turned).numpy()),
                    "film": {
                        "type": "hdrfilm",
                        "width": pixels,
                        "height": pixels,
                        "pixel_format": "rgb",
                        "rfilter": {"type": "box"},
                    },
                },
            }
        )
        self.parameters = mitsuba.traverse(self.scene)

    def __call__(self, vertices: Tensor) -> Tensor:
        pictures = []
        for positions in vertices.numpy():
            linear = self.drjit.clip(self._draw(self.mitsuba.Float(positions.ravel()), None), 0, 1)
            bright = 1.055 * linear ** (1 / 2.4) - 0.055  # as `srgb_from_linear`; here it is part of their kernel
            srgb = self.drjit.select(linear <= 0.0031308, 12.92 * linear, bright)
            pictures.append(torch.from_numpy(np.array(srgb)))
        return torch.stack(pictures).movedim(-1, 1)

    def gradient(self, vertices: Tensor, picture_gradient: Tensor) -> Tensor:
        gradients = []
        for positions, wanted in zip(vertices.numpy(), picture_gradient.movedim(1, -1).contiguous().numpy()):
            leaf = self.mitsuba.Float(positions.ravel())
            self.drjit.enable_grad(leaf)
            self.drjit.backward(self.drjit.sum(self._draw(leaf, self.parameters) * self.mitsuba.TensorXf(wanted)))
            gradients.append(torch.from_numpy(np.array(self.drjit.grad(leaf)).reshape(-1, 3)))
        return torch.stack(gradients)

    def _draw(self, positions, differentiable):
        self.parameters["head.vertex_positions"] = positions
        self.parameters.update()
        self.seed += 1
        return self.mitsuba.render(self.scene, differentiable, spp=self.samples, seed=self.seed)


class PyTorch3D:
    """PyTorch3D on the CPU: MeshRasterizer and HardPhongShader, linear colours."""

    frames = 1
    looks_alike = True

    def __init__(self, head: Head, pixels: int) -> None:
        from pytorch3d import renderer, structures

        self.structures, self.renderer = structures, renderer
        self.faces, self.colors = head.faces[None], linear_from_srgb(head.colors)[None]
        # Its cameras look along +Z with +X to the left, and its points are rows: R is transposed.
        turned = torch.tensor([-1.0, 1.0, -1.0])
        matrix = turned[:, None] * head.camera.world_to_camera
        cameras = renderer.PerspectiveCameras(
            focal_length=head.camera.focal, R=matrix[None, :, :3].transpose(1, 2), T=matrix[None, :, 3]
        )
        light = head.light
        ambient, diffuse, specular = (((value,) * 3,) for value in (light.ambient, light.diffuse, light.specular))
        lights = renderer.PointLights(
            ambient_color=ambient, diffuse_color=diffuse, specular_color=specular, location=light.position[None]
        )
        background = linear_from_srgb(torch.tensor(BACKGROUND))
        settings = renderer.RasterizationSettings(
            image_size=pixels, blur_radius=0.0, faces_per_pixel=1, cull_backfaces=True
        )
        self.draw = renderer.MeshRenderer(
            renderer.MeshRasterizer(cameras, settings),
            renderer.HardPhongShader(
                cameras=cameras,
                lights=lights,
                materials=renderer.Materials(shininess=light.shininess),
                blend_params=renderer.BlendParams(background_color=background),
            ),
        )

    def __call__(self, vertices: Tensor) -> Tensor:
        count = len(vertices)
        textures = self.renderer.TexturesVertex(self.colors.expand(count, -1, -1))
        linear = self.draw(self.structures.Meshes(vertices, self.faces.expand(count, -1, -1), textures))  # (B, H, W, 4)
        return srgb_from_linear(linear[..., :3]).movedim(-1, 1)

    def gradient(self, vertices: Tensor, picture_gradient: Tensor) -> Tensor:
        return _autograd(self, vertices, picture_gradient)


class Nvdiffrast:
    """nvdiffrast on the GPU; vertices come from the CPU's memory and pictures or gradients go back there."""

    frames = 16
    looks_alike = True

    def __init__(self, head: Head, pixels: int) -> None:
        import nvdiffrast.torch as dr

        if not torch.cuda.is_available():
            raise RuntimeError("torch finds no CUDA device")
        self.dr, self.device = dr, torch.device("cuda")
        self.context = dr.RasterizeCudaContext(self.device)
        self.camera, self.light, self.pixels = head.camera, head.light, pixels
        self.light_position = head.camera.to_camera(head.light.position).to(self.device)
        self.faces = head.faces.to(self.device)
        self.corners = self.faces.int()
        self.colors = linear_from_srgb(head.colors).to(self.device)
        self.background = linear_from_srgb(torch.tensor(BACKGROUND)).to(self.device)
        self.projection = _projection(head).to(self.device)

    def __call__(self, vertices: Tensor) -> Tensor:
        points = self.camera.to_camera(vertices.to(self.device))
        clip = (torch.nn.functional.pad(points, (0, 1), value=1.0) @ self.projection.T).contiguous()
        raster, _ = self.dr.rasterize(self.context, clip, self.corners, (self.pixels, self.pixels), grad_db=False)
        colors = self.colors.expand(len(points), -1, -1)
        attributes = torch.cat([points, vertex_normals(points, self.faces), colors], -1)  # (B, V, 9)
        attribute_img, _ = self.dr.interpolate(attributes.contiguous(), raster, self.corners)
        point_img, normal_img, albedo_img = attribute_img.split(3, -1)
        normal_img = torch.nn.functional.normalize(normal_img, dim=-1)
        color_img = shade(albedo_img, normal_img, point_img, self.light_position, self.light)
        color_img = torch.where(raster[..., 3:] > 0, color_img, self.background)
        color_img = self.dr.antialias(color_img.contiguous(), raster, clip, self.corners)
        return srgb_from_linear(color_img).flip(1).movedim(-1, 1).cpu()  # OpenGL's rows point up

    def gradient(self, vertices: Tensor, picture_gradient: Tensor) -> Tensor:
        return _autograd(self, vertices, picture_gradient)


PEERS: dict[str, tuple[str, Callable[[Head, int], Peer]]] = {
    "moderngl": ("moderngl", ModernGL),
    "pyrender": ("pyrender", PyRender),
    "mitsuba": ("mitsuba", Mitsuba),
    "mitsuba projective": ("mitsuba", partial(Mitsuba, integrator="direct_projective", samples=4)),
    "pytorch3d": ("pytorch3d", PyTorch3D),
    "nvdiffrast": ("nvdiffrast", Nvdiffrast),
}
"""The package that a peer needs, and what makes it ready."""


def _autograd(peer: Peer, vertices: Tensor, picture_gradient: Tensor) -> Tensor:
    leaf = vertices.detach().requires_grad_()
    peer(leaf).backward(picture_gradient)
    return leaf.grad


def _depth_range(head: Head) -> tuple[float, float]:
    """Metres from the camera between which any expression of the head lies."""
    depths = -head.camera.to_camera(head.neutral)[:, 2]
    return 0.7 * float(depths.min()), 1.3 * float(depths.max())


def _projection(head: Head) -> Tensor:
    """(4, 4) of OpenGL: camera space -> clip space of a square picture."""
    near, far = _depth_range(head)
    projection = torch.diag(torch.tensor([head.camera.focal, head.camera.focal, (near + far) / (near - far), 0.0]))
    projection[2, 3], projection[3, 2] = 2 * near * far / (near - far), -1.0
    return projection


def _geometry(points: np.ndarray, faces: np.ndarray) -> Iterator[np.ndarray]:
    """Positions and unit normals (V, 6) of each frame of (B, V, 3), as `vertex_normals` has them but faster."""
    for frame in points:
        geometry = np.empty((len(frame), 6), np.float32)
        _fill(geometry, frame, faces)
        yield geometry


@numba.njit(fastmath=True)
def _fill(geometry, points, faces):
    for vertex in range(len(points)):
        for axis in range(3):
            geometry[vertex, axis], geometry[vertex, 3 + axis] = points[vertex, axis], 0
    for face in range(len(faces)):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        x1, y1, z1 = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
        x2, y2, z2 = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
        x, y, z = y1 * z2 - z1 * y2, z1 * x2 - x1 * z2, x1 * y2 - y1 * x2
        for corner in (a, b, c):
            geometry[corner, 3] += x
            geometry[corner, 4] += y
            geometry[corner, 5] += z
    for vertex in range(len(points)):
        squared = geometry[vertex, 3] ** 2 + geometry[vertex, 4] ** 2 + geometry[vertex, 5] ** 2
        scale = 1 / np.sqrt(squared) if squared > 0 else 0.0
        for axis in range(3, 6):
            geometry[vertex, axis] *= scale
