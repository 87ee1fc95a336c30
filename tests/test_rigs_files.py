"""Rigs and clips by name and suffix, and clips fitted to rigs."""

import os
import warnings
from pathlib import Path

import pytest
import torch
from conftest import make_random_rig, make_toy_rig

from reenact.errors import ReenactError
from reenact.rigs import arkit, files
from reenact.rigs.clip import Clip
from reenact.rigs.formats import disk
from reenact.rigs.rig import Rig


def rig_of(*names: str) -> Rig:
    return Rig("r", torch.rand(3, 3), torch.zeros(len(names), 3, 3), names, torch.tensor([[0, 1, 2]]))


@pytest.mark.parametrize("suffix", [".glb", ".npz", ".GLB"])
def test_a_rig_is_saved_and_loaded_by_suffix(suffix, tmp_path):
    rig = make_random_rig(3)
    files.save_rig(rig, tmp_path / f"a b ü{suffix}")
    assert torch.equal(files.load_rig(str(tmp_path / f"a b ü{suffix}")).deltas, rig.deltas)


@pytest.mark.parametrize("name", ["c.csv", "c.npz", "c.glb", "c.table.csv"])
def test_a_clip_is_saved_and_loaded_by_suffix(name, tmp_path):
    rig = make_toy_rig("ball")
    clip = files.load_clip("synthetic:5:1.5", rig)
    files.save_clip(clip, tmp_path / name, rig)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # every shape is found
        again = files.load_clip(str(tmp_path / name), rig)
    assert (again.names, again.fps) == (rig.names, 30.0)
    torch.testing.assert_close(again.weights, clip.weights, rtol=0, atol=1e-7)  # eight decimals in Live Link
    assert (tmp_path / name).read_bytes()[:8] == b"Timecode" or name != "c.csv"


def test_shapes_that_are_not_arkit_go_into_a_plain_table(tmp_path):
    files.save_clip(Clip(("smirk",), torch.ones(2, 1), 30.0), tmp_path / "c.csv")
    assert (tmp_path / "c.csv").read_text().splitlines()[0] == "time,smirk"
    assert files.read_clip(tmp_path / "c.csv").names == ("smirk",)


def test_synthetic_clips_have_length_and_kind():
    rig = make_toy_rig("ball")
    assert len(files.load_clip("synthetic:0", rig)) == 600
    ramps = files.load_clip("synthetic:0:3:ramps", rig)
    assert len(ramps) == 90
    assert ((ramps.weights > 0).sum(1) <= 1).all()


@pytest.mark.parametrize("text", ["synthetic", "synthetic:", "synthetic:x", "synthetic:1:y", "synthetic:-1"])
def test_a_synthetic_clip_that_is_misspelt_is_explained(text):
    with pytest.raises(ReenactError, match=r"expected synthetic:SEED\[:SECONDS\[:KIND\]\]"):
        files.load_clip(text, rig_of("jawOpen"))


def test_built_in_characters_are_named():
    with pytest.raises(ReenactError, match=r"anny:mann: no such character; did you mean anny:\w*man\?"):
        files.load_rig("anny:mann")


BAD_RIGS = {
    "face.max": "expected a rig, one of .npz, .glb",
    "face": "no suffix",
    "face.glb": "no such file",
    "a\0.glb": "no such",
}


@pytest.mark.parametrize(("name", "message"), BAD_RIGS.items())
def test_a_rig_that_is_not_there_is_explained(name, message, tmp_path):
    with pytest.raises(ReenactError, match=message):
        files.load_rig(str(tmp_path / name))


def test_the_nearest_file_is_named(tmp_path):
    files.save_rig(make_random_rig(1), tmp_path / "face.glb")
    with pytest.raises(ReenactError, match=r"no such file; did you mean .*face\.glb\?"):
        files.load_rig(str(tmp_path / "fcae.glb"))


def test_rigs_and_clips_are_not_mistaken_for_each_other(tmp_path):
    rig = make_random_rig(1)
    files.save_rig(rig, tmp_path / "rig.npz")
    files.save_clip(Clip(rig.names, torch.zeros(1, 3), 30.0), tmp_path / "clip.npz")
    with pytest.raises(ReenactError, match="expected a rig, found a clip"):
        files.load_rig(str(tmp_path / "clip.npz"))
    with pytest.raises(ReenactError, match="expected a clip, found a rig"):
        files.load_clip(str(tmp_path / "rig.npz"), rig)


