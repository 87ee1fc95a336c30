"""Patchwise blendshapes: plain blendshapes as their limits, what more patches gain, and no seams."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.sparse import csr_array

from reenact.errors import ReenactError
from reenact.retargeting import plbs
from reenact.retargeting.correspondence import Correspondence, Places
from reenact.retargeting.plbs import PatchConfig, Patches, PatchwiseBlendshapes, partition
from reenact.rigs import motion
from reenact.rigs.rig import Rig

FREE = PatchConfig(patches=20, overlap=0.0, smoothness=0.0, ridge=1e-9)
"""Every patch for itself."""


@pytest.fixture(scope="module")
def examples(toy_pair):
    weights = motion.expressions(toy_pair[0].names, 4, seed=1)
    return tuple(rig.vertices(weights) for rig in toy_pair)


@pytest.fixture(scope="module")
def frames(toy_pair):
    return toy_pair[0].vertices(motion.expressions(toy_pair[0].names, 30, seed=2))


def blendshapes(rig: Rig, examples, frames, ridge: float = 0.0):
    """LBS the slow, obvious way: weights of all frames by one dense least squares."""
    basis = (examples - rig.neutral).double().flatten(1).T  # (3 V, E)
    system = basis.T @ basis + ridge * torch.eye(len(examples), dtype=torch.float64)
    return torch.linalg.solve(system, basis.T @ (frames - rig.neutral).double().flatten(1).T).T


def error(found, truth) -> float:
    return float((found - truth).square().sum())


@pytest.mark.parametrize(
    "metis", [False, pytest.param(True, marks=pytest.mark.skipif(plbs.pymetis is None, reason="no METIS"))]
)
def test_patches_share_every_vertex_out_whole(toy_rig, metis):
    for count, rings in ((1, 2), (20, 0), (80, 2)):
        patches = Patches.of(toy_rig, count, rings, metis)
        assert len(patches) == count
        np.testing.assert_allclose(patches.shares.sum(1), 1, rtol=0, atol=1e-12)  # a division
        if rings == 0:
            assert patches.shares.nnz == len(toy_rig.neutral)
    labels = partition(toy_rig, 80, metis)
    assert np.bincount(labels).min() >= 2
    assert np.bincount(labels).max() < 4 * len(labels) / 80
    np.testing.assert_array_equal(labels, partition(toy_rig, 80, metis))


def test_a_share_falls_like_a_cosine_with_the_distance_to_its_patch(toy_rig):
    patches = Patches.of(toy_rig, 8, 2, metis=False)
    labels = partition(toy_rig, 8, metis=False)
    steps = plbs.mesh_graph(toy_rig) > 0
    shares = patches.shares[:, [3]].toarray().ravel()
    raw = _heights(steps, labels == 3)
    np.testing.assert_array_equal(shares > 0, raw > 0)
    # The whole of a vertex is shared by all patches that reach it, each with its own height.
    heights = sum(_heights(steps, labels == patch) for patch in range(8))
    np.testing.assert_allclose(shares, raw / heights, rtol=0, atol=1e-12)  # a division


def _heights(steps, reached):
    raw = np.zeros(len(reached))
    for height in (1.0, 0.75, 0.25):  # (1 + cos(pi d / 3)) / 2 at d = 0, 1, 2
        raw[reached & (raw == 0)] = height
        reached = reached | (steps @ reached)
    return raw


def test_loose_pieces_are_tied_to_what_lies_beside_them(toy_rig):
    small = replace(toy_rig, neutral=toy_rig.neutral * 0.1 + torch.tensor([0.0, 0.05, 0.12]))
    both = Rig(
        "two",
        torch.cat([toy_rig.neutral, small.neutral]),
        torch.cat([toy_rig.deltas, small.deltas], 1),
        toy_rig.names,
        torch.cat([toy_rig.faces, toy_rig.faces + len(toy_rig.neutral)]),
    )
    bridge = (plbs.mesh_graph(both) - plbs.mesh_graph(both, bridges=False)).tocoo()
    a, b = (int(index) for index in bridge.coords[0][:2])
    assert bridge.nnz == 2
    assert {a < 642, b < 642} == {True, False}
    distances = torch.cdist(toy_rig.neutral, small.neutral)
    assert bridge.data[0] == pytest.approx(float(distances.min()), rel=1e-5)


def test_one_patch_is_plain_blendshapes(toy_pair, examples, frames):  # D1
    for rings in (0, 2):
        config = PatchConfig(patches=1, rings=rings, ridge=1e-12)
        method = PatchwiseBlendshapes(*toy_pair, *examples, config=config)
        expected = blendshapes(toy_pair[0], examples[0], frames)
        weights = method.weights(frames)
        torch.testing.assert_close(weights[:, 0], expected, rtol=0, atol=1e-6)
        moved = toy_pair[1].neutral + torch.einsum(
            "te,evc->tvc", expected, (examples[1] - toy_pair[1].neutral).double()
        )
        torch.testing.assert_close(method(frames), moved, rtol=0, atol=1e-8)


def test_equal_weights_in_all_patches_are_plain_blendshapes(toy_pair, examples, frames):  # D4
    config = PatchConfig(patches=20, smoothness=1e7, ridge=0.0)
    weights = PatchwiseBlendshapes(*toy_pair, *examples, config=config).weights(frames)
    expected = blendshapes(toy_pair[0], examples[0], frames)
    torch.testing.assert_close(weights, expected[:, None].expand_as(weights), rtol=0, atol=1e-4)  # 1e7 is not infinity


def test_an_example_is_given_back(toy_pair, examples):  # D2
    method = PatchwiseBlendshapes(*toy_pair, *examples)
    for rig, found, truth in zip(
        toy_pair, (method.explained(method.weights(examples[0])), method(examples[0])), examples
    ):
        assert error(found, truth) ** 0.5 < 1e-3 * error(rig.neutral, truth) ** 0.5


def test_patches_explain_no_worse_than_plain_blendshapes(toy_pair, examples, frames):  # D3
    plain = PatchwiseBlendshapes(*toy_pair, *examples, config=replace(FREE, patches=1))
    errors = [
        error(method.explained(method.weights(frames)), frames)
        for method in (PatchwiseBlendshapes(*toy_pair, *examples, config=FREE), plain)
    ]
    assert errors[0] < 0.7 * errors[1]  # on this ball, whose bumps lie apart


def test_each_frame_is_explained_no_worse_by_patches(toy_pair, examples, frames):  # D3, frame by frame
    methods = [PatchwiseBlendshapes(*toy_pair, *examples, config=replace(FREE, patches=n)) for n in (20, 1)]
    ours, plain = ((m.explained(m.weights(frames)) - frames).square().sum((1, 2)) for m in methods)
    assert bool((ours <= plain * (1 + 1e-6)).all())


def test_another_example_never_hurts_the_explanation(toy_pair, frames):  # D9
    source, target = toy_pair
    weights = motion.expressions(source.names, 6, seed=4)
    last = None
    for count in range(1, 7):
        method = PatchwiseBlendshapes(
            source, target, source.vertices(weights[:count]), target.vertices(weights[:count]), config=FREE
        )
        errors = (method.explained(method.weights(frames)) - frames).square().sum((1, 2))
        if last is not None:
            assert bool((errors <= last * (1 + 1e-6) + 1e-12).all())
        last = errors


def jumps(method, toy_pair, examples, frames):
    """How far the mixture of the examples jumps along each edge, in heights of the target, and which edges cross."""
    target = toy_pair[1]
    mixed = torch.from_numpy(method.target_patches.shares.toarray()) @ method.weights(frames)  # (T, V, E)
    first, second = target.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).T
    deltas = (examples[1] - target.neutral).double()[:, first]
    # The same offsets, mixed as on one end of an edge and as on the other: what is left is the jump of the weights.
    jump = torch.einsum("tne,enc->tnc", mixed[:, first] - mixed[:, second], deltas).norm(dim=-1)
    owner = torch.from_numpy(method.target_patches.shares.toarray().argmax(1))
    return jump / float(np.ptp(target.neutral[:, 1].numpy())), owner[first] != owner[second]


def test_no_seams_show(toy_pair, examples, frames):  # D5
    method = PatchwiseBlendshapes(*toy_pair, *examples)
    jump, crosses = jumps(method, toy_pair, examples, frames)
    # These are patches of eight vertices, so that every edge lies in an overlap; borders stand out from it little.
    assert float(jump[:, crosses].max()) < 0.005
    assert float(jump[:, crosses].square().mean().sqrt()) < 0.001
    agreeing = PatchwiseBlendshapes(*toy_pair, *examples, config=PatchConfig(overlap=10.0))
    assert float(jumps(agreeing, toy_pair, examples, frames)[0].max()) < 0.001
    cut = PatchwiseBlendshapes(*toy_pair, *examples, config=PatchConfig(rings=0))
    assert float(jumps(cut, toy_pair, examples, frames)[0].max()) > 3 * float(jump.max())


def test_turned_inputs_give_turned_outputs(toy_pair, examples, frames):  # D8
    axis = torch.tensor([[0.0, -0.3, 0.2], [0.3, 0.0, -0.5], [-0.2, 0.5, 0.0]])
    turn, shift = torch.linalg.matrix_exp(axis), torch.tensor([0.1, -0.2, 0.3])
    moved = [replace(rig, neutral=rig.neutral @ turn.T + shift, deltas=rig.deltas @ turn.T) for rig in toy_pair]
    straight = PatchwiseBlendshapes(*toy_pair, *examples)(frames)
    turned = PatchwiseBlendshapes(*moved, *(each @ turn.T + shift for each in examples))(frames @ turn.T + shift)
    expected = straight @ turn.T.double() + shift
    torch.testing.assert_close(turned, expected, rtol=0, atol=1e-6)  # float32 inputs


def test_size_and_density_of_units_do_not_matter(toy_pair, examples, frames):
    source, target = toy_pair
    large = replace(source, neutral=source.neutral * 1000, deltas=source.deltas * 1000)
    weights = PatchwiseBlendshapes(source, target, *examples).weights(frames)
    found = PatchwiseBlendshapes(large, target, examples[0] * 1000, examples[1]).weights(frames * 1000)
    torch.testing.assert_close(found, weights, rtol=0, atol=1e-4)  # float32 inputs


def test_patches_are_carried_to_another_mesh(toy_pair, examples, frames):
    source, target = toy_pair
    order = torch.randperm(642, generator=torch.manual_seed(0))
    back = order.argsort()
    shuffled = replace(
        target,
        neutral=target.neutral[order],
        deltas=target.deltas[:, order],
        faces=back[target.faces],
        colors=target.colors[order],
    )
    pairs = Correspondence.identity(source, target)
    pairs = Correspondence(pairs.source, Places.at(back), pairs.confidence)
    method = PatchwiseBlendshapes(source, shuffled, examples[0], examples[1][:, order], pairs)
    same = PatchwiseBlendshapes(source, target, *examples, Correspondence.identity(source, target))
    torch.testing.assert_close(method(frames)[:, back], same(frames), rtol=0, atol=1e-9)
    # A vertex without partner belongs where its neighbour does.
    followed = csr_array(np.diag(np.r_[np.zeros(1), np.ones(641)]))
    carried = same.patches.carried(source, source, followed, smoothing=0)
    nearest = torch.cdist(source.neutral[:1], source.neutral[1:]).argmin() + 1
    np.testing.assert_allclose(carried.shares[[0]].toarray(), carried.shares[[int(nearest)]].toarray())


def test_a_frayed_border_is_smoothed(toy_rig):
    patches = Patches.of(toy_rig, 2, rings=0)
    labels = patches.shares.toarray().argmax(1)
    edges = toy_rig.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).numpy()
    frayed = labels.copy()
    border = np.unique(edges[labels[edges[:, 0]] != labels[edges[:, 1]]])
    frayed[border[::2]] = 1 - frayed[border[::2]]
    followed = csr_array((np.ones(642), (np.arange(642), [np.flatnonzero(labels == label)[0] for label in frayed])))
    followed = csr_array((followed.data, followed.indices, followed.indptr), shape=(642, 642))

    def jump(smoothing) -> float:
        shares = patches.carried(toy_rig, toy_rig, followed, smoothing).shares.toarray()
        return float(np.abs(shares[edges[:, 0]] - shares[edges[:, 1]]).max())

    assert jump(0) == 1
    assert jump(6) < 0.5


def test_pieces_without_pairs_keep_to_their_like(toy_rig):
    """An eyeball in front of the face follows the source's eyeball, not the skin behind it."""
    small = torch.cat([toy_rig.neutral * 0.1 + torch.tensor([x, 0.05, 0.12]) for x in (-0.04, 0.04)])
    neutral = torch.cat([toy_rig.neutral, small])
    faces = torch.cat([toy_rig.faces + 642 * piece for piece in range(3)])
    rig = Rig("eyed", neutral, torch.zeros(1, len(neutral), 3), ("nod",), faces)
    other = replace(rig, neutral=rig.neutral * 1.5)
    pairs = csr_array((np.ones(642), (np.arange(642), np.arange(642))), shape=(len(neutral),) * 2)
    patches = Patches.of(rig, 40)
    carried = patches.carried(rig, other, pairs, smoothing=0)
    np.testing.assert_allclose(carried.shares.toarray(), patches.shares.toarray(), rtol=0, atol=1e-12)


