"""Live Link Face takes."""

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from reenact.config import PostConfig
from reenact.errors import ReenactError
from reenact.postprocessing import postprocess
from reenact.rigs import arkit, motion
from reenact.rigs.clip import Clip
from reenact.rigs.formats import livelink
from reenact.rigs.timeline import resampled

TAKE = Path(__file__).parents[2] / "shared" / "clips" / "arkit_capture_dao.csv"


def write(path: Path, *rows: str, header: str = "Timecode,BlendShapeCount,JawOpen,TongueOut") -> Path:
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


@pytest.mark.parametrize("fps", [30.0, 60.0, 24.0, 25.0])
@pytest.mark.parametrize("frames", [1, 7, 200])
def test_a_take_comes_back(fps, frames, tmp_path):
    weights = torch.rand(frames, 52, generator=torch.Generator().manual_seed(2))
    livelink.save(Clip(arkit.NAMES, weights, fps), tmp_path / "take.csv")
    again = livelink.load(tmp_path / "take.csv")
    assert again.names == arkit.NAMES
    assert again.fps == (fps if frames > 1 else {30.0: 30.0}.get(fps, 30.0))
    torch.testing.assert_close(again.weights, weights, rtol=0, atol=1e-8 + 6e-8)  # eight decimals, float32


def test_a_take_has_the_columns_of_the_app(tmp_path):
    livelink.save(Clip(("eyeBlink_L",), torch.ones(1, 1), 60.0), tmp_path / "take.csv")
    header, row = (line.split(",") for line in (tmp_path / "take.csv").read_text().splitlines())
    assert len(header) == len(row) == 63
    assert header[:3] == ["Timecode", "BlendShapeCount", "EyeBlinkLeft"]
    assert header[54:] == list(livelink.ROTATIONS)
    assert row[:4] == ["00:00:00:30.000", "61", "1.00000000", "0.00000000"]


def test_columns_count_by_name_in_any_order_and_spelling(tmp_path):
    path = write(tmp_path / "t.csv", "0.1,0.2,00:00:01:00", "0.3,0.4,00:00:01:01", header="tongue_out,JAWOPEN,timecode")
    clip = livelink.load(path)
    assert clip.names == ("tongueOut", "jawOpen")
    np.testing.assert_allclose(clip.weights, [[0.1, 0.2], [0.3, 0.4]], atol=1e-7)


def test_dropped_doubled_and_lost_frames_are_repaired_in_time(tmp_path):
    slots = {0: 0.0, 10: 0.1, 20: 0.2, 30: 0.3, 40: 0.4}
    rows = [f"23:59:59:{40 + index:02}.000,61,{index / 100},0" for index in range(20) if index not in (5, 6, 13)]
    rows.insert(4, rows[3])
    rows += [f"00:00:00:{index - 20:02}.000,61,{index / 100},0" for index in range(20, 45)]  # past midnight
    rows[8] = rows[8].split(",")[0] + ",0,,"  # no face in sight
    clip = livelink.load(write(tmp_path / "t.csv", *rows))
    assert clip.fps == 60
    assert len(clip) == 45
    np.testing.assert_allclose(clip.weights[:, 0], np.arange(45) / 100, atol=1e-6)  # thousandths of a frame
    for slot, value in slots.items():
        assert clip.weights[slot, 0] == pytest.approx(value, abs=1e-6)


def test_what_is_not_loaded_is_said(tmp_path):
    header = "Timecode,BlendShapeCount,JawOpen,HeadYaw,HeadPitch,Smirk"
    path = write(tmp_path / "t.csv", "00:00:00:00,61,0.5,0.1,0.0,0", header=header)
    with pytest.warns(UserWarning, match="not loaded") as caught:
        clip = livelink.load(path)
    assert [str(warning.message).split(": ", 1)[1] for warning in caught] == [
        "columns that are no ARKit shape are not loaded: Smirk",
    ]
    np.testing.assert_allclose(clip.rotations, [[0.1, 0, 0, 0, 0, 0, 0, 0, 0]])


