"""Weights of NVIDIA Audio2Face."""

import json
import warnings

import numpy as np
import pytest
import torch

from reenact.errors import ReenactError
from reenact.rigs.clip import Clip
from reenact.rigs.files import read_clip
from reenact.rigs.formats import audio2face, json_table

GOOD = {  # as version 2023 writes them
    "exportFps": 60.0,
    "trackPath": "/tmp/voice.wav",
    "numPoses": 2,
    "numFrames": 3,
    "facsNames": ["jawOpen", "eyeBlinkLeft"],
    "weightMat": [[0.0, 0.5], [0.125, 1.0], [0, 0.25]],
}


@pytest.mark.parametrize("seed", range(20))
def test_a_clip_comes_back_exactly_and_writes_the_same_bytes(seed, tmp_path):
    weights = torch.rand(40, 3, generator=torch.Generator().manual_seed(seed)) ** (seed + 1)
    clip = Clip(("jawOpen", "eyeBlink_L", "眉 上"), weights, (30.0, 60.0, 24.0, 30000 / 1001)[seed % 4])
    audio2face.save(clip, tmp_path / "one.json")
    again = audio2face.load(tmp_path / "one.json")
    assert (again.names, again.fps) == (clip.names, clip.fps)
    assert torch.equal(again.weights, clip.weights)
    audio2face.save(again, tmp_path / "two.json")
    assert (tmp_path / "one.json").read_bytes() == (tmp_path / "two.json").read_bytes()


def test_a_file_has_the_fields_of_the_exporter(tmp_path):
    weights = torch.tensor(GOOD["weightMat"])
    audio2face.save(Clip(tuple(GOOD["facsNames"]), weights, 60.0), tmp_path / "t.json")
    assert json.loads((tmp_path / "t.json").read_text()) == GOOD | {"trackPath": ""}


def test_an_export_is_read_by_its_names(tmp_path):
    (tmp_path / "t.json").write_text(json.dumps(GOOD))
    clip = audio2face.load(tmp_path / "t.json")
    assert (clip.names, clip.fps) == (("jawOpen", "eyeBlinkLeft"), 60.0)
    assert clip.weights.tolist() == GOOD["weightMat"]


def test_an_export_is_told_from_other_json():
    assert audio2face.is_audio2face(GOOD)
    assert not json_table.is_table(GOOD)
    for other in ([], None, {"facsNames": []}, {"names": [], "weights": []}):
        assert not audio2face.is_audio2face(other)


def test_joints_that_move_are_named_and_still_ones_are_not(tmp_path):
    turned, straight = [[0.0, 0.0, 0.7, 0.7]], [[0.0, 0.0, 0.0, 1.0]]
    joints = {"joints": ["Jaw"], "rotations": [straight, turned, straight], "translations": [[[0, 0, 0]]] * 3}
    (tmp_path / "t.json").write_text(json.dumps(GOOD | joints))
    with pytest.warns(UserWarning, match=r"t\.json: fields that move .* not loaded: rotations$"):
        audio2face.load(tmp_path / "t.json")
    (tmp_path / "t.json").write_text(json.dumps(GOOD | joints | {"rotations": [straight] * 3}))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        audio2face.load(tmp_path / "t.json")


def test_an_old_export_without_a_rate_is_taken_at_30_and_says_so(tmp_path):
    old = {key: value for key, value in GOOD.items() if key not in ("exportFps", "trackPath")}
    (tmp_path / "t.json").write_text(json.dumps(old))
    with pytest.warns(UserWarning, match=r"t\.json: no exportFps, taken as 30 frames per second"):
        clip = audio2face.load(tmp_path / "t.json")
    assert clip.fps == 30


BAD = {
    "frames": ({"numFrames": 4}, "numFrames says 4, weightMat has 3; was the file cut off"),
    "poses": ({"numPoses": 3}, "numPoses says 3, facsNames has 2"),
    "poses text": ({"numPoses": "2"}, "numPoses says '2', facsNames has 2"),
    "poses true": ({"numPoses": True, "facsNames": ["a"], "weightMat": [[1]] * 3}, "numPoses says True"),
    "names": ({"facsNames": {"a": 1}}, "facsNames as a list of strings, got an object of a"),
    "doubled": ({"facsNames": ["a", "a"]}, "doubled: a"),
    "short row": ({"weightMat": [[0, 1], [0], [0, 1]]}, "2 weights, one per name, in weightMat row 2, got 1"),
    "text": ({"weightMat": [[0, "x"]] * 3}, "a number in weightMat row 1, eyeBlinkLeft, got 'x'"),
    "no frames": ({"weightMat": [], "numFrames": 0}, "weightMat as a list of one or more rows"),
    "rate": ({"exportFps": -1}, "exportFps as frames per second above 0, got -1"),
    "rate text": ({"exportFps": "60"}, "exportFps as frames per second above 0, got '60'"),
}


