from dataclasses import replace

import jaxtyping
import pytest
import torch
from conftest import make_random_rig

from reenact.errors import ReenactError
from reenact.rigs.rig import PARTS, Rig


@pytest.fixture(scope="module")
def triangle() -> Rig:
    neutral = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    deltas = torch.zeros(2, 3, 3)
    deltas[0, 0, 2] = 1.0
    deltas[1, 1] = torch.tensor([0.5, 0.0, -1.0])
    return Rig("triangle", neutral, deltas, ("a", "b"), torch.tensor([[0, 1, 2]]))


def test_an_expression_is_the_neutral_plus_weighted_offsets(triangle):
    vertices = triangle.vertices(torch.tensor([[0.5, 0.0], [1.0, 0.5]]))
    expected = torch.tensor([[[0, 0, 0.5], [1, 0, 0], [0, 1, 0]], [[0, 0, 1.0], [1.25, 0, -0.5], [0, 1, 0]]])
    torch.testing.assert_close(vertices, expected, rtol=0, atol=1e-7)  # sums of a few exact binary fractions


def test_no_weights_leave_the_neutral():
    rig = make_random_rig(1)
    assert torch.equal(rig.vertices(torch.zeros(4, 3)), rig.neutral.expand(4, -1, -1))


def test_vertices_carry_gradient_to_the_weights(triangle):
    weights = torch.zeros(2, dtype=torch.float32, requires_grad=True)
    triangle.vertices(weights)[..., 2].sum().backward()
    assert torch.equal(weights.grad, torch.tensor([1.0, -1.0]))  # the z offsets of each shape, summed


def test_part_lists_the_vertices_of_all_named_parts(triangle):
    parts = torch.tensor([PARTS.index("eyes"), PARTS.index("skin"), PARTS.index("teeth")])
    assert replace(triangle, parts=parts).part("eyes", "teeth").tolist() == [0, 2]
    assert triangle.part("eyes").tolist() == []


def test_a_rig_on_the_same_device_is_the_same_rig(triangle):
    moved = triangle.to("cpu")
    assert moved.names == triangle.names
    assert torch.equal(moved.deltas, triangle.deltas)


@pytest.fixture
def without_shape_checks():
    """As users run it: the checks of this test run would refuse some of the shapes first."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


BAD = {
    "deltas": ({"deltas": torch.zeros(1, 3, 3)}, "expected deltas"),
    "no vertices": ({"neutral": torch.zeros(0, 3), "deltas": torch.zeros(2, 0, 3)}, "at least one blendshape"),
    "doubled names": ({"names": ("a", "a")}, "doubled: a"),
    "face outside": ({"faces": torch.tensor([[0, 1, 3]])}, "outside 0..2"),
    "NaN": ({"neutral": torch.full((3, 3), float("nan"))}, "neutral holds NaN"),
    "colors": ({"colors": torch.zeros(2, 3)}, "expected 3 colors"),
    "parts": ({"parts": torch.zeros(4, dtype=torch.int64)}, "expected 3 parts"),
    "texture without uv": ({"texture": torch.zeros(2, 2, 3)}, "no uv"),
    "uv faces": ({"uv": torch.zeros(2, 2)}, "uv faces do not match"),
}


@pytest.mark.parametrize(("change", "message"), BAD.values(), ids=BAD)
def test_a_rig_that_cannot_work_is_refused_by_name(triangle, change, message, without_shape_checks):
    with pytest.raises(ReenactError, match=f"^triangle: .*{message}"):
        replace(triangle, **change)


def test_weights_of_another_rig_are_refused(triangle):
    with pytest.raises(ReenactError, match=r"expected weights \(..., 2\), got \(3,\)"):
        triangle.vertices(torch.zeros(3))
