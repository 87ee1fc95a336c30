"""What is done to a finished clip, by hand-made numbers."""

from dataclasses import replace

import pytest
import torch

from reenact.config import PostConfig, config_from_dict, load_config, save_config
from reenact.errors import ReenactError
from reenact.postprocessing import postprocess, smoothed
from reenact.rigs.clip import Clip

NAMES = ("jawOpen", "eyeBlinkLeft", "eyeBlinkRight")


def finished(weights: list[list[float]], **settings) -> list[list[float]]:
    return postprocess(Clip(NAMES, torch.tensor(weights), 10.0), PostConfig(**settings)).weights.tolist()


def test_nothing_is_done_unless_asked():
    clip = Clip(NAMES, torch.rand(5, 3), 30.0)
    assert postprocess(clip, PostConfig()) is clip


def test_gain_offset_limits_and_locks_apply_in_this_order():
    assert finished([[0.5, 0.5, 0.5]], gain={"jaw*": 2.0}, offset={"jawOpen": 0.25}) == [[1.25, 0.5, 0.5]]
    assert finished([[0.5, 0.5, 0.5]], gain={"jaw*": 2.0}, high={"*": 0.75}, low={"eye*": 0.625}) == [
        [0.75, 0.625, 0.625]
    ]
    assert finished([[0.5, 0.5, 0.5]], high={"*": 0.25}, lock={"EYEBLINKLEFT": 0.875}) == [[0.25, 0.875, 0.25]]


def test_the_last_pattern_that_fits_counts():
    assert finished([[0.5, 0.5, 0.5]], gain={"*": 0.0, "eyeBlink*": 1.0, "eyeBlinkRight": 2.0}) == [[0.0, 0.5, 1.0]]


def test_the_face_that_rests_becomes_zero_and_a_full_shape_stays_full():
    weights = [[0.9, 0.0, 0.0], [0.25, 0.2, 0.0], [0.25, 0.2, 0.0], [1.0, 0.6, 0.5], [0.0, 0.0, 0.0]]
    made = finished(weights, rest=0.1, rest_seconds=0.2)
    torch.testing.assert_close(
        torch.tensor(made),
        torch.tensor([[0.8667, 0.0, 0.0], [0, 0, 0], [0, 0, 0], [1.0, 0.5, 0.5], [0, 0, 0]]),
        rtol=0,
        atol=1e-4,  # four decimals written down
    )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"gain": {"smirk": 1.0}}, "post.gain: no shape is called smirk; the clip has jawOpen"),
        ({"rest": 9.0}, "a time within the clip of 0.10 s, got 9 s"),
        ({"low": {"jaw*": 0.5}, "high": {"*": 0.25}}, "jawOpen: expected post.low below post.high"),
    ],
)
def test_what_cannot_be_done_is_explained(settings, message):
    with pytest.raises(ReenactError, match=message):
        finished([[0.5, 0.5, 0.5]], **settings)


def test_smoothing_takes_noise_and_leaves_blinks():
    generator = torch.Generator().manual_seed(0)
    blink = torch.zeros(300, 1)
    for start in range(20, 300, 60):
        blink[start : start + 5, 0] = torch.tensor([0.5, 1.0, 1.0, 0.6, 0.2])
    noise = 0.02 * torch.randn(300, 1, generator=generator)
    made = smoothed(blink + noise, width=3.0, reach=0.08)
    still = blink[:, 0] == 0
    assert made[still].std() < 0.5 * noise[still].std()
    peaks = blink[:, 0] == 1
    assert (made[peaks] - blink[peaks]).abs().max() < 0.06  # three times the noise: a peak is its two frames alone
    # A mean over as many frames without regard to value halves the blink.
    frames = torch.arange(300.0)
    blurred = torch.exp(-0.5 * ((frames[:, None] - frames) / 3) ** 2) @ blink / (3 * 2.5066)
    assert blurred[peaks].max() < 0.5


def test_smoothing_lays_the_parabola_that_the_formula_says():
    """A slow twin: weighted least squares around each frame by itself."""
    weights, width, reach = torch.rand(9, 2, generator=torch.Generator().manual_seed(0)).double(), 0.8, 0.3
    expected = torch.zeros(9, 2).double()
    for t in range(9):
        near = range(max(0, t - 2), min(9, t + 3))
        time = torch.tensor([(s - t) / width for s in near]).double()
        for k in range(2):
            values = torch.stack([weights[s, k] for s in near])
            trust = torch.exp(-0.5 * ((values - weights[t, k]) / reach) ** 2 - 0.5 * time**2)
            powers = torch.stack([time**0, time, time**2], 1) * trust.sqrt()[:, None]
            ridge = torch.diag(torch.tensor([0, 1e-3, 1e-3]).double().sqrt())  # as further rows that ask for zero
            rows = torch.cat([powers, ridge]), torch.cat([values * trust.sqrt(), torch.zeros(3).double()])
            expected[t, k] = torch.linalg.lstsq(*rows, driver="gelsd").solution[0].clamp(values.min(), values.max())
    torch.testing.assert_close(smoothed(weights, width, reach), expected, rtol=0, atol=1e-10)


def test_smoothing_leaves_a_slow_smile_its_top_and_goes_nowhere_that_nobody_was():
    frames = torch.arange(60.0)
    smile = (1 - ((frames - 30) / 20) ** 2).clamp_min(0)[:, None]
    made = smoothed(smile, width=2.0, reach=0.5)
    assert float(made[30]) == pytest.approx(1.0, abs=1e-4)  # the mean of the same neighbours is 0.99
    assert 0 <= float(made.min()) <= float(made.max()) <= 1


def test_settings_with_names_survive_the_file(tmp_path):
    config = replace(config_from_dict({}), post=PostConfig(gain={"jaw*": 1.5, 'a "b"': 0.0}, lock={"x": 1.0}))
    config = replace(config, source_parts=("Head*", "Eyes"), target_shapes=("ü",))
    save_config(config, tmp_path / "x.toml")
    assert load_config(tmp_path / "x.toml") == config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("source_parts = 'Head'", 'source_parts: expected a list of texts, got the text "Head"'),
        ("source_parts = ['']", "source_parts: expected names or patterns, got an empty one"),
        ("[post]\ngain = 2", "post.gain: expected a table of numbers by name, got the whole number 2"),
        ("[post]\ngain = {jawOpen = 'x'}", "post.gain: expected a table of numbers by name"),
        ("[post]\ngain = {jawOpen = inf}", "post.gain: expected names with finite numbers"),
        ("[post]\nsmooth = 3", "post.smooth: expected a number of seconds from 0 to 2, got 3"),
    ],
)
def test_settings_of_another_kind_are_refused(text, message, tmp_path):
    (tmp_path / "x.toml").write_text(text)
    with pytest.raises(ReenactError, match=message):
        load_config(tmp_path / "x.toml")
