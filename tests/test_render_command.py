"""reenact render: who plays what, and files that are whole or not there."""

import wave
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from reenact import video
from reenact.cli import main
from reenact.errors import ReenactError
from reenact.portrait import Portrait
from reenact.rigs import motion
from reenact.rigs.clip import Clip
from reenact.rigs.files import load_clip, save_clip, save_rig
from reenact.video import Performance, performances, pictures, save_video


@pytest.fixture
def played(toy_pair) -> list[Performance]:
    """Both toys, seven frames of the same clip."""
    clip = motion.synthesize(toy_pair[0].names, 7 / 30, seed=3)
    return [Performance(rig, clip) for rig in toy_pair]


@pytest.fixture
def files(toy_pair, tmp_path) -> list[str]:
    for rig in toy_pair:
        save_rig(rig, tmp_path / f"{rig.name}.npz")
    return [str(tmp_path / f"{rig.name}.npz") for rig in toy_pair]


def test_each_rig_stands_in_its_own_square_as_its_portrait_shows_it(played):
    frames = list(pictures(played, 32))
    assert len(frames) == 7
    assert all(frame.shape == (32, 64, 3) for frame in frames)
    for n, each in enumerate(played):
        expected = Portrait.of(each.rig).render(each.rig.vertices(each.clip.weights[5:6]), 32)["color"][0]
        actual = frames[5][:, 32 * n : 32 * (n + 1)]
        np.testing.assert_allclose(actual, 255 * expected.clamp(0, 1).permute(1, 2, 0).numpy(), atol=0.51)  # rounding
    assert np.array_equal(next(pictures(played, 32, frames=[5])), frames[5])


def test_a_folder_holds_the_frames_themselves(played, tmp_path):
    told = []
    save_video(played, tmp_path / "out", 32, drawn=told.append)
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == [f"{n:06d}.png" for n in range(7)]
    assert told == list(range(1, 8))
    for path, frame in zip(sorted((tmp_path / "out").iterdir()), pictures(played, 32)):
        assert np.array_equal(np.asarray(Image.open(path)), frame)
    (tmp_path / "empty").mkdir()
    save_video(played, tmp_path / "empty", 32)
    assert len(list((tmp_path / "empty").iterdir())) == 7
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty", "out"]


def test_a_fast_clip_becomes_a_gif_at_a_rate_that_it_has(files, toy_pair, tmp_path, capsys):
    fast = motion.synthesize(toy_pair[0].names, 0.2, seed=3, fps=60.0)
    save_clip(fast, tmp_path / "fast.npz")
    out = tmp_path / "fast.gif"
    assert main(["render", str(tmp_path / "fast.npz"), "--rig", files[0], "--size", "32", "--out", str(out)]) == 0
    assert "60 frames per second became 30: a .gif has at most 50" in capsys.readouterr().out
    with Image.open(out) as picture:
        milliseconds = 0
        for n in range(picture.n_frames):
            picture.seek(n)
            milliseconds += picture.info["duration"]
    assert milliseconds == 200  # 12 frames at 60 became 6 at 30


def test_a_gif_moves_and_keeps_its_length(played, tmp_path):
    long = [Performance(each.rig, replace(each.clip, weights=each.clip.weights.repeat(9, 1))) for each in played]
    save_video(long, tmp_path / "x.gif", 32)
    with Image.open(tmp_path / "x.gif") as picture:
        assert picture.size == (64, 32)
        milliseconds, moved = 0, 0
        first = np.asarray(picture.convert("RGB")).astype(int)
        for n in range(picture.n_frames):
            picture.seek(n)
            milliseconds += picture.info["duration"]
            moved = max(moved, np.abs(np.asarray(picture.convert("RGB")).astype(int) - first).max())
    assert milliseconds == 2100  # 63 frames at 30 per second, of 30 and 40 ms
    assert moved > 20
    closest = np.asarray(next(pictures(played, 32, frames=[0]))).astype(int)
    assert np.abs(first - closest).mean() < 6  # 256 colours


