"""The Warp kernels for CUDA make the picture and the gradients of the numba kernels; here they run on the CPU.

Both work in float32 and add in another order, so nothing but which surface is seen, and where, is the same to the last
bit. Against float64 both are off by as much: 8e-6 of the gradient's length at 10k vertices and 128 pixels.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from contextlib import contextmanager, nullcontext
from dataclasses import fields, replace
from pathlib import Path

import pytest
import torch
import trimesh
from render_scene import GREY, ambient, at_pixels, bumpy_spheres, flat_camera

import render.kernels
from reenact.portrait import BACKGROUND, Portrait
from reenact.rigs import anny
from render import Camera, Light, pipeline
from render.kernels import function

wp = pytest.importorskip("warp", reason="Warp is not installed: pip install warp-lang")
from render.kernels import cuda  # noqa: E402

FLOATS = ("color", "mask", "normals", "depth", "attributes")


@contextmanager
def warp():
    """Meanwhile, render() uses the Warp kernels on the CPU."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "_kernels_for", lambda device, dtype: cuda)
        yield


def single(scene: dict) -> dict:
    """The scene in float32."""
    camera, light = scene["camera"], scene["light"]
    made = {
        name: value.float() if isinstance(value, torch.Tensor) and value.is_floating_point() else value
        for name, value in scene.items()
    }
    camera = Camera(camera.world_to_camera.float(), camera.focal)
    return {**made, "camera": camera, "light": replace(light, position=light.position.float())}


def balls() -> dict:
    """Textured, labelled, with attributes."""
    scene = single(bumpy_spheres())
    count = scene["vertices"].shape[1]
    generator = torch.Generator().manual_seed(7)
    attributes = torch.randn(2, count, 2, generator=generator)
    return {**scene, "attributes": attributes, "parts": torch.arange(count), "height": 24, "width": 20}


def sunk_balls() -> dict:
    """The small ball half sunk into the large one: neither outline bounds what is seen of it."""
    scene = balls()
    half = scene["vertices"].shape[1] // 2
    scene["vertices"][:, half:] += torch.tensor([-0.03, -0.01, -0.045])
    return {**scene, "height": 33, "width": 41}


def crossed_balls() -> dict:
    """Two equal smooth balls through one another, finer than the pixels, without texture and attributes."""
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    vertices, faces = torch.tensor(sphere.vertices).float(), torch.tensor(sphere.faces)
    shift = torch.tensor([0.053, 0.021, 0.017])
    return {
        **{name: value for name, value in balls().items() if name in ("camera", "light")},
        "vertices": torch.cat([vertices, vertices + shift])[None],
        "faces": torch.cat([faces, faces + len(vertices)]),
        "height": 25,
        "width": 31,
    }


def one_triangle() -> dict:
    return single(
        {
            "vertices": at_pixels([(0.5, 0.5), (0.7, 9.6), (8.6, 0.6)], 11, 9)[None],
            "faces": torch.tensor([[0, 1, 2]]),
            # Not white: at linear light of 1 the curve of sRGB ends, and rounding decides whether it has a slope.
            "colors": torch.tensor([[0.9, 0.5, 0.1], [0.3, 0.8, 0.2], [0.6, 0.4, 0.7]]),
            "camera": flat_camera(11),
            "light": ambient(),
            "height": 11,
            "width": 9,
        }
    )


def empty_view() -> dict:
    scene = balls()
    return {**scene, "vertices": scene["vertices"] + torch.tensor([0.0, 0.0, 5.0])}  # behind the camera


def no_frames() -> dict:
    scene = balls()
    return {**scene, "vertices": scene["vertices"][:0], "attributes": scene["attributes"][:0]}


def one_row() -> dict:
    return {**balls(), "height": 1, "width": 7}


def rig() -> dict:
    """A character: eyes, lids, lashes, lips and teeth, many of which pass through one another."""
    portrait = Portrait.of(anny.build("anny:toon"))
    character = portrait.rig
    generator = torch.Generator().manual_seed(0)
    weights = torch.rand(2, len(character.names), generator=generator) * 0.7
    vertices = character.neutral + torch.einsum("bk,kvc->bvc", weights, character.deltas)
    return {
        "vertices": portrait.scale * vertices + portrait.position,
        "attributes": portrait.scale * (vertices - character.neutral),
        "camera": portrait.camera,
        "light": portrait.light,
        **{name: getattr(character, name) for name in ("faces", "colors", "texture", "uv", "uv_faces", "parts")},
        "background": BACKGROUND,
        "height": 48,
        "width": 48,
    }


SCENES = (balls, sunk_balls, crossed_balls, one_triangle, empty_view, no_frames, one_row, rig)


@pytest.fixture(scope="module", params=SCENES, ids=lambda scene: scene.__name__)
def outcomes(request) -> tuple[tuple, tuple]:
    scene = request.param()
    plain = outcome(scene)
    with warp():
        return plain, outcome(scene)


