"""A trained run moves clips, frame by frame as in batches."""

from dataclasses import replace

import pytest
import torch

from reenact.cli import main
from reenact.errors import ReenactError
from reenact.inference import ImageRetargeter
from reenact.postprocessing import smoothed
from reenact.rigs.clip import Clip
from reenact.rigs.files import load_clip


def without_steadying(run):
    """The retargeter of a run whose clips are what is read of each frame."""
    retargeter = ImageRetargeter.load(run.folder)
    config = retargeter.run.config
    retargeter.run = replace(retargeter.run, config=replace(config, bpnet=replace(config.bpnet, steady=0.0)))
    return retargeter


def some_clip(retargeter, frames):
    """Expressions that move now and then, at 30 frames a second."""
    names = retargeter.source.names
    some = torch.rand(frames // 5 + 1, len(names), generator=torch.Generator().manual_seed(0))
    return Clip(names, some.repeat_interleave(5, 0)[:frames], 30.0)


def test_a_frame_alone_gives_the_weights_that_it_has_in_a_clip(toy_run):
    retargeter = without_steadying(toy_run)
    clip = some_clip(retargeter, 70)
    moved = retargeter(clip)
    assert moved.names == retargeter.target.names
    single = torch.stack([retargeter.step(frame) for frame in clip.weights[60:]])
    torch.testing.assert_close(single, moved.weights[60:], rtol=0, atol=1e-5)  # float32, other batch size


def test_a_clip_is_what_is_read_from_the_redrawn_pictures(toy_run):
    retargeter = without_steadying(toy_run)
    clip = some_clip(retargeter, 9)
    through = retargeter.read(retargeter.reenact(retargeter.source_pictures(clip.weights)))
    torch.testing.assert_close(retargeter(clip).weights, through, rtol=0, atol=1e-4)  # drawn and described in float32


def test_a_clip_is_steadied_over_its_own_time(toy_run):
    retargeter, plain = ImageRetargeter.load(toy_run.folder), without_steadying(toy_run)
    clip = some_clip(retargeter, 70)  # more than fit in memory as pictures at once
    for fps in (30.0, 120.0):
        read = plain(replace(clip, fps=fps)).weights
        moved = retargeter(replace(clip, fps=fps)).weights
        torch.testing.assert_close(moved, smoothed(read, 0.02 * fps, 0.08), rtol=0, atol=1e-5)
        assert (moved - read).abs().max() > 1e-3


def test_a_clip_can_be_watched_on_its_way(toy_run):
    retargeter = ImageRetargeter.load(toy_run.folder)
    clip, seen = some_clip(retargeter, 130), []

    def watch(parts):
        for part in parts:
            seen.append(len(part))
            yield part

    assert torch.equal(retargeter(clip, watch).weights, retargeter(clip).weights)
    assert seen == [64, 64, 2]


def test_a_clip_with_other_names_is_refused(toy_run):
    retargeter = ImageRetargeter.load(toy_run.folder)
    with pytest.raises(ReenactError, match="names"):
        retargeter(Clip(("a",), torch.zeros(1, 1), 30.0))


def test_reverse_swaps_the_rigs(toy_run):
    forward, reverse = ImageRetargeter.load(toy_run.folder), ImageRetargeter.load(toy_run.folder, reverse=True)
    assert (reverse.source.name, reverse.target.name) == (forward.target.name, forward.source.name)


def test_weights_stay_in_range_and_follow_the_source(toy_run):
    retargeter = ImageRetargeter.load(toy_run.folder)
    names = retargeter.source.names
    moved = retargeter(Clip(names, torch.eye(len(names)), 24.0))
    assert (len(moved), moved.fps) == (len(names), 24.0)
    assert moved.weights.min() >= 0
    assert moved.weights.max() <= 1
    assert moved.weights.std(0).max() > 0


def test_masks_are_the_coverage_of_the_pictures(toy_run):
    retargeter = ImageRetargeter.load(toy_run.folder)
    weights = torch.zeros(1, len(retargeter.source.names))
    for mask in (retargeter.source_masks(weights), retargeter.target_masks(weights)):
        assert mask.shape == (1, 1, 32, 32)
        assert (float(mask.min()), float(mask.max())) == (0.0, pytest.approx(1.0, abs=1e-6))


def test_reading_the_source_directly_skips_the_redrawing(toy_run):
    retargeter = ImageRetargeter.load(toy_run.folder)
    pictures = retargeter.source_pictures(torch.eye(len(retargeter.source.names)))
    direct, through = retargeter.read_direct(pictures), retargeter.read(retargeter.reenact(pictures))
    assert direct.shape == through.shape
    assert not torch.equal(direct, through)


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".glb"])
def test_a_clip_of_a_few_frames_goes_all_the_way(suffix, toy_run, tmp_path, capsys):
    out = tmp_path / f"out{suffix}"
    assert main(["infer", f"{toy_run.folder}", "synthetic:0:0.2", "--out", f"{out}", "--reverse"]) == 0
    assert capsys.readouterr() == (f"{out}: 6 frames, 0.2 s, egg -> ball\n", "")
    assert len(load_clip(f"{out}", toy_run.rigs["ball"])) == 6


def test_pairs_alone_copy_between_rigs_whose_shapes_look_alike(toy_run):
    weights = torch.rand(3, 7, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(ImageRetargeter.load(toy_run.folder).paired(weights), weights)


def test_any_checkpoint_moves_a_clip_and_says_whether_it_is_the_newest(older_run):
    moved, older = {}, {}
    for which in ("newest", "best", "10", "20", "30"):
        retargeter = ImageRetargeter.load(older_run, checkpoint=which)
        moved[which], older[which] = retargeter.step(torch.zeros(7)), retargeter.older
    assert older == {"newest": None, "best": 20, "10": 10, "20": 20, "30": None}
    assert torch.equal(moved["best"], moved["20"])
    assert torch.equal(moved["newest"], moved["30"])
    assert float((moved["20"] - moved["10"]).abs().max()) > 0.1
    assert float((moved["30"] - moved["20"]).abs().max()) > 0.1