@pytest.fixture
def ffmpeg():
    return pytest.importorskip("imageio_ffmpeg", reason="needs the extra video")


@pytest.mark.parametrize("size", [32, 33])
def test_an_mp4_plays_the_frames_at_their_rate(played, tmp_path, ffmpeg, size):
    save_video(played[:1], tmp_path / "x.mp4", size)
    reader = ffmpeg.read_frames(str(tmp_path / "x.mp4"))
    facts = next(reader)
    shown = [np.frombuffer(each, np.uint8).reshape((*facts["size"][::-1], 3)) for each in reader]
    assert (facts["fps"], facts["codec"]) == (30, "h264")
    assert facts["size"] == (size + size % 2,) * 2
    assert len(shown) == 7
    for actual, expected in zip(shown, pictures(played[:1], size)):
        # Lossy, and colours at half the resolution: 3 of 255 measured.
        assert np.abs(actual[:size, :size].astype(int) - expected).mean() < 8
    assert [path.name for path in tmp_path.iterdir()] == ["x.mp4"]


def test_an_mp4_has_sound(played, tmp_path, ffmpeg, capfd):
    with wave.open(str(tmp_path / "a.wav"), "wb") as file:
        file.setparams((1, 2, 16000, 0, "NONE", ""))
        file.writeframes((9000 * np.sin(np.arange(16000) / 6)).astype("<i2").tobytes())
    save_video(played, tmp_path / "x.mp4", 32, audio=tmp_path / "a.wav")
    assert next(ffmpeg.read_frames(str(tmp_path / "x.mp4")))["audio_codec"] == "aac"


def test_what_fails_half_way_leaves_what_was_there(played, tmp_path, ffmpeg, monkeypatch):
    (tmp_path / "x.mp4").write_bytes(b"old")
    (tmp_path / "x.gif").write_bytes(b"old")
    drawn = video.pictures

    def failing(*arguments, **options):
        yield next(drawn(*arguments, **options))
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(video, "pictures", failing)
    for name in ("x.mp4", "x.gif", "folder"):
        with pytest.raises(OSError, match="No space"):
            save_video(played, tmp_path / name, 32)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["x.gif", "x.mp4"]
    assert (tmp_path / "x.mp4").read_bytes() == (tmp_path / "x.gif").read_bytes() == b"old"


def test_a_film_that_ffmpeg_cut_short_is_not_kept(played, tmp_path, ffmpeg, monkeypatch):
    monkeypatch.setattr(ffmpeg, "count_frames_and_secs", lambda path: (3, 0.1))
    with pytest.raises(OSError, match="expected 7 frames, ffmpeg wrote 3"):
        save_video(played, tmp_path / "x.mp4", 32)
    assert list(tmp_path.iterdir()) == []


def test_rigs_play_a_clip_by_the_names_of_their_shapes(files, toy_pair):
    found = performances(["synthetic:3:1"], files)
    assert [each.rig.name for each in found] == ["ball", "egg"]
    expected = load_clip("synthetic:3:1", toy_pair[0])
    assert all(torch.equal(each.clip.weights, expected.weights) for each in found)
    assert len(performances(["synthetic:3:1"], files, fps=10.0)[0].clip) == 10


def test_a_method_retargets_from_the_first_rig(files):
    source, target = performances(["synthetic:3:1"], files, method="neutral")
    assert source.clip.weights.any()
    assert not target.clip.weights.any()


def test_an_animated_file_plays_itself(toy_pair, tmp_path):
    shown = Clip(toy_pair[0].names, torch.rand(5, 7), 30.0)
    save_rig(toy_pair[0], tmp_path / "a.glb", shown)
    (found,) = performances([str(tmp_path / "a.glb")])
    assert torch.allclose(found.clip.weights, shown.weights)