@pytest.mark.parametrize(("change", "message"), BAD.values(), ids=BAD)
def test_an_export_that_contradicts_itself_is_refused(change, message, tmp_path):
    (tmp_path / "bad.json").write_text(json.dumps(GOOD | change))
    with pytest.raises(ReenactError, match=message) as caught:
        audio2face.load(tmp_path / "bad.json")
    assert str(caught.value).startswith(str(tmp_path / "bad.json"))


def test_frames_of_the_service_are_read_in_time(tmp_path):
    # As its sample client writes them; the third of four frames was lost.
    path = tmp_path / "animation_frames.csv"
    path.write_text(
        "timeCode,blendShapes.EyeBlinkLeft,blendShapes.JawOpen\n0.0,0,0.5\n"
        "0.03333333333333333,0.1,0.25\n0.1,0.3,0\n0.13333333333333333,0.4,0.125\n"
    )
    clip = audio2face.load_csv(path)
    assert (clip.names, clip.fps) == (("EyeBlinkLeft", "JawOpen"), 30.0)
    expected = [[0, 0.5], [0.1, 0.25], [0.2, 0.125], [0.3, 0], [0.4, 0.125]]
    np.testing.assert_allclose(clip.weights, expected, atol=1e-7)  # float32


def test_frames_of_the_service_are_told_from_a_take():
    assert audio2face.is_audio2face_csv(["timeCode", "blendShapes.JawOpen"])
    assert not audio2face.is_audio2face_csv(["Timecode", "BlendShapeCount", "JawOpen"])


def test_columns_of_the_service_that_are_no_shapes_are_named(tmp_path):
    (tmp_path / "t.csv").write_text("timeCode,blendShapes.a,emotion.joy\n0,1,0.5\n1,1,x\n")
    with pytest.warns(UserWarning, match=r"t\.csv: columns that are no blendshapes are not loaded: emotion\.joy"):
        assert audio2face.load_csv(tmp_path / "t.csv").names == ("a",)


BAD_CSV = {
    "no time": ("blendShapes.a,b\n1,2\n", "a column timeCode and columns blendShapes.NAME, got blendShapes.a, b"),
    "no shapes": ("timeCode,a\n1,2\n", "a column timeCode and columns"),
    "doubled": ("timeCode,blendShapes.a,BlendShapes.a\n0,1,2\n", "doubled: a"),
    "nameless": ("timeCode,blendShapes.\n0,1\n", "a name for every column"),
    "text": ("timeCode,blendShapes.a\n0,x\n", "a number in row 1, column blendShapes.a, got 'x'"),
    "time text": ("timeCode,blendShapes.a\n00:00:01:00,1\n", "a number in row 1, column timeCode"),
    "no rows": ("timeCode,blendShapes.a\n", "at least one frame"),
}


@pytest.mark.parametrize(("text", "message"), BAD_CSV.values(), ids=BAD_CSV)
def test_frames_of_the_service_that_are_none_are_refused(text, message, tmp_path):
    (tmp_path / "bad.csv").write_text(text)
    with pytest.raises(ReenactError, match=message):
        audio2face.load_csv(tmp_path / "bad.csv")


def test_either_file_is_known_by_what_is_in_it(tmp_path):
    (tmp_path / "t.json").write_text(json.dumps(GOOD))
    (tmp_path / "t.csv").write_text("timeCode,blendShapes.jawOpen,blendShapes.eyeBlinkLeft\n0,0,0.5\n0.1,0.125,1\n")
    for name, fps in (("t.json", 60.0), ("t.csv", 10.0)):
        clip = read_clip(tmp_path / name)
        assert (clip.names, clip.fps) == (("jawOpen", "eyeBlinkLeft"), fps)
        assert clip.weights[:2].tolist() == GOOD["weightMat"][:2]
