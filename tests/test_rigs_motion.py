import numpy as np
import pytest
import torch

from reenact.errors import ReenactError
from reenact.rigs import arkit, motion

OTHER = ("eye-left-closure", "eye-right-closure", "mouth-open", "nose-left-elevation", "nose-right-elevation")
MERGED = ("eyeBlink", "jawOpen", "mouthSmile", "browInnerUp", "mouthPucker")


@pytest.fixture(scope="module")
def many() -> np.ndarray:
    return motion.expressions(arkit.NAMES, 20_000, seed=1).numpy()


def column(weights, name):
    return weights[:, arkit.NAMES.index(name)]


def test_expressions_are_weights_most_of_them_zero(many):
    assert many.min() == 0
    assert many.max() <= 1
    # A mean of 3 units of 1.5 shapes or so, of 52.
    assert 3 < (many > 0).sum(1).mean() < 5
    assert ((many > 0).any(1)).all()


def test_a_pair_correlates_by_four_fifths(many):
    for base in ("mouthDimple", "noseSneer", "cheekSquint", "mouthLowerDown"):
        correlation = np.corrcoef(column(many, base + "Left"), column(many, base + "Right"))[0, 1]
        assert correlation == pytest.approx(0.8, abs=0.05)  # 1,500 active of 20,000: standard error 0.01


def test_one_sided_expressions_exist(many):
    left, right = column(many, "eyeBlinkLeft"), column(many, "eyeBlinkRight")
    assert ((left > 0.8) & (right == 0)).sum() > 20
    assert ((right > 0.8) & (left == 0)).sum() > 20


def test_blinks_are_twice_as_frequent_as_other_pairs(many):
    ratio = (column(many, "eyeBlinkLeft") > 0).mean() / (column(many, "noseSneerLeft") > 0).mean()
    assert 1.6 < ratio < 2.2  # a little under 2, drawing without replacement


def test_every_shape_is_drawn_over_its_whole_range(many):
    assert (many.max(0) > 0.9).all()
    assert ((many > 0).mean(0) > 0.05).all()


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("jawLeft", "jawRight"),
        ("mouthSmileLeft", "mouthFrownLeft"),
        ("mouthPucker", "mouthStretchRight"),
        ("eyeLookUpLeft", "eyeLookDownLeft"),
        ("eyeLookInRight", "eyeLookOutRight"),
        ("eyeLookOutLeft", "eyeLookOutRight"),
        ("eyeBlinkLeft", "eyeWideLeft"),
    ],
)
def test_shapes_that_exclude_each_other_have_a_small_product(many, one, other):
    assert (column(many, one) * column(many, other)).max() < motion.BOTH


def test_eyes_look_the_same_way(many):
    correlation = np.corrcoef(column(many, "eyeLookInLeft"), column(many, "eyeLookOutRight"))[0, 1]
    assert correlation > 0.9
    assert ((column(many, "eyeLookInLeft") > 0) == (column(many, "eyeLookOutRight") > 0)).all()


def test_a_closed_mouth_needs_an_open_jaw(many):
    assert (column(many, "mouthClose") <= column(many, "jawOpen")).all()
    assert (column(many, "mouthClose") > 0).mean() > 0.05


def test_a_seed_repeats_and_a_generator_goes_on():
    assert torch.equal(motion.expressions(arkit.NAMES, 8, 5), motion.expressions(arkit.NAMES, 8, 5))
    generator = np.random.default_rng(5)
    first, second = motion.expressions(arkit.NAMES, 8, generator), motion.expressions(arkit.NAMES, 8, generator)
    assert torch.equal(first, motion.expressions(arkit.NAMES, 8, 5))
    assert not torch.equal(first, second)


def test_unknown_names_are_paired_by_side_and_otherwise_free():
    weights = motion.expressions(OTHER, 20_000, seed=2).numpy()
    assert np.corrcoef(weights[:, 0], weights[:, 1])[0, 1] > 0.5  # below 0.8, with three units most are active
    assert abs(np.corrcoef(weights[:, 0], weights[:, 2])[0, 1]) < 0.3
    assert (weights.max(0) > 0.9).all()