def test_a_still_clip_and_no_frames_are_fine(toy_pair, examples):
    method = PatchwiseBlendshapes(*toy_pair, *examples)
    still = method(toy_pair[0].neutral.expand(2, -1, 3))
    torch.testing.assert_close(still, toy_pair[1].neutral.double().expand(2, -1, 3), rtol=0, atol=1e-12)
    assert method(toy_pair[0].neutral.expand(0, -1, 3)).shape == (0, 642, 3)
    dead = PatchwiseBlendshapes(*toy_pair, *(rig.neutral.expand(2, -1, 3) for rig in toy_pair))
    assert torch.isfinite(dead(examples[0])).all()


def test_unusable_input_is_named(toy_pair, examples):
    source, target = toy_pair
    with pytest.raises(ReenactError, match="ball: expected meshes of 642 vertices, got 5"):
        PatchwiseBlendshapes(source, target, torch.zeros(4, 5, 3), examples[1])
    with pytest.raises(ReenactError, match="as many examples of both, got 4 and 2"):
        PatchwiseBlendshapes(source, target, examples[0], examples[1][:2])
    with pytest.raises(ReenactError, match="expected at least 1, got 0"):
        Patches.of(source, 0)
    method = PatchwiseBlendshapes(source, target, *examples)
    with pytest.raises(ReenactError, match=r"expected weights \(frames, 80, 4\), got \(1, 2, 4\)"):
        method.shown(torch.zeros(1, 2, 4))
    with pytest.raises(ReenactError, match="expected a correspondence, got none"):
        PatchwiseBlendshapes(source, replace(target, faces=target.faces[1:]), *examples)
    with pytest.raises(ReenactError, match="expected shares that sum to 1"):
        Patches(csr_array(np.full((3, 2), 0.4)), np.zeros((0, 2), np.int64))


def test_metis_is_named_where_it_is_missing(toy_rig, monkeypatch):
    monkeypatch.setattr(plbs, "pymetis", None)
    with pytest.raises(ReenactError, match="not installed"):
        partition(toy_rig, 5, metis=True)
    assert partition(toy_rig, 5).max() == 4
