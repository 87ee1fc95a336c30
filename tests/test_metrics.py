"""Metrics: every number in closed form."""

import math

import numpy as np
import pytest
import torch
from conftest import CLOUD_NAMES, make_cloud_rig
from skimage.metrics import structural_similarity

from reenact import metrics
from reenact.rigs.rig import Rig


@pytest.fixture(scope="module")
def rigs():
    return make_cloud_rig("left", seed=1), make_cloud_rig("right!", seed=2)


# Surfaces ------------------------------------------------------------------------------------------------------------


def test_vertex_error_ratio_of_one_shape_is_the_relative_error_of_its_weight():
    deltas = torch.zeros(1, 3, 3)
    deltas[0, 0] = torch.tensor([0.0, 3.0, 4.0])
    rig = Rig("one", torch.zeros(3, 3), deltas, ("a",), torch.tensor([[0, 1, 2]]))
    truth = torch.tensor([[0.4], [0.8]])
    predicted = torch.tensor([[0.3], [1.0]])
    # Errors 0.1 and 0.2 of 5 metres, motion 0.4 and 0.8 of 5 metres.
    assert metrics.vertex_error_ratio(rig, predicted, truth) == pytest.approx(0.3 / 1.2, rel=1e-6)
    error, motion = metrics.vertex_errors(rig, predicted, truth)
    torch.testing.assert_close(error, torch.tensor([0.5, 1.0]).double(), rtol=1e-6, atol=0)
    torch.testing.assert_close(motion, torch.tensor([2.0, 4.0]).double(), rtol=1e-6, atol=0)


def test_vertex_error_ratio_is_0_for_the_truth_1_for_the_neutral_and_ignores_the_size_of_the_rig(rigs):
    rig = rigs[0]
    truth = torch.rand(70, len(CLOUD_NAMES), generator=torch.Generator().manual_seed(0))  # more frames than one chunk
    predicted = truth.flip(0)
    assert metrics.vertex_error_ratio(rig, truth, truth) == 0
    assert metrics.vertex_error_ratio(rig, torch.zeros_like(truth), truth) == pytest.approx(1, rel=1e-6)
    big = Rig("big", 7 * rig.neutral, 7 * rig.deltas, rig.names, rig.faces)
    expected = metrics.vertex_error_ratio(rig, predicted, truth)
    assert metrics.vertex_error_ratio(big, predicted, truth) == pytest.approx(expected, rel=1e-5)


def test_vertex_error_ratio_agrees_with_whole_meshes_vertex_by_vertex(rigs):
    rig = rigs[1]
    generator = torch.Generator().manual_seed(3)
    predicted, truth = torch.rand(2, 70, len(CLOUD_NAMES), generator=generator)
    moving = (rig.deltas.norm(dim=-1) > 0.01 * rig.deltas.norm(dim=-1).max()).any(0)
    above = below = 0.0
    for a, b in zip(predicted, truth):
        shown, right = rig.vertices(a)[moving], rig.vertices(b)[moving]
        above += float((shown - right).norm(dim=-1).sum())
        below += float((rig.neutral[moving] - right).norm(dim=-1).sum())
    assert metrics.vertex_error_ratio(rig, predicted, truth) == pytest.approx(above / below, rel=1e-5)  # float32


def test_vertices_that_hardly_move_do_not_count():
    deltas = torch.zeros(2, 3, 3)
    deltas[0, 0, 0], deltas[1, 1, 0], deltas[1, 2, 0] = 1.0, 0.02, 0.005
    rig = Rig("two", torch.zeros(3, 3), deltas, ("a", "b"), torch.tensor([[0, 1, 2]]))
    assert metrics.moving_vertices(rig).tolist() == [0, 1]


def test_a_prediction_that_moves_where_the_truth_rests_is_infinitely_wrong(rigs):
    still = torch.zeros(3, len(CLOUD_NAMES))
    assert metrics.vertex_error_ratio(rigs[0], still + 0.1, still) == math.inf
    assert metrics.vertex_error_ratio(rigs[0], still, still) == 0


def test_the_interval_holds_the_ratio_and_shrinks_with_more_blocks():
    generator = torch.Generator().manual_seed(0)
    widths = []
    for count in (300, 4800):
        motion = 1 + torch.rand(count, generator=generator)
        error = 0.5 * motion * (0.5 + torch.rand(count, generator=generator))
        low, high = metrics.ratio_interval(error, motion)
        assert low < float(error.sum() / motion.sum()) < high
        widths.append(high - low)
    assert widths[1] < 0.5 * widths[0]  # 16 times the blocks: a quarter of the width
    assert metrics.ratio_interval(torch.zeros(60), torch.zeros(60)) == (0.0, 0.0)


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
    torch.testing.assert_close(metrics.apertures(lid_rig, truth, pairs), 1 - truth[:, 0], rtol=0, atol=1e-6)  # float32
    scores = metrics.lid_closure(lid_rig, predicted, truth, pairs)
    assert scores["error"] == pytest.approx(1.05 / 7, rel=1e-5)
    assert scores["blinks"] == 2
    assert scores["blink_f1"] == pytest.approx(2 / 3)  # one of two found, none invented: precision 1, recall 1/2


