import time
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from conftest import make_random_rig
from scipy.optimize import nnls

from reenact.errors import ReenactError
from reenact.geometry import farthest_points
from reenact.retargeting.correspondence import Correspondence, Places
from reenact.retargeting.key_shapes import (
    KeyShapes,
    KeyShapesConfig,
    affine_motion,
    cluster_frames,
    convex_hull,
    decompose,
    in_plane_motion,
    pca_extremes,
    principal_scores,
    reconstruction_error,
    region_masks,
    without_affine_motion,
)
from reenact.rigs import motion
from reenact.rigs.clip import Clip


@pytest.fixture(scope="module")
def features() -> torch.Tensor:
    """Forty smooth frames of twelve coordinates, some noise, far from the origin."""
    rng = np.random.default_rng(0)
    drive = np.cumsum(rng.normal(size=(40, 5)), axis=0)
    track = drive @ rng.normal(size=(5, 12)) + 0.2 * rng.normal(size=(40, 12))
    return torch.tensor(track + 20)


def error(features: torch.Tensor, keys: torch.Tensor, **form) -> float:
    return reconstruction_error(features, keys, decompose(features, keys, **form))


def test_extremes_are_both_ends_of_each_axis_the_farther_first():
    # Frames 0 and 1 end the long axis, 2 and 3 the short one; the mean is the origin.
    features = torch.tensor([[5.0, 0.0], [-4.0, 0.0], [-0.5, 1.0], [-0.5, -1.0], [0.0, 0.0]])
    assert set(pca_extremes(features, 4)[:2].tolist()) == {0, 1}
    assert pca_extremes(features, 1).tolist() == [0]
    assert set(pca_extremes(features, 4).tolist()) == {0, 1, 2, 3}


def test_a_frame_that_is_extreme_twice_counts_once(features):
    frames = pca_extremes(features, 15)
    assert len(set(frames.tolist())) == len(frames) == 15
    assert len(pca_extremes(features, 40)) < 24  # twelve axes, and some frames are extreme on two


def test_weights_meet_the_optimality_conditions(features):  # A1
    keys = features[pca_extremes(features, 8)]
    weights = decompose(features, keys)
    for frame, row in zip(features.numpy(), weights.numpy()):
        np.testing.assert_allclose(row, nnls(keys.T.numpy(), frame)[0], atol=1e-6)  # slow twin; ridge 1e-12


@pytest.mark.parametrize("sum_to_one", [False, True])
def test_a_frame_that_is_a_key_shape_is_explained_without_error(features, sum_to_one):  # A2
    frames = pca_extremes(features, 6)
    weights = decompose(features[frames], features[frames], sum_to_one=sum_to_one)
    assert reconstruction_error(features[frames], features[frames], weights) < 1e-12 * float(features.square().sum())
    torch.testing.assert_close(weights, torch.eye(6, dtype=torch.float64), rtol=0, atol=1e-5)  # condition of the keys


def test_more_extremes_never_explain_less(features):  # A3, G8
    chosen = [pca_extremes(features, count) for count in range(1, 24)]
    for fewer, more in pairwise(chosen):
        assert more[: len(fewer)].tolist() == fewer.tolist()
    errors = [error(features, features[frames]) for frames in chosen]
    assert all(b <= a + 1e-9 * errors[0] for a, b in pairwise(errors))
    assert errors[-1] < 0.01 * errors[0]


def test_weights_that_may_be_negative_explain_at_least_as_much(features):  # A4
    for count in (2, 5, 9):
        keys = features[pca_extremes(features, count)]
        assert error(features, keys, negative=True) <= error(features, keys) * (1 + 1e-9)


def test_all_frames_as_key_shapes_leave_no_error(features):  # A5
    whole = float((features - features.mean(0)).square().sum())
    for form in ({}, {"sum_to_one": True}, {"negative": True}):
        assert error(features, features, **form) < 1e-9 * whole