def test_rotations_pass_through_and_come_back(tmp_path):
    generator = torch.Generator().manual_seed(1)
    weights, turns = torch.rand(40, 52, generator=generator), torch.randn(40, 9, generator=generator)
    clip = Clip(arkit.NAMES, weights, 60.0, turns)
    livelink.save(postprocess(clip, PostConfig(gain={"*": 0.5})), tmp_path / "take.csv")
    again = livelink.load(tmp_path / "take.csv")
    torch.testing.assert_close(again.rotations, turns, rtol=0, atol=2e-7)  # eight decimals, float32 of up to 4
    torch.testing.assert_close(resampled(again, 30.0).rotations, again.rotations[::2])


def test_a_recorded_take_with_odd_hours_and_gaps_loads_at_60_fps():
    if not TAKE.exists():
        pytest.skip("the recorded take is test data that only some machines have")
    clip = livelink.load(TAKE)
    assert clip.rotations is not None
    assert clip.rotations.abs().max() < 1.6  # radians of a head
    assert clip.names == arkit.NAMES
    assert (len(clip), clip.fps) == (187, 60.0)  # 180 rows
    first = [float(cell) for cell in TAKE.read_text().splitlines()[1].split(",")[2:54]]
    np.testing.assert_allclose(clip.weights[0], first, atol=1e-7)


BAD = {
    "no timecode": (["0,61,0.5,0"], "Time,BlendShapeCount,JawOpen,TongueOut", "a column Timecode"),
    "no shapes": (["00:00:00:00,61,0.5,0"], "Timecode,BlendShapeCount,A,B", "columns named as ARKit shapes"),
    "doubled": (["00:00:00:00,61,0.5,0"], "Timecode,BlendShapeCount,JawOpen,jaw_open", "doubled: jawOpen"),
    "timecode": (["12:30,61,0.5,0"], None, "HH:MM:SS:FF.sub in tracked row 1, got '12:30'"),
    "minutes": (["00:61:00:00,61,0.5,0"], None, "HH:MM:SS:FF.sub"),
    "frames": (["00:00:00:60,61,0.5,0"], None, "frames below 60, got 60"),
    "text": (["00:00:00:00,61,high,0"], None, "a number in row 1, column JawOpen, got 'high'"),
    "infinite": (["00:00:00:00,61,inf,0"], None, "a number in row 1, column JawOpen"),
    "no face": (["00:00:00:00,0,,", "00:00:00:01,0,,"], None, "at least one row with a tracked face"),
    "no rows": ([], None, "at least one row"),
    "cut off": (["00:00:00:00,61,0.5,0", "00:00:00:01,61"], None, "4 cells in row 2, got 2"),
    "hours between": (["00:00:00:00,61,0,0", "00:00:00:01,61,0,0", "09:00:00:00,61,0,0"], None, "one row per frame"),
}


@pytest.mark.parametrize(("rows", "header", "message"), BAD.values(), ids=BAD)
def test_a_take_that_is_none_is_refused(rows, header, message, tmp_path):
    path = write(tmp_path / "bad.csv", *rows, **({} if header is None else {"header": header}))
    with pytest.raises(ReenactError, match=message) as caught:
        livelink.load(path)
    assert str(caught.value).startswith(str(path))


@pytest.mark.parametrize("names", [("jawOpen", "smirk"), ("browInnerUp_L", "browInnerUp_R")])
def test_shapes_that_a_take_cannot_hold_are_refused(names, tmp_path):
    with pytest.raises(ReenactError, match="write a table"):
        livelink.save(Clip(names, torch.zeros(1, 2), 30.0), tmp_path / "x.csv")
    assert not list(tmp_path.iterdir())


def test_200_mutated_takes_load_or_are_refused(tmp_path):
    livelink.save(motion.synthesize(arkit.NAMES, 0.5, seed=1), tmp_path / "take.csv")
    sample = (tmp_path / "take.csv").read_bytes()
    rng = np.random.default_rng(13)
    refused = 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for round_ in range(200):
            data = bytearray(sample)
            for place in rng.integers(0, len(data) if round_ % 2 else 1500, rng.integers(1, 6)):
                data[place] = rng.integers(256) if round_ % 4 else rng.choice(list(b'0123456789.,:-"\n'))
            (tmp_path / "mutant.csv").write_bytes(bytes(data))
            try:
                livelink.load(tmp_path / "mutant.csv")
            except ReenactError:
                refused += 1
    assert refused > 50
