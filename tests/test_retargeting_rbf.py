import pytest
import torch
from conftest import make_toy_rig

from reenact.errors import ReenactError
from reenact.geometry import farthest_points
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.rbf import ProportionMatching, ThinPlate, carry_shapes
from reenact.rigs import motion
from reenact.rigs.clip import Clip


def random_points(count: int, seed: int) -> torch.Tensor:
    return torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def moved_rig(rig, turn: torch.Tensor, scale: float = 1.0, shift: float = 0.0):
    from dataclasses import replace

    turned = [scale * array @ turn.T.float() for array in (rig.neutral, rig.deltas)]
    return replace(rig, neutral=turned[0] + shift, deltas=turned[1])


def markers(source, target, count: int = 60) -> Correspondence:
    return Correspondence.identity(source, target)[farthest_points(source.neutral, count)]


TURN = torch.linalg.qr(random_points(3, 8))[0]
TURN = TURN * TURN.det().sign()


def test_the_map_goes_through_its_values():
    centers, values = random_points(40, 0), random_points(40, 1)
    torch.testing.assert_close(ThinPlate(centers, values)(centers), values, rtol=0, atol=1e-6)  # stiffness 1e-8


def test_an_affine_map_is_reproduced_everywhere_at_any_stiffness():
    centers, matrix, shift = random_points(20, 0), random_points(3, 2), random_points(1, 3)
    elsewhere = 5 * random_points(30, 4)
    for stiffness in (1e-8, 1.0, 1e4):
        plate = ThinPlate(centers, centers @ matrix.T + shift, stiffness)
        torch.testing.assert_close(plate(elsewhere), elsewhere @ matrix.T + shift, rtol=0, atol=1e-8)
        torch.testing.assert_close(plate.jacobian(elsewhere), matrix.expand(30, 3, 3), rtol=0, atol=1e-8)


def test_the_jacobian_is_the_derivative():
    plate = ThinPlate(random_points(15, 0), random_points(15, 1))
    point = random_points(4, 2)
    for row, jacobian in zip(point, plate.jacobian(point)):
        slow = torch.autograd.functional.jacobian(lambda x: _slow_map(plate, x), row)
        torch.testing.assert_close(jacobian, slow, rtol=0, atol=1e-9)


def _slow_map(plate, x):
    unit = (x - plate._middle) / plate._size
    return plate._affine[0] + unit @ plate._affine[1:] + (unit - plate._points).norm(dim=1) @ plate._kernel


def test_stiffness_trades_closeness_for_smoothness():
    centers, values = random_points(60, 0), random_points(60, 1)
    misses, bends = [], []
    for stiffness in (1e-8, 0.1, 10.0, 1e6):
        plate = ThinPlate(centers, values, stiffness)
        misses.append(float((plate(centers) - values).square().sum()))
        # Bending energy of the thin plate, -W^T |c_m - c_n| W, which is not negative where W sums to 0.
        bends.append(-float((plate._kernel.T @ torch.cdist(plate._points, plate._points) @ plate._kernel).trace()))
    assert misses == sorted(misses)
    assert bends == sorted(bends, reverse=True)
    affine = torch.cat([torch.ones(60, 1).double(), centers], 1)
    left = values - affine @ torch.linalg.lstsq(affine, values).solution
    assert misses[-1] == pytest.approx(float(left.square().sum()), rel=1e-4)  # the best affine map is the limit


def test_the_order_of_centers_does_not_matter_and_repeated_centers_count_once():
    centers, values, points = random_points(20, 0), random_points(20, 1), random_points(9, 2)
    plate = ThinPlate(centers, values)(points)
    order = torch.arange(19, -1, -1)
    torch.testing.assert_close(ThinPlate(centers[order], values[order])(points), plate, rtol=0, atol=1e-9)
    doubled = ThinPlate(torch.cat([centers, centers[:3]]), torch.cat([values, values[:3]]))
    torch.testing.assert_close(doubled(points), plate, rtol=0, atol=1e-6)  # stiffness 1e-8