def outcome(scene: dict, device: str = "cpu") -> tuple[dict, dict, object]:
    """Every buffer there is, the gradients of a random mixture of them for all that takes one, and the graph's node."""
    scene = {"background": GREY, **scene}
    camera, light = scene["camera"], scene["light"]
    leaves = {name: scene[name] for name in ("vertices", "colors", "texture", "attributes") if name in scene}
    leaves = {name: value.to(device) for name, value in leaves.items() if value is not None}
    leaves |= {"matrix": camera.world_to_camera, "focal": torch.tensor(float(camera.focal))}
    leaves |= {each.name: torch.as_tensor(getattr(light, each.name)) for each in fields(Light)}
    leaves = {name: value.clone().requires_grad_() for name, value in leaves.items()}
    buffers = [*(name for name in FLOATS if name != "attributes" or name in leaves)]
    buffers += ["parts"] if scene.get("parts") is not None else []
    made = pipeline.render(
        **{name: value.to(device) if isinstance(value, torch.Tensor) else value for name, value in scene.items()}
        | {name: leaves[name] for name in leaves if name in scene}
        | {
            "camera": Camera(leaves["matrix"], leaves["focal"]),
            "light": Light(**{each.name: leaves[each.name] for each in fields(Light)}),
            "buffers": buffers,
        }
    )
    # Of one sign: where gradients of pixels cancel, little is left of a light's but rounding.
    generator = torch.Generator().manual_seed(1)
    mixture = sum(
        (made[name].cpu() * torch.rand(made[name].shape, generator=generator)).sum() for name in FLOATS if name in made
    )
    gradients = torch.autograd.grad(mixture, list(leaves.values()), allow_unused=True, retain_graph=True)
    return made, dict(zip(leaves, gradients)), made["color"].grad_fn


def assert_same(plain: tuple, other: tuple, tolerance: float) -> None:
    for name, buffer in plain[0].items():
        found = other[0][name].cpu()
        if name == "parts":
            assert torch.equal(found, buffer)
        else:
            # float32 in another order, and the curve of sRGB: numba's is a polynomial that is off by 6e-7.
            torch.testing.assert_close(found, buffer, rtol=1e-5, atol=1e-5)
    for name, gradient in plain[1].items():
        found = other[1][name]
        assert (found is None) == (gradient is None)
        if gradient is not None and gradient.numel():
            scale = gradient.abs().max()
            torch.testing.assert_close(found.cpu(), gradient, rtol=0, atol=float(tolerance * scale), msg=name)


def test_pictures_and_gradients_are_those_of_numba(outcomes):
    assert_same(*outcomes, tolerance=2e-5)  # float32; measured up to 6e-6 of the largest entry


def test_the_same_crossings_are_found(outcomes):
    # A pair's surface, edge or sheets, to the last index: no rounding decides otherwise.
    (_, _, numba_node), (_, _, warp_node) = outcomes
    kept = numba_node.workspace.memory.kept
    places = dict(zip(cuda.Kept._fields, warp_node.saved_tensors[8:]))["places"]
    batch, _, height, width = kept.pair_img.shape
    pairs = torch.from_numpy(kept.pair_img).view(batch, 2 * height * width).long()
    found = torch.from_numpy(kept.places)[:, :, [0, 1, 2, 5]]
    expected = torch.stack([found[b, pairs[b].clamp(min=0)] for b in range(batch)]) if batch else found
    expected = torch.where(pairs[..., None] >= 0, expected, -1)
    assert torch.equal(places, expected)


@pytest.mark.parametrize(("scene", "least"), [(sunk_balls, 10), (crossed_balls, 10), (rig, 3)])
def test_scenes_have_meetings_of_sheets(scene, least):
    with warp():
        _, _, node = outcome(scene())
    places = dict(zip(cuda.Kept._fields, node.saved_tensors[8:]))["places"]
    assert (places[..., 3] >= 0).sum() >= least


def test_only_what_is_asked_for_takes_a_gradient():
    scene = {name: value for name, value in balls().items() if name not in ("attributes", "parts")}
    vertices = scene["vertices"].requires_grad_()
    gradients = []
    for context in (nullcontext(), warp()):
        with context:
            color = pipeline.render(**scene)["color"]
        gradients += torch.autograd.grad(color.square().sum(), vertices)
    torch.testing.assert_close(*gradients, rtol=0, atol=float(1e-5 * gradients[0].abs().max()))  # float32


def test_a_gradient_can_be_asked_for_twice():
    scene = balls()
    vertices = scene["vertices"].requires_grad_()
    with warp():
        loss = pipeline.render(**scene)["color"].square().sum()
    once, twice = (torch.autograd.grad(loss, vertices, retain_graph=True)[0] for _ in range(2))
    assert torch.equal(once, twice)  # one thread on the CPU; a GPU repeats to rounding


