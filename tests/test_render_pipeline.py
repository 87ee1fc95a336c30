"""render(): laws, gradients, the readable twin, and what it refuses."""

from __future__ import annotations

import inspect
import multiprocessing
import resource
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from render_scene import GREY, ambient, at_pixels, bumpy_spheres, flat_camera

from render import Camera, Light, render, render_by_stages
from render.kernels import function
from render.kernels.function import Workspace
from render.shade import linear_from_srgb, srgb_from_linear

sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
from renderer import Head, gradient_accuracy

FLOATS = ("color", "mask", "normals", "depth", "attributes")


@pytest.fixture(scope="module")
def scene() -> dict:
    scene = bumpy_spheres()
    count = scene["vertices"].shape[1]
    generator = torch.Generator().manual_seed(7)
    return {**scene, "attributes": torch.randn(2, count, 2, dtype=torch.float64, generator=generator)}


@pytest.fixture(scope="module")
def head() -> Head:
    return Head(22)  # 4,842 vertices


def picture(scene: dict, height: int = 24, width: int = 20, buffers=FLOATS, **changes) -> dict:
    return render(**{**scene, **changes}, height=height, width=width, background=GREY, buffers=buffers)


def meeting(vertices: torch.Tensor) -> torch.Tensor:
    """The small ball half sunk into the front of the large one: neither outline bounds what is seen of it."""
    count = vertices.shape[1] // 2
    sunk = vertices.clone()
    sunk[:, count:] += torch.tensor([-0.03, -0.01, -0.045], dtype=vertices.dtype)
    return sunk


# Closed forms


def test_a_triangle_without_light_has_its_own_colour_before_the_background():
    corners = at_pixels([(0.5, 0.5), (0.5, 4.6), (4.6, 0.5)], 6, 8).float()[None]
    colors = torch.tensor([[0.9, 0.5, 0.1]]).repeat(3, 1)
    made = render(
        corners, torch.tensor([[0, 1, 2]]), flat_camera(6), ambient(), height=6, width=8, colors=colors,
        parts=torch.tensor([5, 6, 7]), background=GREY, buffers=("color", "mask", "depth", "normals", "parts"),
    )  # fmt: skip
    torch.testing.assert_close(made["color"][0, :, 2, 2], colors[0], rtol=0, atol=2e-6)  # the kernel's sRGB: 6e-7
    torch.testing.assert_close(made["color"][0, :, 5, 7], torch.tensor(GREY), rtol=0, atol=2e-6)
    assert made["depth"][0, 0, 2, 2].item() == pytest.approx(1, abs=1e-6)  # float32
    assert made["depth"][0, 0, 5, 7].item() == 0
    torch.testing.assert_close(made["normals"][0, :, 2, 2], torch.tensor([0.0, 0.0, 1.0]))
    assert not made["normals"][0, :, 5, 7].any()
    parts = made["parts"][0, 0]
    assert [parts[1, 1].item(), parts[4, 1].item(), parts[1, 4].item(), parts[5, 7].item()] == [5, 6, 7, -1]
    assert {name: tuple(buffer.shape) for name, buffer in made.items()} == {
        "color": (1, 3, 6, 8), "mask": (1, 1, 6, 8), "depth": (1, 1, 6, 8), "normals": (1, 3, 6, 8),
        "parts": (1, 1, 6, 8),
    }  # fmt: skip


def test_only_requested_buffers_are_made(scene):
    assert list(picture(scene, buffers=("mask",))) == ["mask"]


# Laws


def test_colours_under_even_light_are_attributes_too(scene):
    # Blended alike, so that the two differ by the curve of sRGB alone.
    linear = linear_from_srgb(scene["colors"]).expand(2, -1, -1)
    made = picture(scene, texture=None, light=ambient(), attributes=linear)
    inside = made["mask"].expand(-1, 3, -1, -1) == 1
    shown = srgb_from_linear(made["attributes"].clamp(0, 1))
    torch.testing.assert_close(shown[inside], made["color"][inside], rtol=0, atol=1e-5)  # the kernel's sRGB: 6e-7