def test_points_are_mapped_alike_few_at_a_time(monkeypatch):
    plate, points = ThinPlate(random_points(30, 0), random_points(30, 1)), random_points(50, 2)
    at_once = plate(points)
    monkeypatch.setattr("reenact.retargeting.rbf._DISTANCES", 100)
    torch.testing.assert_close(plate(points), at_once, rtol=0, atol=1e-12)


def test_flat_or_few_centers_are_an_error():
    flat = random_points(20, 0) * torch.tensor([1.0, 1.0, 0.0])
    for centers in (flat, random_points(3, 0)):
        with pytest.raises(ReenactError, match="one plane"):
            ThinPlate(centers, centers)


@pytest.mark.parametrize("linearised", [False, True])
def test_an_affine_actor_carries_shapes_by_the_same_affine_map(toy_rig, linearised):
    stretch = torch.diag(torch.tensor([1.0, 1.4, 0.9]))
    from dataclasses import replace

    actor = replace(toy_rig, neutral=toy_rig.neutral @ stretch)
    carried = carry_shapes(actor, toy_rig, markers(actor, toy_rig), linearised)
    expected = markers(actor, toy_rig).source.of(toy_rig.deltas.double()) @ stretch.double()
    torch.testing.assert_close(carried.guess, expected, rtol=0, atol=1e-7)  # float32 neutrals


def test_a_turned_actor_sees_turned_shapes(toy_pair):
    ball, egg = toy_pair
    pairs = markers(ball, egg)
    upright = carry_shapes(ball, egg, pairs).guess
    turned = carry_shapes(moved_rig(ball, TURN, shift=0.3), egg, pairs).guess
    torch.testing.assert_close(turned, upright @ TURN.T, rtol=0, atol=1e-6)  # float32 neutrals


def test_only_the_linearised_carry_is_proportional_to_the_offset(toy_pair):
    from dataclasses import replace

    ball, egg = toy_pair
    twice = replace(egg, deltas=2 * egg.deltas)
    # A pear rather than an egg: an affine target would make both ways the same.
    pear = ball.neutral * (1 + 3 * ball.neutral[:, 1:2])
    actor, pairs = replace(ball, neutral=pear), markers(ball, egg)
    straight = [carry_shapes(actor, rig, pairs, linearised=True).guess for rig in (egg, twice)]
    torch.testing.assert_close(2 * straight[0], straight[1], rtol=0, atol=1e-9)
    bent = [carry_shapes(actor, rig, pairs).guess for rig in (egg, twice)]
    assert float((2 * bent[0] - bent[1]).abs().max()) > 1e-4


def test_identical_rigs_keep_their_weights(toy_rig):  # G1, B9
    clip = Clip(toy_rig.names, motion.expressions(toy_rig.names, 40, seed=1), fps=30.0)
    matched = ProportionMatching(toy_rig, toy_rig, markers(toy_rig, toy_rig))(clip)
    torch.testing.assert_close(matched.weights, clip.weights, rtol=0, atol=1e-6)
    assert matched.fps == clip.fps


def test_scaling_the_target_changes_no_weight_and_neither_does_turning_either_rig(toy_pair):  # G3
    ball, egg = toy_pair
    clip = Clip(ball.names, motion.expressions(ball.names, 30, seed=2), fps=30.0)
    pairs = markers(ball, egg)
    expected = ProportionMatching(ball, egg, pairs)(clip).weights
    for source, target in (
        (ball, moved_rig(egg, torch.eye(3).double(), scale=7.0)),
        (ball, moved_rig(egg, TURN, shift=-0.2)),
        (moved_rig(ball, TURN, shift=0.1), egg),
    ):
        torch.testing.assert_close(
            ProportionMatching(source, target, pairs)(clip).weights, expected, rtol=0, atol=1e-4
        )  # float32 neutrals, through the condition of the fit


def test_the_neutral_goes_to_the_neutral_exactly(toy_pair):  # G2
    ball, egg = toy_pair
    still = Clip(ball.names, torch.zeros(2, 7), fps=24.0)
    assert not ProportionMatching(ball, egg, markers(ball, egg))(still).weights.any()


