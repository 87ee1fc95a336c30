"""Plain tables of weights, and frames at a constant rate."""

import numpy as np
import pytest
import torch

from reenact.errors import ReenactError
from reenact.rigs.clip import Clip
from reenact.rigs.formats import table
from reenact.rigs.timeline import steady


@pytest.mark.parametrize("fps", [30.0, 24.0, 29.97, 60.0, 12.5, 1.0])
@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_a_clip_comes_back_exactly(fps, suffix, tmp_path):
    clip = Clip(("jawOpen", "a, b", 'ü "x"'), torch.rand(50, 3, generator=torch.Generator().manual_seed(1)), fps)
    save, load = (table.save_csv, table.load_csv) if suffix == ".csv" else (table.save_npz, table.load_npz)
    save(clip, tmp_path / f"clip{suffix}")
    again = load(tmp_path / f"clip{suffix}")
    assert again.names == clip.names
    assert torch.equal(again.weights, clip.weights)
    # The table's rate is read off its times; within 0.2 % of a whole number it is that number.
    assert again.fps == (round(fps) if suffix == ".csv" and fps == 29.97 else pytest.approx(fps, rel=1e-9))


def test_a_table_by_hand_is_read_in_time(tmp_path):
    # The row for 0.2 s is missing, the one for 0.3 s is there twice, the last two are swapped.
    text = "\ufefftime , smile,\r\n0,0,\r\n0.1,0.2,\r\n0.3,0.9,\r\n0.3,0.6,\r\n\r\n0.5,1.0,\r\n0.4,0.8,\r\n"
    (tmp_path / "hand.csv").write_text(text, newline="", encoding="utf-8")
    clip = table.load_csv(tmp_path / "hand.csv")
    assert clip.names == ("smile",)
    assert clip.fps == 10
    assert clip.weights[:, 0].tolist() == pytest.approx([0, 0.2, 0.4, 0.6, 0.8, 1.0])


def test_times_in_an_array_count(tmp_path):
    np.savez(tmp_path / "t.npz", names=["a"], weights=np.array([[0.0], [1.0], [3.0]]), time=[0.0, 1.0, 3.0])
    clip = table.load_npz(tmp_path / "t.npz")
    assert clip.fps == 1
    assert clip.weights[:, 0].tolist() == [0, 1, 2, 3]


def test_a_long_clip_at_a_broken_rate_keeps_it_and_its_weights():
    times, weights = np.arange(5000) / 29.97, np.random.default_rng(1).random((5000, 2))
    again, fps = steady("x", times, weights)
    assert fps == pytest.approx(29.97, rel=1e-12)
    assert np.array_equal(again, weights)


def test_one_row_is_a_clip_of_one_frame():
    weights, fps = steady("x", np.array([3.0, 3.0]), np.array([[0.1], [0.2]]))
    assert weights.tolist() == [[0.2]]
    assert fps == 30


def test_resampling_keeps_a_straight_line_straight():
    rng = np.random.default_rng(0)
    times = np.sort(rng.choice(300, 260, replace=False)) / 60  # 40 frames dropped
    weights, fps = steady("x", times, np.stack([times, 2 - times], axis=1))
    assert fps == 60
    expected = times[0] + np.arange(len(weights)) / 60
    np.testing.assert_allclose(weights, np.stack([expected, 2 - expected], 1), atol=1e-12)  # float64


BAD = {
    "empty": ("", "empty file"),
    "blank": ("\n\n", "only empty lines"),
    "no rows": ("time,a\n", "at least one frame"),
    "no time": ("frame,a\n0,1\n", "expected a column time"),
    "only time": ("time\n0\n", "expected a column time"),
    "two times": ("time,Time,a\n0,0,1\n", "expected a column time"),
    "doubled": ("time,a,a\n0,1,1\n", "doubled: a"),
    "nameless": ("time,,a\n0,1,1\n", "a name for every column"),
    "text": ("time,a\n0,hello\n", "a number in row 1, column a, got 'hello'"),
    "hole": ("time,a\n0,1\n1,\n", "a number in row 2, column a, got ''"),
    "NaN": ("time,a\n0,nan\n", "a number in row 1, column a, got 'nan'"),
    "infinite time": ("time,a\ninf,1\n", "column time, got 'inf'"),
    "short row": ("time,a,b\n0,1,1\n1,1\n", "3 cells in row 2, got 2; is it cut off"),
    "long row": ("time,a\n0,1,1\n", "2 cells in row 1, got 3"),
    "quote": ('time,a\n0,"1\n', "comma-separated values"),
    "endless": ("time,a\n0,1\n1,1\n2,1\n1e11,1\n", "about one row per frame"),
    "far apart": ("time,a\n-1e308,1\n1e308,1\n", "times must be finite, row 1 is not"),
    "too close": ("time,a\n0,1\n1e-310,1\n", "about one row per frame"),
    "null": ("time,a\n0,\0\n", "a number in row 1|comma-separated"),
}


@pytest.mark.parametrize(("text", "message"), BAD.values(), ids=BAD)
def test_a_table_that_is_none_is_refused_by_row_and_column(text, message, tmp_path):
    (tmp_path / "bad.csv").write_text(text)
    with pytest.raises(ReenactError, match=message) as caught:
        table.load_csv(tmp_path / "bad.csv")
    assert str(caught.value).startswith(str(tmp_path / "bad.csv"))


def test_what_is_no_text_is_refused(tmp_path):
    (tmp_path / "bad.csv").write_bytes(b"time,a\n0,\xff\n")
    with pytest.raises(ReenactError, match="expected UTF-8 text, got byte 9 = 0xff"):
        table.header(tmp_path / "bad.csv")


BAD_ARRAYS = {
    "no rate": ({"fps": None}, "an array time or fps"),
    "rate 0": ({"fps": np.float64(0)}, "positive frame rate"),
    "rates": ({"fps": np.ones(3)}, r"fps of shape \(\)"),
    "no weights": ({"weights": None}, "expected an array weights"),
    "columns": ({"weights": np.zeros((4, 3))}, r"weights of shape \(any, 2\)"),
    "no frames": ({"weights": np.zeros((0, 2))}, "at least one frame"),
    "doubled": ({"names": np.array(["a", "a"])}, "doubled: a"),
    "times": ({"fps": None, "time": np.zeros(3)}, r"time of shape \(4\)"),
    "time NaN": ({"fps": None, "time": np.full(4, np.nan)}, "time holds NaN"),
}


@pytest.mark.parametrize(("change", "message"), BAD_ARRAYS.values(), ids=BAD_ARRAYS)
def test_arrays_that_are_no_clip_are_refused(change, message, tmp_path):
    arrays = {"names": np.array(["a", "b"]), "weights": np.zeros((4, 2)), "fps": np.float64(30)} | change
    np.savez(tmp_path / "bad.npz", **{key: value for key, value in arrays.items() if value is not None})
    with pytest.raises(ReenactError, match=message):
        table.load_npz(tmp_path / "bad.npz")


def test_times_that_are_no_numbers_are_refused():
    with pytest.raises(ReenactError, match="x: times must be finite, row 2 is not"):
        steady("x", np.array([0.0, np.inf]), np.zeros((2, 1)))