def test_face_order_does_not_change_the_picture(scene):
    order = torch.randperm(len(scene["faces"]), generator=torch.Generator().manual_seed(0))
    plain, shuffled = picture(scene), picture(scene, faces=scene["faces"][order])
    for name in FLOATS:
        # Normals are summed in another order, so not to the last bit.
        torch.testing.assert_close(shuffled[name], plain[name], rtol=0, atol=1e-12)


def test_a_shift_by_whole_pixels_shifts_the_picture(scene):
    # A shear of camera space moves the optical axis within the picture, and with it every point alike.
    matrix = scene["camera"].world_to_camera.clone()
    focal = scene["camera"].focal
    matrix[0] -= 3 * (2 / 24) / focal * matrix[2]  # three columns to the right at every depth
    matrix[1] += 2 * (2 / 24) / focal * matrix[2]  # two rows down
    still = picture(scene, light=ambient(), buffers=("color", "mask"))
    moved = picture(scene, light=ambient(), camera=Camera(matrix, focal), buffers=("color", "mask"))
    for name in ("color", "mask"):
        # The shear keeps every projected position and so every barycentric coordinate. Borders are left out: a pixel
        # there has a neighbour to be blended with in one picture and none in the other.
        torch.testing.assert_close(moved[name][..., 5:-1, 5:-1], still[name][..., 3:-3, 2:-4], rtol=0, atol=1e-9)


