"""Delta transfer: numbers worked out by hand, laws, and the artifact that it is known for."""

import math
from dataclasses import replace

import pytest
import torch
from conftest import make_toy_rig

from reenact.errors import ReenactError
from reenact.retargeting.correspondence import Correspondence, Places
from reenact.retargeting.deformation_transfer import DeformationTransfer
from reenact.retargeting.delta_transfer import DeltaTransfer, smallest_rotations
from reenact.rigs import motion
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig


def transfer(source: Rig, target: Rig, **settings) -> DeltaTransfer:
    return DeltaTransfer(source, target, Correspondence.identity(source, target), **settings)


def sheet(tilt: float = 0.0, stretch: float = 1.0, size: float = 1.0) -> Rig:
    """A 5 x 5 grid 4 cm wide whose one shape lifts the middle by 1 cm along +z, tilted about y, stretched along x."""
    x, y = torch.meshgrid(*[torch.linspace(-0.02, 0.02, 5)] * 2, indexing="ij")
    points = torch.stack([x, y, torch.zeros_like(x)], 2).reshape(25, 3) * size
    points[:, 0] *= stretch
    turn = torch.tensor([[math.cos(tilt), 0, math.sin(tilt)], [0, 1, 0], [-math.sin(tilt), 0, math.cos(tilt)]])
    deltas = torch.zeros(1, 25, 3)
    deltas[0, 12, 2] = 0.01 * size
    corner = (torch.arange(4)[:, None] * 5 + torch.arange(4)).reshape(-1)
    faces = torch.cat(
        [torch.stack([corner, corner + 5, corner + 6], 1), torch.stack([corner, corner + 6, corner + 1], 1)]
    )
    return Rig("sheet", points @ turn.T, deltas @ turn.T, ("lift",), faces)


def test_equal_rigs_return_their_own_shapes_and_weights():
    rig = make_toy_rig("ball")
    method = transfer(rig, rig)
    torch.testing.assert_close(method.shapes.deltas, rig.deltas, rtol=0, atol=1e-7)  # shapes of 20 mm in float32
    clip = Clip(rig.names, motion.expressions(rig.names, 40, seed=1), 30.0)
    torch.testing.assert_close(method(clip).weights, clip.weights, rtol=0, atol=1e-5)  # float32 shapes


def test_an_offset_grows_with_the_head():
    # 1 cm on a sheet of 4 cm is 3 cm on one of 12 cm.
    shapes = transfer(sheet(), sheet(size=3.0)).shapes
    torch.testing.assert_close(shapes.deltas[0, 12], torch.tensor([0.0, 0.0, 0.03]), rtol=0, atol=1e-7)


@pytest.mark.parametrize("turn", [True, False])
def test_an_offset_turns_with_the_normal_if_asked_to(turn):
    # The target's normal leans to +x by 30 degrees; a lift along the normal leans with it.
    shapes = transfer(sheet(), sheet(tilt=math.pi / 6), turn=turn).shapes
    expected = [0.005, 0.0, 0.01 * math.cos(math.pi / 6)] if turn else [0.0, 0.0, 0.01]
    torch.testing.assert_close(shapes.deltas[0, 12], torch.tensor(expected), rtol=0, atol=1e-7)


def test_the_global_scale_is_that_of_the_best_similarity():
    # Doubled along x, kept along y, equal spreads along both: least squares gives (2 + 1) / 2.
    lift = transfer(sheet(), sheet(stretch=2.0)).shapes.deltas[0, 12, 2]
    assert float(lift) == pytest.approx(0.015, abs=1e-6)


def test_the_local_scale_is_how_much_longer_edges_are():
    # 20 edges along x double, 20 along y stay, 16 diagonals grow from root 2 to root 5; three rings weigh the middle
    # ones more, so that the figure for the whole sheet holds about.
    lift = transfer(sheet(), sheet(stretch=2.0), scale="local").shapes.deltas[0, 12, 2]
    expected = (20 * 2 + 20 + 16 * math.sqrt(5)) / (20 + 20 + 16 * math.sqrt(2))
    assert float(lift) == pytest.approx(0.01 * expected, rel=0.02)


def test_the_local_scale_is_local():
    rig = make_toy_rig("ball")
    swollen = replace(rig, neutral=rig.neutral * torch.where(rig.neutral[:, 1:2] > 0, 2.0, 1.0))  # upper half
    sizes = transfer(rig, swollen, scale="local", turn=False).shapes.deltas.norm(dim=-1) / rig.deltas.norm(dim=-1)
    names = rig.names
    top, bottom = (rig.deltas[names.index(name)].norm(dim=-1).argmax() for name in ("browInnerUp", "jawOpen"))
    assert float(sizes[names.index("browInnerUp"), top]) == pytest.approx(2.0, abs=0.05)
    assert float(sizes[names.index("jawOpen"), bottom]) == pytest.approx(1.0, abs=0.05)


def test_smallest_rotations_take_one_direction_to_the_other():
    generator = torch.manual_seed(0)
    start, end = torch.randn(2, 50, 3, generator=generator, dtype=torch.float64)
    start = torch.nn.functional.normalize(start, dim=1) * 3
    rotations = smallest_rotations(start, end)
    unit = torch.nn.functional.normalize(end, dim=1)
    torch.testing.assert_close(torch.einsum("nij,nj->ni", rotations, start) / 3, unit, rtol=0, atol=1e-9)
    axis = torch.linalg.cross(start, end)
    torch.testing.assert_close(torch.einsum("nij,nj->ni", rotations, axis), axis, rtol=0, atol=1e-9)
    opposite = torch.tensor([[0.0, 1, 0]])
    torch.testing.assert_close(smallest_rotations(opposite, -opposite)[0], torch.eye(3))
    torch.testing.assert_close(smallest_rotations(opposite, 0 * opposite)[0], torch.eye(3))