def test_lip_contact_of_known_gaps(lid_rig):
    shut = torch.tensor([[0.0, 0.001, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    lips = Rig("lips", shut, -lid_rig.deltas, ("open",), lid_rig.faces)
    pairs = torch.tensor([[0, 1]])
    truth = torch.tensor([[0.0], [1.0], [1.0], [0.0]])
    predicted = torch.tensor([[0.1], [1.0], [0.0], [0.0]])
    scores = metrics.lip_contact(lips, predicted, truth, pairs, face_height=10.0)
    assert scores["gap_error"] == pytest.approx(1.1 / 40, rel=1e-5)
    assert scores["contacts"] == 2
    assert scores["contact_f1"] == pytest.approx(2 / 3)  # one event found; precision 1, recall 1/2


def test_events_that_share_one_frame_meet():
    def events(text):
        return torch.tensor([letter == "x" for letter in text])

    assert metrics.event_f1(events(".xx..."), events("..xx..")) == 1
    assert metrics.event_f1(events(".x...."), events("...x..")) == 0
    assert metrics.event_f1(events("......"), events("......")) == 1
    assert metrics.event_f1(events("......"), events("x....x")) == 0
    assert metrics.event_f1(events("x.x.x."), events("x.....")) == pytest.approx(0.5)  # precision 1/3, recall 1


# Weights -------------------------------------------------------------------------------------------------------------


def test_weight_metrics_of_a_halved_motion():
    time = torch.linspace(0, 6.28, 50)
    truth = torch.stack([0.5 + 0.5 * time.sin(), 0.3 + 0.3 * time.cos(), torch.zeros(50)], dim=1)
    scores = metrics.weight_metrics(0.5 * truth, truth)
    assert scores["wmae"] == pytest.approx(float(0.5 * truth.mean()), rel=1e-5)
    assert scores["amae"] == pytest.approx(float(0.5 * truth[truth > 0.1].mean()), rel=1e-5)
    assert scores["correlation"] == pytest.approx(1, abs=1e-6)
    assert scores["gain"] == pytest.approx(0.5, rel=1e-5)
    assert scores["jitter"] == pytest.approx(0.5, rel=1e-4)  # second differences of float32 values near 1


def test_correlation_and_gain_are_those_of_numpy():
    generator = np.random.default_rng(0)
    truth = generator.random((80, 5))
    predicted = 0.6 * truth + 0.2 * generator.random((80, 5))
    scores = metrics.weight_metrics(torch.tensor(predicted), torch.tensor(truth))
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
    assert metrics.weight_metrics(predicted, truth)["correlation"] == pytest.approx(0.5)
    assert [row["moves"] for row in metrics.per_shape(predicted, truth)] == [True, True, False]
    still = metrics.weight_metrics(torch.zeros(4, 2), torch.zeros(4, 2))
    assert still == {"wmae": 0, "amae": 0, "correlation": 0, "gain": 0, "jitter": 1}


def test_jitter_counts_second_differences():
    truth = torch.tensor([[0.0], [1.0], [0.0], [1.0]])  # |-2| + |2|
    predicted = torch.tensor([[0.0], [1.0], [1.0], [1.0]])  # |-1| + |0|
    assert metrics.jitter(predicted, truth) == pytest.approx(0.25)
    assert metrics.jitter(predicted, torch.zeros(4, 1)) == math.inf


# Pictures ------------------------------------------------------------------------------------------------------------


def test_picture_scores_of_equal_pictures_are_perfect():
    pictures = torch.rand(2, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    assert metrics.image_mae(pictures, pictures).tolist() == [0, 0]
    torch.testing.assert_close(
        metrics.image_ssim(pictures, pictures), torch.ones(2).double(), rtol=0, atol=1e-6
    )  # float32 inside
    assert metrics.psnr(pictures, pictures) == math.inf
    assert float(metrics.error_map(pictures, pictures).max()) == 0


def test_picture_scores_of_a_constant_difference():
    black = torch.zeros(1, 3, 16, 16)
    grey = black + 0.1
    assert float(metrics.image_mae(grey, black)) == pytest.approx(0.1)
    assert metrics.psnr(grey, black) == pytest.approx(20, abs=1e-4)  # -10 log10(0.01)
    torch.testing.assert_close(metrics.error_map(grey, black), torch.full((16, 16), 0.1 * 3**0.5))
    # Without variance SSIM is the luminance term (2ab + C1) / (a^2 + b^2 + C1), here with b = 0.
    expected = 0.01**2 / (0.1**2 + 0.01**2)
    assert float(metrics.image_ssim(grey, black)) == pytest.approx(expected, rel=1e-4)


def test_masked_mae_sees_only_the_mask():
    black = torch.zeros(2, 3, 16, 16)
    picture, mask = black.clone(), torch.zeros(2, 1, 16, 16)
    picture[0, :, :8] = 0.4
    mask[0, :, :4] = 1
    assert metrics.masked_mae(picture, black, mask).tolist() == pytest.approx([0.4, 0.0])
    assert float(metrics.image_mae(picture, black)[0]) == pytest.approx(0.2)


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
    assert metrics.image_ssim(first, second).tolist() == pytest.approx(expected, rel=1e-6)  # float32 filters


def test_ssim_is_symmetric_and_falls_with_noise():
    generator = torch.Generator().manual_seed(0)
    clean = torch.rand(1, 3, 24, 24, generator=generator)
    noise = torch.randn(1, 3, 24, 24, generator=generator)
    scores = [float(metrics.image_ssim(clean + sigma * noise, clean)) for sigma in (0.01, 0.05, 0.2)]
    assert scores == sorted(scores, reverse=True)
    assert float(metrics.image_ssim(clean, clean + 0.2 * noise)) == pytest.approx(scores[-1], rel=1e-5)


def test_skill_is_0_for_the_neutral_and_1_for_no_error():
    assert metrics.skill(0.02, 0.02) == 0
    assert metrics.skill(0.0, 0.02) == 1
    assert metrics.skill(0.04, 0.02) == -1