def test_a_run_plays_its_source_and_its_target(toy_run):
    from reenact.inference import ImageRetargeter

    source, target = performances([str(toy_run.folder), "synthetic:3:1"])
    assert (source.rig.name, target.rig.name) == ("ball", "egg")
    assert torch.allclose(target.clip.weights, ImageRetargeter.load(toy_run.folder)(source.clip).weights)
    assert len(performances([str(toy_run.folder)])[0].clip) == 300


def test_opengl_draws_what_render_draws(played):
    try:
        other = next(pictures(played, 64, opengl=True, frames=[3]))
    except ValueError as error:
        if not str(error).startswith("OpenGL:"):
            raise
        pytest.skip(str(error))
    ours = next(pictures(played, 64, frames=[3]))
    assert np.abs(other.astype(int) - ours).mean() < 3  # outlines differ


def test_opengl_that_is_missing_is_named(played, tmp_path, monkeypatch):
    def missing(*_, **__):
        raise ValueError("OpenGL: expected pyrender, got none")

    monkeypatch.setattr(video, "render_opengl", missing)
    with pytest.raises(ReenactError, match="--opengl: OpenGL: expected pyrender"):
        save_video(played, tmp_path / "out", 32, opengl=True)


def test_mistakes_are_named_before_anything_is_drawn(played, files, toy_run, tmp_path, monkeypatch):
    monkeypatch.setattr(video, "pictures", None)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").touch()
    (tmp_path / "x.wav").write_bytes(b"RIFF")
    fast = [Performance(played[0].rig, replace(played[0].clip, fps=60.0))]
    for call, said in [
        (lambda: save_video(played, tmp_path / "x.avi"), r"expected \.mp4, \.gif, or a folder"),
        (lambda: save_video(played, tmp_path / "full"), "already holds something"),
        (lambda: save_video(fast, tmp_path / "x.gif"), "at most 50 frames per second, got 60"),
        (lambda: save_video(played, tmp_path / "x.gif", audio=tmp_path / "x.wav"), "expected an .mp4 to go with it"),
        (lambda: save_video(played, tmp_path / "x.mp4", audio=tmp_path / "x.wav"), "expected a .wav, got something"),
        (lambda: performances([]), "expected CLIP and --rig, or RUN and CLIP, got 0"),
        (lambda: performances([str(toy_run.folder), "synthetic:1"], files), "got 2 arguments and 2 rigs"),
        (lambda: performances(["synthetic:1"], files[:1], "neutral"), "expected a second --rig"),
    ]:
        with pytest.raises(ReenactError, match=said):
            call()
    with pytest.raises(FileNotFoundError, match="make it first"):
        save_video(played, tmp_path / "none" / "x.gif")
    (tmp_path / "x.gif").mkdir()
    with pytest.raises(ReenactError, match="expected a file to write, got a folder"):
        save_video(played, tmp_path / "x.gif")


def test_clips_of_different_length_are_refused(played):
    short = [played[0], Performance(played[1].rig, replace(played[1].clip, weights=played[1].clip.weights[:3]))]
    with pytest.raises(ReenactError, match="expected clips of one length, got 3, 7 frames"):
        next(pictures(short, 32))


def test_without_ffmpeg_the_extra_is_named(played, tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ReenactError, match=r"reenact\[video\]"):
        save_video(played, tmp_path / "x.mp4")


def test_the_command_says_what_it_wrote(files, tmp_path, capsys):
    out = tmp_path / "x.gif"
    assert (
        main(["render", "synthetic:3:0.5", "--rig", files[0], "--rig", files[1], "--out", str(out), "--size", "32"])
        == 0
    )
    assert capsys.readouterr().out == f"{out}: 15 frames, 0.5 s, ball, egg\n"
    assert Image.open(out).size == (64, 32)
    assert main(["render", "synthetic:3:0.5", "--out", str(out), "--size", "5"]) == 2
    assert "--size: expected 16 to 4096 pixels" in capsys.readouterr().err