@pytest.mark.parametrize("scale", ["head", "local"])
def test_scaling_the_target_scales_its_motion_and_changes_no_weight(toy_pair, scale):
    source, target = toy_pair
    large = replace(target, neutral=target.neutral * 4, deltas=target.deltas * 4)
    methods = [transfer(source, rig, scale=scale) for rig in (target, large)]
    torch.testing.assert_close(methods[1].shapes.deltas, 4 * methods[0].shapes.deltas, rtol=0, atol=1e-6)
    clip = Clip(source.names, motion.expressions(source.names, 20, seed=2), 30.0)
    torch.testing.assert_close(methods[1](clip).weights, methods[0](clip).weights, rtol=0, atol=1e-5)


def test_turning_both_rigs_turns_the_result(toy_pair):
    turn, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.manual_seed(3)))
    turn = turn * torch.linalg.det(turn)
    turned = [replace(rig, neutral=rig.neutral @ turn.T, deltas=rig.deltas @ turn.T) for rig in toy_pair]
    plain = transfer(*toy_pair).shapes.deltas
    torch.testing.assert_close(transfer(*turned).shapes.deltas, plain @ turn.T, rtol=0, atol=1e-6)


def test_turning_a_jaw_changes_the_volume_of_a_longer_one_where_deformation_transfer_keeps_it():
    """The artifact of the method: offsets know nothing of what they do to the surface."""
    ball, egg = make_toy_rig("ball"), make_toy_rig("egg", stretch=1.5)
    angle = math.radians(40)
    turn = torch.tensor([[1.0, 0, 0], [0, math.cos(angle), -math.sin(angle)], [0, math.sin(angle), math.cos(angle)]])
    ball = replace(ball, names=("jawOpen",), deltas=(ball.neutral @ turn.T - ball.neutral)[None])

    def change(shapes: Rig) -> float:
        def volume(vertices: torch.Tensor) -> float:
            a, b, c = vertices[shapes.faces].double().unbind(1)
            return float((a * torch.linalg.cross(b, c)).sum()) / 6

        return abs(volume(shapes.neutral + shapes.deltas[0]) / volume(shapes.neutral) - 1)

    assert change(ball) < 1e-5
    assert change(DeformationTransfer(ball, egg, Correspondence.identity(ball, egg)).shapes) < 1e-4
    assert change(transfer(ball, egg, turn=False).shapes) > 0.03


def test_mirrored_expressions_give_mirrored_weights(toy_pair):
    source, target = toy_pair
    weights = torch.zeros(2, len(source.names))
    weights[0, source.names.index("mouthSmileLeft")] = weights[1, source.names.index("mouthSmileRight")] = 0.7
    left, right = transfer(source, target)(Clip(source.names, weights, 30.0)).weights
    swap = [
        source.names.index(name.replace("Left", "?").replace("Right", "Left").replace("?", "Right"))
        for name in source.names
    ]
    torch.testing.assert_close(right, left[swap], rtol=0, atol=1e-3)  # the ball's triangles are not quite symmetric


def test_a_neutral_clip_stays_neutral_and_ramps_rise(toy_pair):
    method = transfer(*toy_pair)
    names = toy_pair[0].names
    still = method(Clip(names, torch.zeros(2, len(names)), 24.0))
    assert still.fps == 24.0
    assert float(still.weights.abs().max()) < 1e-6
    torch.testing.assert_close(method.vertices(Clip(names, torch.zeros(1, len(names)), 24.0))[0], toy_pair[1].neutral)
    for k in range(len(names)):
        ramp = torch.zeros(11, len(names))
        ramp[:, k] = torch.linspace(0, 0.8, 11)
        assert bool((method(Clip(names, ramp, 30.0)).weights[:, k].diff() > 0).all())


def test_results_repeat_to_the_bit(toy_pair):
    clip = Clip(toy_pair[0].names, motion.expressions(toy_pair[0].names, 20, seed=4), 30.0)
    first, second = (transfer(*toy_pair, scale="local") for _ in range(2))
    assert torch.equal(first.shapes.deltas, second.shapes.deltas)
    assert torch.equal(first(clip).weights, second(clip).weights)


def test_rigs_of_different_topology_and_shapes_meet(toy_pair):
    source, target = toy_pair
    fewer = replace(target, names=target.names[:4], deltas=target.deltas[:4])
    order = torch.randperm(len(target.neutral), generator=torch.manual_seed(1))
    place = order.argsort()
    shuffled = replace(
        fewer, neutral=fewer.neutral[order], deltas=fewer.deltas[:, order], faces=place[fewer.faces], colors=None
    )
    pairs = Correspondence(Places.at(order), Places.at(torch.arange(len(order))), torch.ones(len(order)))
    clip = Clip(source.names, motion.expressions(source.names, 10, seed=5), 30.0)
    found, expected = DeltaTransfer(source, shuffled, pairs)(clip), transfer(source, fewer)(clip)
    assert found.names == target.names[:4]
    torch.testing.assert_close(found.weights, expected.weights, rtol=0, atol=1e-5)


def test_unusable_input_is_named(toy_pair):
    source, target = toy_pair
    with pytest.raises(ReenactError, match="ball to egg: expected a correspondence, got none"):
        DeltaTransfer(source, target)
    for method in (transfer(source, target), transfer(source, target).vertices):
        with pytest.raises(ReenactError, match="expected the 7 shapes of ball"):
            method(Clip(("jawOpen",), torch.zeros(1, 1), 30.0))