def test_mirrored_motion_gives_mirrored_weights(toy_pair):  # G4
    ball, egg = toy_pair
    mirror = torch.tensor([ball.names.index(n.replace("Left", "?").replace("Right", "Left").replace("?", "Right"))
                           for n in ball.names])  # fmt: skip
    # The ball is its own mirror image, vertex by vertex; its markers are made so too.
    partner = torch.cdist(ball.neutral * torch.tensor([-1.0, 1.0, 1.0]), ball.neutral).argmin(1)
    chosen = farthest_points(ball.neutral, 40)
    pairs = Correspondence.identity(ball, egg)[torch.cat([chosen, partner[chosen]]).unique()]
    weights = motion.expressions(ball.names, 30, seed=4)
    method = ProportionMatching(ball, egg, pairs)
    straight = method(Clip(ball.names, weights, 30.0)).weights
    mirrored = method(Clip(ball.names, weights[:, mirror], 30.0)).weights
    torch.testing.assert_close(mirrored, straight[:, mirror], rtol=0, atol=1e-4)  # float32 neutrals


def test_a_ramp_of_one_shape_makes_its_partner_rise_all_the_way(toy_pair):  # G11
    ball, egg = toy_pair
    method = ProportionMatching(ball, egg, markers(ball, egg, 150))
    for index, name in enumerate(ball.names):
        ramp = torch.zeros(11, 7)
        ramp[:, index] = torch.linspace(0, 1, 11)
        answer = method(Clip(ball.names, ramp, 30.0)).weights[:, egg.names.index(name)]
        assert bool((answer.diff() >= 0).all()), name
        assert float(answer[-1]) > 0.5, name


def test_ranges_of_motion_are_not_seen(toy_rig):  # SPEC 6.4, B8: scale 1 for all
    from dataclasses import replace

    rho = torch.tensor([0.5, 0.7, 1.0, 1.3, 1.6, 2.0, 0.8])
    actor = replace(toy_rig, deltas=rho[:, None, None] * toy_rig.deltas)
    method = ProportionMatching(actor, toy_rig, markers(actor, toy_rig))
    scales = method.carried.guess.flatten(1).norm(dim=1) / method.carried.source_shapes.flatten(1).norm(dim=1)
    torch.testing.assert_close(scales, 1 / rho.double(), rtol=1e-5, atol=0)  # float32 deltas
    half = Clip(actor.names, 0.4 * torch.eye(7), 30.0)
    torch.testing.assert_close(method(half).weights.diagonal(), 0.4 * rho, rtol=0, atol=1e-5)


def test_sparsity_takes_its_amount_from_a_shape_that_acts_alone(toy_rig):
    method = ProportionMatching(toy_rig, toy_rig, markers(toy_rig, toy_rig), sparsity=0.05)
    alone = method(Clip(toy_rig.names, 0.5 * torch.eye(7), 30.0)).weights.diagonal()
    assert bool((alone < 0.5).all())
    torch.testing.assert_close(alone[2], torch.tensor(0.45), rtol=0, atol=1e-3)  # the brow overlaps nothing


def test_other_topologies_and_shape_counts_work_and_results_repeat_bitwise(toy_rig):  # G10
    from dataclasses import replace

    target = make_toy_rig("egg", stretch=1.25)
    target = replace(target, deltas=target.deltas[:5], names=target.names[:5])
    clip = Clip(toy_rig.names, motion.expressions(toy_rig.names, 20, seed=1), 30.0)
    first, second = (ProportionMatching(toy_rig, target, markers(toy_rig, target))(clip).weights for _ in range(2))
    assert first.shape == (20, 5)
    assert bool((first == second).all())


def test_unusable_input_is_named(toy_pair):
    ball, egg = toy_pair
    with pytest.raises(ReenactError, match="needs a correspondence"):
        ProportionMatching(ball, egg)
    with pytest.raises(ReenactError, match="clip: expected the 7 shapes of ball"):
        ProportionMatching(ball, egg, markers(ball, egg))(Clip(("other",), torch.zeros(1, 1), 30.0))
