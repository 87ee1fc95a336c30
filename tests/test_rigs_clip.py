import pytest
import torch

from reenact.errors import ReenactError
from reenact.rigs.clip import Clip


def test_a_clip_knows_its_frames_and_seconds():
    clip = Clip(("a", "b"), torch.zeros(45, 2), fps=30.0)
    assert len(clip) == 45
    assert clip.duration == 1.5


BAD = {
    "columns": (("a",), torch.zeros(2, 2), 30.0, "expected 1 weights a frame, got 2"),
    "doubled": (("a", "a"), torch.zeros(2, 2), 30.0, "doubled: a"),
    "NaN": (("a",), torch.tensor([[0.0], [float("nan")]]), 30.0, "frame 1 holds NaN"),
    "rate 0": (("a",), torch.zeros(2, 1), 0.0, "positive frame rate"),
    "rate NaN": (("a",), torch.zeros(2, 1), float("nan"), "positive frame rate"),
    "rate inf": (("a",), torch.zeros(2, 1), float("inf"), "positive frame rate"),
}


@pytest.mark.parametrize(("names", "weights", "fps", "message"), BAD.values(), ids=BAD)
def test_a_clip_that_cannot_work_is_refused(names, weights, fps, message):
    with pytest.raises(ReenactError, match=message):
        Clip(names, weights, fps)


@pytest.mark.parametrize(
    ("rotations", "message"),
    [(torch.zeros(3, 9), r"expected rotations \(2, 9\)"), (torch.full((2, 9), torch.inf), "rotations must be finite")],
)
def test_rotations_are_nine_finite_numbers_a_frame(rotations, message):
    with pytest.raises(ReenactError, match=message):
        Clip(("a",), torch.zeros(2, 1), 30.0, rotations)