def test_one_shape_is_enough():
    assert motion.expressions(("smile",), 4, seed=0).shape == (4, 1)


def test_split_and_merged_rigs_keep_the_rules():
    split = ("browInnerUp_L", "browInnerUp_R", "jawOpen", "mouthClose")
    weights = motion.expressions(split, 4000, seed=3).numpy()
    assert np.corrcoef(weights[:, 0], weights[:, 1])[0, 1] > 0.5
    assert (weights[:, 3] <= weights[:, 2]).all()
    gaze = motion.expressions(("eyeLookLeft", "eyeLookRight", "jawOpen"), 4000, seed=3).numpy()
    assert (gaze[:, 0] * gaze[:, 1]).max() < motion.BOTH
    assert motion.expressions(MERGED, 4000, seed=3).numpy().max(0).min() > 0.9


@pytest.mark.parametrize("kind", motion.KINDS)
@pytest.mark.parametrize("names", [arkit.NAMES, OTHER, MERGED], ids=["arkit", "other", "merged"])
def test_every_kind_makes_a_clip_for_any_names(kind, names):
    clip = motion.synthesize(names, 6.0, seed=4, fps=24.0, kind=kind)
    assert clip.names == tuple(names)
    assert clip.weights.shape == (144, len(names))
    assert clip.weights.min() >= 0
    assert clip.weights.max() <= 1
    assert clip.weights.max() > 0.3  # something happens
    assert torch.equal(clip.weights, motion.synthesize(names, 6.0, seed=4, fps=24.0, kind=kind).weights)
    assert not torch.equal(clip.weights, motion.synthesize(names, 6.0, seed=5, fps=24.0, kind=kind).weights)


@pytest.mark.parametrize("kind", motion.KINDS)
def test_one_frame_is_a_clip(kind):
    assert motion.synthesize(arkit.NAMES, 1 / 30, seed=0, kind=kind).weights.shape == (1, 52)


@pytest.mark.parametrize("names", [arkit.NAMES, MERGED, OTHER, ("only",)], ids=["arkit", "merged", "other", "one"])
@pytest.mark.parametrize("kind", motion.KINDS)
def test_clips_shorter_than_any_event_are_clips(kind, names):
    for seed in range(20):
        for frames in (1, 2, 3, 4, 6, 15):
            clip = motion.synthesize(names, frames / 30, seed=seed, kind=kind)
            assert clip.weights.shape == (frames, len(names))
            assert clip.weights.min() >= 0
            assert clip.weights.max() <= 1


def test_mixed_motion_keeps_the_rules():
    weights = motion.synthesize(arkit.NAMES, 60.0, seed=6).weights.numpy()
    assert (column(weights, "mouthClose") <= column(weights, "jawOpen")).all()
    for one, other in (("mouthSmileLeft", "mouthFrownLeft"), ("jawLeft", "jawRight"), ("eyeBlinkLeft", "eyeWideLeft")):
        assert (column(weights, one) * column(weights, other)).max() < motion.BOTH


def test_blinks_come_every_three_seconds_and_last_150_ms():
    lids = column(
        motion.synthesize(arkit.NAMES, 600.0, seed=7, fps=60.0, kind="blinks").weights.numpy(), "eyeBlinkLeft"
    )
    starts = ((lids[1:] > 0) & (lids[:-1] == 0)).sum()
    assert starts / 600 == pytest.approx(0.3, abs=0.06)  # 180 Poisson events: standard deviation 13
    assert (lids > 0).sum() / 60 / starts == pytest.approx(0.15, abs=0.017)  # one frame
    assert lids.max() == 1


def test_a_blink_closes_the_eye_on_some_frame_at_30_fps():
    lids = column(motion.synthesize(arkit.NAMES, 120.0, seed=8, kind="blinks").weights.numpy(), "eyeBlinkLeft")
    peaks = (lids[1:-1] >= lids[:-2]) & (lids[1:-1] > lids[2:])
    assert lids[1:-1][peaks].min() > 0.95


