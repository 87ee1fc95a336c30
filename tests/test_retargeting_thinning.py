"""A thinned rig is the same face with fewer vertices, and pairs that are found on it hold on the whole one."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from conftest import make_toy_rig

from reenact.geometry import vertex_normals
from reenact.retargeting import correspondence
from reenact.retargeting.correspondence import find_correspondence
from reenact.retargeting.thinning import thinned
from reenact.rigs.files import load_rig


def divided(rig):
    """Each triangle in four; the old vertices come first."""
    faces = rig.faces.numpy()
    ends = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, place = np.unique(ends, axis=0, return_inverse=True)
    (a, b, c), (ab, bc, ca) = faces.T, len(rig.neutral) + place.reshape(-1, 3).T
    parts = [np.stack(each, 1) for each in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]

    def middles(values):
        between = (values[..., edges[:, 0], :] + values[..., edges[:, 1], :]) / 2
        return torch.cat([values, between], dim=-2)

    return replace(
        rig,
        neutral=middles(rig.neutral),
        deltas=middles(rig.deltas),
        faces=torch.from_numpy(np.concatenate(parts)),
        colors=None,
        parts=None,
    )


def test_a_small_rig_is_left_as_it_is(toy_rig):
    same, vertices = thinned(toy_rig, len(toy_rig.neutral))
    assert same is toy_rig
    assert torch.equal(vertices, torch.arange(len(toy_rig.neutral)))


def test_the_surface_stays_whole_and_its_vertices_where_they_were(toy_rig):
    fine = divided(divided(toy_rig))
    small, vertices = thinned(fine, 800)
    assert 700 < len(small.neutral) <= 800
    assert torch.equal(small.neutral, fine.neutral[vertices])
    assert torch.equal(small.deltas, fine.deltas[:, vertices])
    edges = np.sort(small.faces.numpy()[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert (count == 2).mean() > 0.98  # closed, but for a few corners where four neighbourhoods meet
    outwards = (vertex_normals(small.neutral, small.faces) * small.neutral).sum(1)
    assert float((outwards > 0).float().mean()) > 0.99  # no triangle is turned
    assert np.ptp(small.neutral.numpy(), axis=0) == pytest.approx(np.ptp(fine.neutral.numpy(), axis=0), rel=0.05)


def test_more_is_kept_where_the_face_moves(toy_rig):
    fine = divided(divided(toy_rig))
    moves = fine.deltas.norm(dim=-1).amax(0) > 0.02
    _, vertices = thinned(fine, 800)
    assert float(moves[vertices].float().mean()) > 1.5 * float(moves.float().mean())


def test_a_piece_that_is_too_small_to_keep_is_dropped():
    rig = make_toy_rig("ball")
    speck = 0.2 + 1e-4 * rig.neutral
    both = replace(
        rig,
        neutral=torch.cat([rig.neutral, speck]),
        deltas=torch.cat([rig.deltas, torch.zeros_like(rig.deltas)], dim=1),
        faces=torch.cat([rig.faces, rig.faces + len(rig.neutral)]),
        colors=None,
    )
    _, vertices = thinned(both, 300)
    assert int(vertices.max()) < len(rig.neutral)


def test_pairs_found_on_thinned_rigs_hold_on_the_whole_ones(monkeypatch):
    man, toon = divided(load_rig("anny:man")), load_rig("anny:toon")
    monkeypatch.setattr(correspondence, "MOST_VERTICES", 7000)
    pairs = find_correspondence(man, toon, None)
    own = pairs.source.corners[:, 0]
    known = own < len(toon.neutral)  # the old vertices have the same numbers on both heads
    miss = (pairs.target.of(toon.neutral)[known] - toon.neutral[own[known]]).norm(dim=1)
    miss, confidence = miss / np.ptp(toon.neutral[:, 1].numpy()), pairs.confidence[known]
    for sure, fewest, bound in ((0.5, 100, 0.006), (0.2, 300, 0.012)):
        assert int((confidence > sure).sum()) > fewest
        assert float(miss[confidence > sure].median()) < bound