def test_where_the_target_is_the_source_the_output_is_the_reconstruction(toy_rig):  # A6
    clip = motion.synthesize(toy_rig.names, 3.0, seed=5, kind="expressions")
    method = KeyShapes(toy_rig, toy_rig, training=clip, config=KeyShapesConfig(eyes=3, mouth=4))
    made = method.vertices(clip)
    expected = toy_rig.neutral.clone().expand_as(made).clone()
    for name, weights in method.decompose(clip).items():
        keys = toy_rig.vertices(method.key_weights[name]) - toy_rig.neutral
        expected += method.masks[name][:, None] * torch.einsum("tk,kvc->tvc", weights.float(), keys)
    torch.testing.assert_close(made, expected, rtol=0, atol=1e-6)  # float32
    every = KeyShapes(toy_rig, toy_rig, training=clip, config=KeyShapesConfig(eyes=90, mouth=90, median=1))
    torch.testing.assert_close(
        every.vertices(clip), toy_rig.vertices(clip.weights), rtol=0, atol=2e-4
    )  # places, not all vertices


def test_moving_all_shapes_changes_weights_only_without_the_sum(features):  # A7
    keys, shift = features[pca_extremes(features, 7)], torch.linspace(-30, 50, 12, dtype=torch.float64)
    here, there = (decompose(features + move, keys + move, sum_to_one=True) for move in (0, shift))
    torch.testing.assert_close(here, there, rtol=0, atol=1e-6)  # condition of the keys
    torch.testing.assert_close(here.sum(1), torch.ones(40, dtype=torch.float64), rtol=0, atol=1e-3)  # a penalty
    free = [decompose(features + move, keys + move) for move in (0, shift)]
    assert float((free[0] - free[1]).abs().max()) > 0.01