def test_a_folder_is_no_file(tmp_path):
    (tmp_path / "x.csv").mkdir()
    with pytest.raises(ReenactError, match="expected a file, found a folder"):
        files.read_clip(tmp_path / "x.csv")


def test_what_cannot_be_written_is_explained(tmp_path):
    rig = make_random_rig(1)
    clip = Clip(rig.names, torch.zeros(1, 3), 30.0)
    for save, message in (
        (lambda: files.save_rig(rig, tmp_path / "x.mtl"), "a rig is written as .glb, .npz, .*got .mtl"),
        (lambda: files.save_rig(rig, tmp_path / "x.npz", clip), "not both"),
        (lambda: files.save_clip(clip, tmp_path / "x.mp4"), "a clip is written as .csv, .npz, .json, .*got .mp4"),
        (lambda: files.save_clip(clip, tmp_path / "x.glb"), "needs the rig"),
        (lambda: files.save_rig(rig, tmp_path / "nowhere" / "x.glb"), "cannot be written .* choose a folder"),
    ):
        with pytest.raises(ReenactError, match=message):
            save()
    assert not list(tmp_path.iterdir())


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "rig.glb"
    path.write_bytes(b"old")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ReenactError, match="No space left on device"):
        files.save_rig(make_random_rig(1), path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["rig.glb"]
    assert path.read_bytes() == b"old"


def test_a_file_that_is_too_large_is_refused_unread(tmp_path, monkeypatch):
    (tmp_path / "big.glb").write_bytes(b"x" * 100)
    monkeypatch.setattr(disk, "LIMIT", 99)
    with pytest.raises(ReenactError, match="expected at most 99 bytes, got 100"):
        disk.read_bytes(tmp_path / "big.glb")


def test_a_file_that_cannot_be_read_is_refused(tmp_path, monkeypatch):
    (tmp_path / "x.glb").write_bytes(b"x")

    def broken(_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_bytes", broken)
    with pytest.raises(ReenactError, match=r"x\.glb: cannot be read .*Permission denied"):
        disk.read_bytes(tmp_path / "x.glb")


# Names ---------------------------------------------------------------------------------------------------------------


def conformed(clip_names, values, *rig_names) -> list[float]:
    clip = Clip(tuple(clip_names), torch.tensor([values], dtype=torch.float32), 30.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return files.conform(clip, rig_of(*rig_names)).weights[0].tolist()


def test_order_and_spelling_follow_the_rig():
    assert conformed(("JawOpen", "eyeBlinkLeft"), (0.25, 0.5), "eyeBlink_L", "jawOpen") == [0.5, 0.25]


def test_split_and_merged_shapes_follow_the_rule():
    assert conformed(("browInnerUp",), (0.5,), "browInnerUp_L", "browInnerUp_R") == [0.5, 0.5]
    assert conformed(("cheekPuff_L", "cheekPuff_R"), (0.25, 0.75), "cheekPuff") == [0.5]
    assert conformed(("eyeBlinkLeft", "eyeBlinkRight"), (0.25, 0.75), "eyeBlink") == [0.5]
    assert conformed(("eyeBlink",), (0.5,), "eyeBlinkRight", "eyeBlinkLeft") == [0.5, 0.5]


def test_an_exact_name_wins_over_a_spelling():
    assert conformed(("jaw_open", "jawOpen"), (0.25, 0.5), "jawOpen") == [0.5]


def test_what_does_not_match_is_said():
    clip = Clip(("jawOpen", "smirk", "still"), torch.tensor([[0.5, 0.5, 0.0]]), 30.0)
    with pytest.warns(UserWarning, match="shapes") as caught:
        conformed_clip = files.conform(clip, rig_of("jawOpen", "wink"), "c.csv")
    assert [str(warning.message) for warning in caught] == [
        "c.csv: shapes that r lacks are left out: smirk",
        "c.csv: shapes of r that it lacks stay at 0: wink",
    ]
    assert conformed_clip.weights.tolist() == [[0.5, 0.0]]


def test_a_clip_with_nothing_in_common_is_refused():
    with pytest.raises(ReenactError, match=r"none of its 1 shapes \(smirk, ...\) is one of r \(wink"):
        conformed(("smirk",), (1.0,), "wink")


def test_a_clip_for_the_rig_is_left_alone():
    clip = Clip(arkit.NAMES, torch.rand(2, 52), 30.0)
    assert files.conform(clip, rig_of(*arkit.NAMES)) is clip