def test_the_nearer_of_two_objects_is_seen(scene):
    count = scene["vertices"].shape[1] // 2
    parts = torch.arange(2).repeat_interleave(count)
    near = picture(scene, parts=parts, buffers=("parts", "depth"))
    alone = picture(scene, faces=scene["faces"][len(scene["faces"]) // 2 :], parts=parts, buffers=("parts", "depth"))
    small = alone["parts"] == 1
    assert small.sum() > 20
    assert (near["parts"][small] == 1).all()
    torch.testing.assert_close(near["depth"][small], alone["depth"][small])


def test_frames_of_a_batch_do_not_know_each_other(scene):
    together = picture(scene)
    alone = picture(scene, vertices=scene["vertices"][1:], attributes=scene["attributes"][1:])
    for name in FLOATS:
        assert torch.equal(together[name][1:], alone[name])


@pytest.mark.parametrize("frames", [1, 5])  # one frame is cut into bands of rows
def test_threads_change_neither_picture_nor_gradient(head, frames):
    weights = torch.rand(1, 52, generator=torch.Generator().manual_seed(0))

    def outcome(threads: int) -> list[torch.Tensor]:
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            vertices = head.vertices(weights) + 0.001 * torch.arange(float(frames))[:, None, None]
            vertices, colors = vertices.requires_grad_(), head.colors.clone().requires_grad_()
            light = head.light.position.clone().requires_grad_()
            color = render(
                vertices, head.faces, head.camera, replace(head.light, position=light), height=32, width=32,
                colors=colors,
            )["color"]  # fmt: skip
            (color**2).sum().backward()
        finally:
            torch.set_num_threads(before)
        return [color.detach(), vertices.grad, colors.grad, light.grad]

    for one, two in zip(outcome(1), outcome(2)):
        assert torch.equal(one, two)


def test_bands_of_rows_change_no_picture_and_gradients_to_rounding_only(scene, monkeypatch):
    def outcome(cores: int) -> list[torch.Tensor]:
        monkeypatch.setattr(function, "CORES", cores)
        Workspace._idle.clear()  # scratch memory is made for so many threads
        leaves = [scene[name].clone().requires_grad_() for name in ("vertices", "colors", "texture", "attributes")]
        names = dict(zip(("vertices", "colors", "texture", "attributes"), leaves))
        made = picture(scene, **names)
        loss = sum((made[name] ** 2).sum() for name in FLOATS)
        return [made[name].detach() for name in FLOATS], torch.autograd.grad(loss, leaves)

    (whole, whole_gradients), (bands, band_gradients) = outcome(1), outcome(6)
    Workspace._idle.clear()
    for one, other in zip(whole, bands):
        assert torch.equal(one, other)
    for one, other in zip(whole_gradients, band_gradients):
        torch.testing.assert_close(other, one, rtol=0, atol=1e-12 * float(one.abs().max()))  # float64, other order


def test_later_pictures_leave_the_gradient_of_an_earlier_one_alone(scene):
    # Calls of the same size take turns in the same memory, but not while a gradient may still be asked for.
    first, second = (scene["vertices"].clone().requires_grad_() for _ in range(2))
    early = picture(scene, vertices=first)["color"].square().sum()
    picture(scene, vertices=second * 1.1)["color"].sum().backward()
    picture(scene, vertices=scene["vertices"] * 0.9)
    early.backward(retain_graph=True)
    once = first.grad.clone()
    early.backward()
    alone = scene["vertices"].clone().requires_grad_()
    picture(scene, vertices=alone)["color"].square().sum().backward()
    assert torch.equal(once, alone.grad)
    assert torch.equal(first.grad, 2 * alone.grad)


def test_an_empty_view_is_background_with_zero_gradient(scene):
    vertices = (scene["vertices"] + torch.tensor([0.0, 0.0, 5.0])).requires_grad_()  # behind the camera
    made = picture(scene, vertices=vertices)
    assert not made["mask"].any()
    sum(made[name].sum() for name in FLOATS).backward()
    assert not vertices.grad.any()


def test_degenerate_faces_leave_picture_and_gradient_finite(scene):
    vertices = scene["vertices"].clone()
    vertices[:, 5] = vertices[:, 6]
    vertices[:, 7] = vertices[:, 8] = vertices[:, 9]
    vertices.requires_grad_()
    made = picture(scene, vertices=vertices)
    sum(made[name].square().sum() for name in FLOATS).backward()
    assert all(torch.isfinite(made[name]).all() for name in FLOATS)
    assert torch.isfinite(vertices.grad).all()


def test_any_triangles_leave_picture_and_gradient_finite_and_memory_as_it_was(scene):
    # Slivers, points, faces through the eye, far outside and larger than the picture, each frame another mixture.
    generator = torch.Generator().manual_seed(0)
    before = None
    for turn in range(120):
        vertices = scene["vertices"].clone()
        chosen = torch.randperm(vertices.shape[1], generator=generator)[:12]
        scales = 10 ** (6 * torch.rand(12, 1, dtype=torch.float64, generator=generator) - 3)
        vertices[:, chosen] *= scales
        vertices[:, chosen[:4]] = vertices[:, chosen[4:5]]
        vertices.requires_grad_()
        made = picture(scene, vertices=vertices)
        sum(made[name].square().sum() for name in FLOATS).backward()
        assert all(torch.isfinite(made[name]).all() for name in FLOATS)
        assert torch.isfinite(vertices.grad).all()
        if turn == 20:
            before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20_000  # KiB; a leaked frame is 200


def test_a_picture_of_one_pixel_is_made(scene):
    assert picture(scene, height=1, width=1)["mask"].tolist() == [[[[1.0]]], [[[1.0]]]]


# Gradients


@pytest.mark.parametrize("buffer", FLOATS)
@pytest.mark.parametrize("kind", ["silhouettes", "fine texture", "sheets that meet"])
def test_gradients_of_a_buffer_match_finite_differences(scene, kind, buffer):
    # Along random directions each: vertices, colours, texture, attributes, light, camera.
    generator = torch.Generator().manual_seed(3)
    if kind == "fine texture":  # a pixel shows many texels, so that the level of detail takes part
        scene = {**scene, "texture": 0.2 + 0.6 * torch.rand(70, 41, 3, dtype=torch.float64, generator=generator)}
    elif kind == "sheets that meet":
        scene = {**scene, "vertices": meeting(scene["vertices"])}
    light = scene["light"]
    values = {
        "vertices": scene["vertices"], "colors": scene["colors"], "texture": scene["texture"],
        "light": light.position, "matrix": scene["camera"].world_to_camera, "attributes": scene["attributes"],
        "focal": torch.tensor(scene["camera"].focal, dtype=torch.float64), "coefficients": light.coefficients,
    }  # fmt: skip
    mix = None

    def loss(values: dict) -> torch.Tensor:
        nonlocal mix
        made = picture(
            scene, 14, 13, (buffer,), vertices=values["vertices"], colors=values["colors"], texture=values["texture"],
            light=Light(values["light"], *values["coefficients"]), camera=Camera(values["matrix"], values["focal"]),
            attributes=values["attributes"],
        )[buffer]  # fmt: skip
        mix = torch.randn(made.shape, dtype=made.dtype, generator=generator) if mix is None else mix
        return (made * mix).sum()

    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    gradients = torch.autograd.grad(loss(leaves), list(leaves.values()), allow_unused=True)
    for (name, value), gradient in zip(values.items(), gradients):
        for _ in range(4):
            direction = torch.randn(value.shape, dtype=value.dtype, generator=generator)
            step = 1e-7 * value.norm() / direction.norm()
            after, before = (loss({**values, name: value + sign * step * direction}).item() for sign in (1, -1))
            expected = (after - before) / (2 * step)
            found = 0.0 if gradient is None else (gradient * direction).sum()
            # Differences of 1e-7 in float64, and the slope of the kernel's sRGB curve, off by up to 6e-5 of it.
            scale = 1.0 if gradient is None else gradient.abs().max() * direction.norm()
            assert abs(expected - found) < 1e-4 * max(scale, 1e-3), name


@pytest.mark.parametrize("seed", [1, 2])
def test_gradients_for_weights_match_a_supersampled_picture_with_silhouettes(head, seed):
    # 4,842 vertices: triangles are smaller than pixels, which is where rules for large triangles lose the silhouettes.
    cosine, relative_error = gradient_accuracy(head, 64, seed=seed, shapes=16, samples=8)
    assert cosine >= 0.999
    assert relative_error < 0.05


# Twin


@pytest.fixture(params=["silhouettes", "fine texture", "sheets that meet"])
def variant(request, scene) -> dict:
    if request.param == "fine texture":
        generator = torch.Generator().manual_seed(5)
        return {**scene, "texture": torch.rand(70, 41, 3, dtype=torch.float64, generator=generator)}
    return {**scene, "vertices": meeting(scene["vertices"])} if request.param == "sheets that meet" else scene


def test_the_fused_kernels_make_the_picture_of_the_readable_stages(variant):
    scene = variant
    fused = picture(scene)
    staged = render_by_stages(**scene, height=24, width=20, background=GREY)
    torch.testing.assert_close(fused["color"], staged["color"], rtol=0, atol=1e-6)  # the kernel's sRGB: 6e-7
    for name in ("mask", "normals", "attributes"):
        torch.testing.assert_close(fused[name], staged[name], rtol=0, atol=1e-12)  # float64


def test_the_fused_kernels_have_the_gradient_of_the_readable_stages(variant):
    scene = variant
    generator = torch.Generator().manual_seed(0)
    vertices = scene["vertices"].clone().requires_grad_()
    fused = picture(scene, vertices=vertices)
    staged = render_by_stages(**{**scene, "vertices": vertices}, height=24, width=20, background=GREY)
    tolerances = {"color": 1e-5, "mask": 1e-10, "normals": 1e-10, "attributes": 1e-10}  # sRGB slope; float64
    for name, tolerance in tolerances.items():
        mix = torch.randn(fused[name].shape, dtype=torch.float64, generator=generator)
        found, expected = (
            torch.autograd.grad((made[name] * mix).sum(), vertices, retain_graph=True)[0] for made in (fused, staged)
        )
        assert (found - expected).abs().max() < tolerance * expected.abs().max()


def test_float32_and_float64_agree(scene):
    single = {
        name: value.float() if isinstance(value, torch.Tensor) and value.is_floating_point() else value
        for name, value in scene.items()
    }
    for name, tolerance in {"color": 2e-3, "mask": 1e-3, "depth": 1e-4}.items():
        # Positions of float32 in pixels: 1e-6; near a silhouette normals and colours are steep.
        difference = picture(single)[name].double() - picture(scene)[name]
        assert difference.abs().max() < tolerance, name


# Processes


_FRESH = """
import hashlib, sys, torch
sys.path[:0] = {paths!r}
from renderer import Head
head = Head(8)
for frames in {order}:  # one frame alone runs other kernels
    weights = torch.full((frames, 52), 0.2).requires_grad_()
    color = head.render(weights, 32)["color"]
    color.square().sum().backward()
    print(frames, hashlib.md5(color.detach().numpy().tobytes() + weights.grad.numpy().tobytes()).hexdigest())
"""


def test_pictures_do_not_depend_on_which_kernels_were_loaded_first():
    # Copies of one function in several kernels were compiled to different roundings, and the first one loaded won.
    root = Path(__file__).parents[1]
    outcomes = [
        subprocess.run(
            [sys.executable, "-c", _FRESH.format(paths=[str(root), str(root / "benchmarks")], order=order)],
            capture_output=True, text=True, check=True,
        ).stdout.splitlines()
        for order in ((1, 4), (4, 1))
    ]  # fmt: skip
    assert sorted(outcomes[0]) == sorted(outcomes[1])


def _mask_sum(queue) -> None:
    scene = bumpy_spheres()
    queue.put(picture(scene, buffers=("mask",))["mask"].sum().item())


@pytest.mark.skipif(sys.platform == "win32", reason="there is no fork on Windows")
def test_a_forked_process_renders_after_its_parent_did(scene):
    torch.set_num_threads(max(2, torch.get_num_threads()))
    expected = picture(scene)["mask"].sum().item()
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=_mask_sum, args=(queue,))
    child.start()
    assert queue.get(timeout=60) == expected
    child.join()


# What it refuses


def test_a_vertex_that_is_not_a_number_is_named(scene):
    vertices = scene["vertices"].clone()
    vertices[1, 17, 2] = torch.nan
    with pytest.raises(ValueError, match="vertex 17 of frame 1"):
        picture(scene, vertices=vertices)
    with pytest.raises(ValueError, match="camera: expected finite"):
        picture(scene, camera=Camera(scene["camera"].world_to_camera * torch.inf, 4.5))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"buffers": ("colour",)}, "expected names among color, mask"),
        ({"buffers": ("parts",)}, "pass vertex labels"),
        ({"height": 0}, "at least 1 x 1"),
        ({"vertices": torch.zeros(1, 84, 3, dtype=torch.float16)}, "float32 or float64"),
        ({"colors": torch.zeros(3, 3)}, "colors: expected one for each of 84 vertices, got 3"),
        ({"parts": torch.zeros(3, dtype=torch.int64)}, "parts: expected one for each"),
        ({"buffers": ("attributes",), "attributes": None}, "pass numbers of each vertex"),
        ({"buffers": ("attributes",), "attributes": torch.zeros(1, 84, 2)}, "attributes: expected \\(2, 84, A\\)"),
        ({"faces": torch.tensor([[0, 1, 84]]), "texture": None}, "check that faces and vertices belong"),
        ({"faces": torch.tensor([[0, 1, -1]]), "texture": None}, "check that faces and vertices belong"),
        ({"uv": None}, "pass uv"),
        ({"uv": torch.zeros(5, 2)}, "uv_faces: expected"),
    ],
)
def test_arguments_that_cannot_work_are_refused(scene, changes, message):
    bare = inspect.unwrap(render)  # without the shape checks of the test run, as users have it
    with pytest.raises(ValueError, match=message):
        bare(**{**scene, "height": 24, "width": 20, **changes})


def test_a_background_that_is_no_colour_is_refused(scene):
    with pytest.raises(ValueError, match="red, green, blue"):
        render(**scene, height=4, width=4, background=(0.5,))


def test_a_light_at_rest_in_world_space_is_moved_by_the_camera(scene):
    # The same scene seen after turning world, camera and light together.
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))).Q
    turn = turn * torch.linalg.det(turn)
    matrix = scene["camera"].world_to_camera
    turned = Camera(torch.cat([matrix[:, :3] @ turn.T, matrix[:, 3:]], 1), scene["camera"].focal)
    light: Light = replace(scene["light"], position=turn @ scene["light"].position)
    plain, moved = picture(scene), picture(scene, vertices=scene["vertices"] @ turn.T, camera=turned, light=light)
    torch.testing.assert_close(moved["color"], plain["color"], rtol=0, atol=1e-9)  # float64
