"""The truth by name: what a target should do, and what comes back of it."""

import pytest
import torch
from conftest import CLOUD_NAMES, make_cloud_rig

from reenact.metrics import vertex_error_ratio
from reenact.rigs import anny
from reenact.rigs.files import load_rig
from reenact.rigs.matching import matching
from reenact.rigs.rig import Rig
from reenact.truth import true_return, true_weights


def test_shapes_meet_across_spellings_and_exact_names():
    source = ("JawOpen", "odd one", "eyeBlink_L", "lonely")
    target = ("eyeBlinkLeft", "odd one", "jawOpen", "other")
    shared = matching(source, target)
    assert shared.tolist() == [[0, 0, 1, 0], [0, 1, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0]]
    assert not matching(("a",), ("b",)).any()


def test_both_halves_of_a_split_shape_do_what_the_whole_does_and_the_whole_their_mean():
    whole, halves = ("jawOpen", "browInnerUp"), ("browInnerUp_L", "jawOpen", "browInnerUp_R")
    assert matching(whole, halves).tolist() == [[0, 1, 0], [1, 0, 1]]
    assert matching(halves, whole).tolist() == [[0, 0.5], [1, 0], [0, 0.5]]


def test_a_rig_that_shares_all_names_should_copy():
    source, target = make_cloud_rig("left", seed=1), make_cloud_rig("right", CLOUD_NAMES[::-1], seed=2)
    weights = torch.rand(4, len(CLOUD_NAMES), generator=torch.Generator().manual_seed(0))
    known, truth, covered = true_weights(source, target, weights)
    assert torch.equal(known, weights)
    assert torch.equal(truth, weights.flip(1))
    assert covered == list(range(len(CLOUD_NAMES)))


@pytest.fixture
def merged(monkeypatch):
    """A pair of rigs of which one merges shapes of the other: a known matrix instead of shared ranges."""
    full = make_cloud_rig("anny:full", CLOUD_NAMES, seed=4)
    matrix = torch.zeros(len(CLOUD_NAMES), 3)
    matrix[0, 0], matrix[1, 1], matrix[2, 1], matrix[5, 2] = 0.5, 1.0, 1.0, 2.0
    names = ("jawOpen", "eyeBlink", "browInnerUp")
    rig = Rig("anny:part", full.neutral, torch.einsum("km,kvc->mvc", matrix, full.deltas), names, full.faces)
    monkeypatch.setattr(
        "reenact.truth._unmerged",
        lambda rig: (full, matrix) if rig.name == "anny:part" else (rig, torch.eye(len(rig.names))),
    )
    return rig, matrix


def test_a_merged_source_stands_for_the_shapes_it_was_made_from(merged):
    rig, matrix = merged
    weights = 0.5 * torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
    _, truth, covered = true_weights(rig, make_cloud_rig("right", seed=2), weights)
    torch.testing.assert_close(truth, weights @ matrix.T)
    assert len(covered) == len(CLOUD_NAMES)


def test_a_merged_target_gets_the_weights_that_show_the_same_face_not_the_same_numbers(merged):
    rig, matrix = merged
    expected = 0.5 * torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
    _, truth, covered = true_weights(make_cloud_rig("left", seed=1), rig, expected @ matrix.T)
    torch.testing.assert_close(truth, expected, rtol=0, atol=1e-5)  # float32 deltas
    assert covered == [0, 1, 2]
    strong = torch.zeros(1, len(CLOUD_NAMES))
    strong[0, 0] = 1.0  # would need a weight of 2
    truth = true_weights(make_cloud_rig("left", seed=1), rig, strong)[1]
    assert float(truth.max()) <= 1
    assert float(truth[0, 0]) > 0.99


def test_a_rig_of_other_shapes_has_the_truth_of_its_own_head_with_arkit_shapes():
    man, units = load_rig("anny:man"), load_rig("anny:units")
    assert not matching(man.names, units.names).any()
    weights = torch.zeros(1, 52)
    weights[0, man.names.index("jawOpen")] = 1
    known, truth, shared = true_weights(man, units, weights)
    assert torch.equal(known, weights)
    assert shared == list(range(34))
    head = anny.with_arkit_shapes("anny:units")
    assert torch.equal(head.neutral, units.neutral)
    wanted = head.vertices(weights) - head.neutral
    missed = units.vertices(truth) - units.neutral - wanted
    assert missed.norm() < 0.6 * wanted.norm()  # 34 other shapes come half as near


def test_what_a_merged_head_can_show_comes_back_exactly():
    man, merged = load_rig("anny:man"), load_rig("anny:merged")
    shown = torch.rand(6, len(merged.names), generator=torch.Generator().manual_seed(0)) * 0.4
    weights = shown @ anny.merged_matrix()[2].T
    known, truth, _ = true_weights(man, merged, weights)
    torch.testing.assert_close(known, weights)
    torch.testing.assert_close(true_return(man, merged, truth), weights, atol=1e-3, rtol=0)
    assert vertex_error_ratio(merged, true_return(merged, man, weights), shown) < 1e-3  # other weights may say the same