def test_any_triangles_leave_picture_and_gradient_finite():
    # Slivers, points, faces through the eye, far outside and larger than the picture.
    scene = balls()
    generator = torch.Generator().manual_seed(0)
    for _ in range(30):
        vertices = scene["vertices"].clone()
        chosen = torch.randperm(vertices.shape[1], generator=generator)[:12]
        vertices[:, chosen] *= 10 ** (6 * torch.rand(12, 1, generator=generator) - 3)
        vertices[:, chosen[:4]] = vertices[:, chosen[4:5]]
        with warp():
            made, gradients, _ = outcome({**scene, "vertices": vertices})
        assert all(torch.isfinite(made[name]).all() for name in FLOATS)
        assert torch.isfinite(gradients["vertices"]).all()


def test_a_vertex_that_is_not_a_number_is_named():
    scene = balls()
    for number in (torch.nan, torch.inf, -torch.inf):
        vertices = scene["vertices"].clone()
        vertices[1, 17, 2] = number
        with warp(), pytest.raises(ValueError, match="vertex 17 of frame 1"):
            pipeline.render(**{**scene, "vertices": vertices}, buffers=FLOATS)
    camera = Camera(scene["camera"].world_to_camera * torch.inf, 4.5)
    with warp(), pytest.raises(ValueError, match="camera: expected finite"):
        pipeline.render(**{**scene, "camera": camera})


def test_a_face_with_a_missing_vertex_is_named():
    with warp(), pytest.raises(ValueError, match="check that faces and vertices belong"):
        pipeline.render(**{**one_triangle(), "faces": torch.tensor([[0, 1, 3]])})


def test_compiling_is_announced_on_standard_error_alone(tmp_path):
    program = "import test_render_warp as test\nwith test.warp():\n    test.pipeline.render(**test.one_triangle())\n"
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=Path(__file__).parent, capture_output=True, text=True, check=True,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1]), "WARP_CACHE_PATH": str(tmp_path)},
    )  # fmt: skip
    assert done.stdout == ""
    assert done.stderr.count("render: compiling for cpu, once") == 1


# Devices


@pytest.mark.parametrize("arch", [75, 90])
def test_the_kernels_compile_for_cuda_without_a_gpu(arch, tmp_path):
    paths = wp.compile_aot_module(cuda, arch=arch, module_dir=tmp_path, use_ptx=True)
    (ptx,) = (path.read_text() for path in paths if path.suffix == ".ptx")
    assert f".target sm_{arch}" in ptx
    kernels = {re.match(r"\w+", part.strip()).group(): part for part in ptx.split(".entry")[1:]}
    for stage in ("_project_", "_rasterize_", "_silhouettes_"):
        # On the edge of two faces, a fused product and sum would let both have a pixel, or neither.
        (body,) = (text for name, text in kernels.items() if name.startswith(stage))
        assert "fma." not in body
        assert "div.full" not in body
        assert "div.approx" not in body


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device: torch.cuda.is_available() is False")
@pytest.mark.parametrize("scene", SCENES)
def test_a_gpu_makes_the_pictures_and_gradients_of_numba(scene):
    # Camera, light and their gradients stay on the CPU.
    # Its powers and logarithms are less exact than the CPU's, and its sums have no fixed order.
    assert_same(outcome(scene()), outcome(scene(), "cuda"), tolerance=1e-4)


def test_the_device_of_the_vertices_chooses_the_kernels():
    assert pipeline._kernels_for(torch.device("cpu"), torch.float64) is function
    assert pipeline._kernels_for(torch.device("cuda", 1), torch.float32) is cuda


def test_a_device_that_cannot_work_is_refused():
    with pytest.raises(ValueError, match=r"expected float32 on a GPU, got torch\.float64"):
        pipeline._kernels_for(torch.device("cuda"), torch.float64)
    scene = one_triangle()
    scene |= {name: scene[name].to("meta") for name in ("vertices", "faces", "colors")}
    with pytest.raises(ValueError, match="on the CPU or on a CUDA device, got meta"):
        pipeline.render(**scene)


def test_tensors_of_two_devices_are_refused():
    scene = balls()
    with pytest.raises(ValueError, match="colors: expected it on cpu, where the vertices are, got meta"):
        pipeline.render(**{**scene, "colors": scene["colors"].to("meta")})


def test_a_gpu_without_warp_says_what_to_install(monkeypatch):
    monkeypatch.delattr(render.kernels, "cuda")
    monkeypatch.delitem(sys.modules, "render.kernels.cuda")
    monkeypatch.setitem(sys.modules, "warp", None)
    with pytest.raises(ValueError, match="no module 'warp'; pip install warp-lang"):
        pipeline._kernels_for(torch.device("cuda"), torch.float32)