def test_ramps_move_one_shape_at_a_time_and_reach_one():
    weights = motion.synthesize(arkit.NAMES, 20.0, seed=9, kind="ramps").weights.numpy()
    assert (weights.max(0) == 1).all()
    alone = np.delete(weights, arkit.NAMES.index("jawOpen"), axis=1)  # goes along with mouthClose
    assert ((alone > 0).sum(1) <= 1).all()
    assert (column(weights, "mouthClose") <= column(weights, "jawOpen")).all()


def test_springs_stay_between_what_they_follow():
    table = motion._table(("a", "b"))
    weights = motion._springs(table, np.arange(3000) / 30, np.random.default_rng(0))
    assert weights.min() >= 0
    assert weights.max() <= 1
    assert np.abs(np.diff(weights, axis=0)).max() < 14 / np.e / 30 * 1.05  # steepest step response is stiffness / e


def test_speech_has_no_jumps_faster_than_its_blend():
    weights = motion.synthesize(arkit.NAMES, 30.0, seed=10, fps=240.0, kind="speech").weights.numpy()
    # Half a cosine over 80 ms rises by at most pi / 2 / 0.08 of 0.85 a second; two may overlap.
    assert np.abs(np.diff(weights, axis=0)).max() < 2 * np.pi / 2 / 0.08 * 0.85 / 240


BAD = {
    "kind": ({"kind": "speach"}, "did you mean speech"),
    "far kind": ({"kind": "xyz"}, "expected a kind among"),
    "no length": ({"seconds": 0.0}, "positive length"),
    "endless": ({"seconds": float("inf")}, "positive length"),
    "rate": ({"fps": -1.0}, "positive length and rate"),
    "too long": ({"seconds": 1e6}, "at most 1,000,000 frames"),
    "doubled": ({"names": ("a", "a")}, "all different"),
    "none": ({"names": ()}, "at least one"),
}


@pytest.mark.parametrize(("change", "message"), BAD.values(), ids=BAD)
def test_a_clip_that_cannot_be_made_is_refused(change, message):
    with pytest.raises(ReenactError, match=message):
        motion.synthesize(**({"names": arkit.NAMES, "seconds": 1.0, "seed": 0} | change))


def test_crowded_expressions_move_many_shapes_and_stay_valid():
    sparse, dense = (motion.expressions(arkit.NAMES, 500, 3, crowded) for crowded in (0.0, 1.0))
    assert torch.equal(sparse, motion.expressions(arkit.NAMES, 500, 3))
    assert (dense > 0.02).sum(1).float().mean() > 3 * (sparse > 0.02).sum(1).float().mean()
    assert dense.max() <= 1
    product = dense[:, arkit.NAMES.index("jawLeft")] * dense[:, arkit.NAMES.index("jawRight")]
    assert product.max() <= motion.BOTH + 1e-6  # float32


def test_the_tongue_stays_in_in_most_crowded_expressions_and_moves_as_often_as_others_elsewhere():
    tongue = arkit.NAMES.index("tongueOut")
    usual, dense = (motion.expressions(arkit.NAMES, 2000, 3, crowded) > 0.01 for crowded in (0.0, 1.0))
    assert usual[:, tongue].float().mean() > 0.8 * usual.float().mean()
    assert dense[:, tongue].float().mean() < 0.5 * dense.float().mean()


def test_uneven_expressions_move_most_shapes_hardly_and_a_few_far():
    even, uneven = (motion.expressions(arkit.NAMES, 2000, 3, 1.0, share) for share in (0.0, 1.0))
    assert torch.equal(even, motion.expressions(arkit.NAMES, 2000, 3, 1.0))
    usual, spread = (torch.quantile(each[each > 0], torch.tensor([0.1, 0.95])) for each in (even, uneven))
    assert spread[0] < usual[0] / 3
    assert spread[1] > usual[1]
    assert uneven.max() <= 1
    assert torch.equal(motion.expressions(arkit.NAMES, 500, 3, 0.0, 1.0), motion.expressions(arkit.NAMES, 500, 3))