def test_negative_weights_distort_a_target_that_is_not_quite_the_source(features):  # A8, CB02 Fig. 4 and 5
    keys = features[pca_extremes(features, 21)]
    noise = torch.randn(keys.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    noise = noise / noise.norm(dim=1, keepdim=True)  # each traced key shape is off by 1
    added, size = {}, {}
    for negative in (False, True):
        weights = decompose(features, keys, negative=negative)
        added[negative] = (weights @ noise).norm(dim=1)
        size[negative] = weights.abs().sum(1)
        assert bool((added[negative] <= size[negative] + 1e-9).all())
    assert float(size[True].mean()) > 1.5 * float(size[False].mean())  # more keys than numbers: redundant
    assert float(added[True].mean()) > float(added[False].mean())


def test_the_hull_holds_every_score(features):  # A9
    scores = principal_scores(features, 2)
    corners = scores[convex_hull(features)]
    edges = corners.roll(-1, 0) - corners
    offsets = scores[:, None] - corners  # to the left of every edge of a counter-clockwise polygon
    assert bool((edges[:, 0] * offsets[..., 1] - edges[:, 1] * offsets[..., 0] >= -1e-9).all())


def test_clusters_find_the_groups_that_are_there():
    rng = np.random.default_rng(0)
    centers = np.array([[10.0, 0, 0, 0], [-10, 0, 0, 0], [0, 7, 0, 0]])
    features = torch.tensor(np.repeat(centers, 10, axis=0) + 0.1 * rng.normal(size=(30, 4)))
    labels = cluster_frames(features, 3)
    assert [len(set(labels[start : start + 10].tolist())) for start in (0, 10, 20)] == [1, 1, 1]
    assert len(set(labels.tolist())) == 3
    assert bool((cluster_frames(features, 3) == labels).all())


def test_smoothness_keeps_like_key_shapes_from_taking_turns():
    rng = np.random.default_rng(2)
    key = rng.normal(size=(1, 30))
    keys = torch.tensor(np.concatenate([key, key + 0.01 * rng.normal(size=(1, 30))]))
    features = torch.tensor(key + 0.05 * rng.normal(size=(40, 30)))
    swaps = [float(decompose(features, keys, smoothness=s).diff(dim=0).abs().mean()) for s in (0.0, 1e-3)]
    assert swaps[1] < 0.5 * swaps[0]


def test_affine_head_motion_is_found_and_removed():
    generator = torch.Generator().manual_seed(0)
    rest = torch.randn(20, 3, dtype=torch.float64, generator=generator)
    still = torch.arange(8)
    acting = rest.expand(5, -1, -1).clone()
    acting[:, 8:] += torch.randn(5, 12, 3, dtype=torch.float64, generator=generator)
    linear = torch.eye(3) + 0.2 * torch.randn(5, 3, 3, dtype=torch.float64, generator=generator)
    shift = torch.randn(5, 3, dtype=torch.float64, generator=generator)
    seen = acting @ linear.transpose(1, 2) + shift[:, None]
    found = affine_motion(seen, rest, still)
    torch.testing.assert_close(found[0], linear, rtol=0, atol=1e-9)
    torch.testing.assert_close(without_affine_motion(seen, *found), acting, rtol=0, atol=1e-9)
    # Without still points part of the acting is taken for head motion.
    assert float((without_affine_motion(seen, *affine_motion(seen, rest)) - acting).abs().max()) > 0.1


def test_a_turned_and_grown_picture_has_that_angle_and_scale():
    angle, scale = 0.3, 1.2
    turn = torch.tensor([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    rest = torch.randn(9, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    found = in_plane_motion(affine_motion((scale * rest @ turn.T)[None], rest)[0])
    assert float(found[0]) == pytest.approx(angle)
    assert float(found[1]) == pytest.approx(scale)


def test_points_on_a_plane_cannot_tell_three_dimensions():
    flat = torch.randn(9, 3) * torch.tensor([1.0, 1.0, 0.0])
    with pytest.raises(ReenactError, match="span 3 dimensions"):
        affine_motion(flat[None], flat)


def test_regions_blend_linearly_between_lips_and_eyes(toy_rig):
    masks = region_masks(toy_rig)  # no parts: told by the names
    torch.testing.assert_close(masks["eyes"] + masks["mouth"], torch.ones(len(toy_rig.neutral)))
    height = toy_rig.neutral[:, 1]
    assert bool((masks["eyes"][height > 0.04] == 1).all())
    assert bool((masks["mouth"][height < -0.04] == 1).all())
    between = (masks["eyes"] > 0) & (masks["eyes"] < 1)
    slopes = masks["eyes"][between] / (height[between] - height[between].min() + 1e-3)
    assert bool(between.any())
    assert bool(slopes.isfinite().all())
    order = height[between].argsort()
    assert bool((masks["eyes"][between][order].diff() >= 0).all())


def test_parts_tell_regions_where_names_do_not(toy_rig):
    parts = torch.zeros(len(toy_rig.neutral), dtype=torch.int64)
    parts[toy_rig.neutral[:, 1] > 0.06] = 3  # eyes
    parts[toy_rig.neutral[:, 1] < -0.06] = 1  # lips
    nameless = replace(toy_rig, names=tuple("abcdefg"), parts=parts)
    assert set(region_masks(nameless)) == {"eyes", "mouth"}
    assert set(region_masks(replace(nameless, parts=None))) == {"face"}


@pytest.mark.parametrize("selection", ["extremes", "clusters", "hull"])
@pytest.mark.parametrize("form", ["offsets", "sum_to_one"])
def test_the_neutral_goes_to_the_neutral(toy_pair, selection, form):  # G2
    config = KeyShapesConfig(selection=selection, form=form, eyes=4, mouth=5)
    still = Clip(toy_pair[0].names, torch.zeros(3, 7), 30.0)
    moved = KeyShapes(*toy_pair, config=config)(still)
    torch.testing.assert_close(moved.weights, torch.zeros(3, 7), rtol=0, atol=1e-6)  # the sum is a penalty


def test_the_published_form_moves_a_still_face(toy_pair):
    still = Clip(toy_pair[0].names, torch.zeros(3, 7), 30.0)
    assert KeyShapes(*toy_pair, config=KeyShapesConfig(form="absolute", eyes=4, mouth=5))(still).weights.any()


def test_regions_act_on_their_own(toy_pair):
    blink = torch.zeros(1, 7)
    blink[0, 0] = 1.0
    method = KeyShapes(*toy_pair, config=KeyShapesConfig(eyes=6, mouth=8))
    moved = method.vertices(Clip(toy_pair[0].names, blink, 30.0))[0] - toy_pair[1].neutral
    lengths = [float(moved[method.masks["eyes"] == share].norm(dim=1).max()) for share in (0, 1)]
    assert lengths[1] > 0.003
    assert lengths[0] < 0.02 * lengths[1]  # the bumps have tails


def test_an_artists_meshes_and_weights_are_summed_alike(toy_pair):
    ball, egg = toy_pair
    clip = motion.synthesize(ball.names, 2.0, seed=3, kind="expressions")
    config = KeyShapesConfig(eyes=5, mouth=6)
    first = KeyShapes(ball, egg, training=clip, config=config)
    sculpted = {name: weights.clone() for name, weights in first.key_weights.items()}
    by_weights = KeyShapes(ball, egg, training=clip, config=config, target_keys=sculpted)
    meshes = {name: egg.vertices(weights) for name, weights in sculpted.items()}
    by_meshes = KeyShapes(ball, egg, training=clip, config=config, target_keys=meshes)
    torch.testing.assert_close(by_weights(clip).weights, first(clip).weights)
    torch.testing.assert_close(by_meshes.vertices(clip), by_weights.vertices(clip), rtol=0, atol=1e-6)
    assert bool((by_meshes(clip).weights >= 0).all())
    assert [int(frames.max()) < len(clip) for frames in first.frames.values()] == [True, True]


def test_a_correspondence_sculpts_for_rigs_without_common_names(toy_pair):
    ball, egg = toy_pair
    other = replace(egg, names=tuple("abcdefg"))
    pairs = Correspondence.identity(ball, other)[farthest_points(ball.neutral, 100)]
    clip = motion.synthesize(ball.names, 3.0, seed=5, kind="expressions")
    moved = KeyShapes(ball, other, pairs, config=KeyShapesConfig(eyes=9, mouth=14))(clip)
    assert moved.names == other.names
    assert float((moved.weights - clip.weights).abs().mean()) < 0.5 * float(clip.weights.abs().mean())


def test_features_may_be_given_seen_from_the_front_and_snapped(toy_rig):
    places = Places.at(torch.arange(0, len(toy_rig.neutral), 4))
    config = KeyShapesConfig(selection="clusters", snap=True, projected=True, eyes=3, mouth=4)
    training = motion.synthesize(toy_rig.names, 4.0, seed=1, kind="expressions")
    method = KeyShapes(toy_rig, toy_rig, training=training, config=config, features=places)
    for name, frames in method.frames.items():
        torch.testing.assert_close(method.key_weights[name], training.weights[frames])


def test_results_repeat_bitwise(toy_pair):  # G10
    clip = motion.synthesize(toy_pair[0].names, 2.0, seed=3)
    for selection in ("extremes", "clusters"):
        config = KeyShapesConfig(selection=selection, eyes=4, mouth=5)
        first, second = (KeyShapes(*toy_pair, config=config)(clip).weights for _ in range(2))
        assert bool((first == second).all())


def test_a_clip_of_the_papers_length_is_decomposed_in_a_tenth_of_a_second():
    rng = np.random.default_rng(0)
    features = torch.tensor(rng.normal(size=(400, 10)) @ rng.normal(size=(10, 180)) + rng.normal(size=(400, 180)))
    keys = features[pca_extremes(features, 14)]
    decompose(features, keys)  # compiles
    times = []
    for _ in range(5):
        start = time.thread_time()
        decompose(features, keys)
        times.append(time.thread_time() - start)
    assert min(times) < 0.1


def test_unusable_input_is_named(toy_rig):
    still = Clip(toy_rig.names, torch.zeros(5, 7), 30.0)
    with pytest.raises(ReenactError, match="expected motion in the region"):
        KeyShapes(toy_rig, toy_rig, training=still)
    with pytest.raises(ReenactError, match="at least two frames"):
        KeyShapes(toy_rig, toy_rig, training=Clip(toy_rig.names, torch.zeros(1, 7), 30.0))
    with pytest.raises(ReenactError, match="expected regions eyes, mouth, got face"):
        KeyShapes(toy_rig, toy_rig, target_keys={"face": torch.zeros(1, 7)})
    with pytest.raises(ReenactError, match="target key shapes of the eyes"):
        KeyShapes(toy_rig, toy_rig, target_keys={"eyes": torch.zeros(1, 2), "mouth": torch.zeros(1, 2)})
    with pytest.raises(ReenactError, match="vary in two directions"):
        convex_hull(torch.linspace(0, 1, 9)[:, None] * torch.ones(4))
    with pytest.raises(ReenactError, match="number of frames"):
        pca_extremes(torch.zeros(3, 2), 4)
    rig = make_random_rig(0)
    with pytest.raises(ReenactError, match="a region where none does"):
        KeyShapes(replace(rig, deltas=torch.zeros_like(rig.deltas)), rig)
