"""A cast learns any to any at a cost that grows with its rigs; it takes in a new one and leaves what it knows."""

import json
from dataclasses import replace
from itertools import pairwise, permutations

import pytest
import torch
from conftest import make_toy_rig

from reenact.checkpoint import load_checkpoint
from reenact.cli import main
from reenact.config import Config, PairsConfig, check_config, load_config, save_config
from reenact.data import Studio
from reenact.errors import ReenactError
from reenact.inference import ImageRetargeter
from reenact.metrics import vertex_error_ratio
from reenact.retargeting import correspondence as correspondences
from reenact.retargeting.correspondence import Correspondence, Places
from reenact.rigs.clip import Clip
from reenact.rigs.files import save_rig
from reenact.rigs.motion import expressions
from reenact.run import Run, networks_state
from reenact.training import train

NAMES = ("ball", "egg", "bean", "pear")


@pytest.fixture(scope="module")
def rig_files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cast")
    for index, name in enumerate(NAMES):
        save_rig(make_toy_rig(name, stretch=1 + 0.12 * index, hue=index), folder / f"{name}.npz")
    return tuple(f"{folder / name}.npz" for name in NAMES)


@pytest.fixture(scope="module")
def three(toy_config, rig_files, tmp_path_factory):
    """A cast of three that has learnt for some hundred steps."""
    return train(
        replace(
            toy_config,
            cast=rig_files[:3],
            run=str(tmp_path_factory.mktemp("runs") / "three"),
            training=replace(toy_config.training, steps=300, batch_size=32, frames=256, refresh=0, save_every=1000),
        )
    )


@pytest.fixture(scope="module")
def four(three, rig_files, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "four"
    assert main(["add", f"{three}", rig_files[3], "--run", f"{folder}"]) == 0
    return folder


def _ver(folder, source, target):
    retargeter = ImageRetargeter.load(folder, source=source, target=target)
    assert (retargeter.source.name, retargeter.target.name) == (source, target)
    weights = expressions(retargeter.source.names, 64, 12345)
    moved = retargeter(Clip(retargeter.source.names, weights, 30.0)).weights
    return vertex_error_ratio(retargeter.target, moved, weights)  # toys share their shapes: copies are the truth


@pytest.mark.parametrize(("source", "target"), permutations(NAMES[:3], 2))
def test_every_member_moves_every_other(source, target, three):
    assert _ver(three, source, target) < 0.3  # 1 is a face that stays still


@pytest.mark.parametrize("other", NAMES[:3])
def test_an_added_member_moves_the_others_and_is_moved_by_them(other, four):
    assert _ver(four, "pear", other) < 0.35
    assert _ver(four, other, "pear") < 0.35


def test_adding_a_member_changes_no_bit_of_what_was_known(three, four):
    before, after = (networks_state(load_checkpoint(folder).tensors) for folder in (three, four))
    assert all(torch.equal(after[name], value) for name, value in before.items())
    new = after.keys() - before.keys()
    assert new
    assert all(".pear." in name for name in new)
    old, grown = Run.open(three), Run.open(four)
    assert all(torch.equal(grown.layouts[key], value) for key, value in old.layouts.items())


def test_adding_goes_on_where_it_stopped_even_without_the_run_it_began_from(three, four, rig_files, tmp_path):
    config = replace(load_config(four / "config.toml"), run=str(tmp_path / "stopped"))
    started = replace(config, training=replace(config.training, save_every=50))

    class Stopped(Exception):
        pass

    from reenact import training

    save = training._save

    def stop(*arguments):
        save(*arguments)
        raise Stopped

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "_save", stop)
        with pytest.raises(Stopped):
            train(started)
    path = tmp_path / "stopped" / "config.toml"
    save_config(replace(load_config(path), base=str(tmp_path / "moved away")), path)
    train(replace(config, run=str(tmp_path / "stopped")), resume=True)
    expected, actual = (networks_state(load_checkpoint(folder).tensors) for folder in (four, tmp_path / "stopped"))
    assert all(torch.equal(expected[name], actual[name]) for name in expected)


@pytest.mark.parametrize(("shown", "growth"), [(1, [0, 0]), (2, [1, 0]), (9, [1, 1])])
def test_each_expression_is_shown_on_so_many_partners_and_no_more(shown, growth, toy_config, rig_files, tmp_path):
    """Counted as what is photographed while the networks learn: from a third and a fourth rig on, as much for every
    rig, or the pictures of its expressions on one partner more."""
    counts = []
    for size in (2, 3, 4):
        drawn = []
        photograph = Studio.photograph

        def count(self, weights, buffers=None, drawn=drawn, photograph=photograph):
            drawn.append(len(weights))
            return photograph(self, weights, buffers)

        config = replace(
            toy_config,
            cast=rig_files[:size],
            run=str(tmp_path / str(size)),
            bpnet=_no_renders(toy_config),
            pairs=PairsConfig(shown=shown),
        )
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("reenact.training.save_preview", lambda *_: None)
            patch.setattr(Studio, "photograph", count)
            train(config)
        counts.append(sum(drawn) / size)
    once = toy_config.training.frames * -(-toy_config.training.steps // toy_config.training.refresh)
    assert [(after - before) / once for before, after in pairwise(counts)] == growth


def _no_renders(config):
    return replace(config.bpnet, image_loss=0.0)


def test_a_cast_is_registered_to_its_first_rig_alone_and_compared_with_few(
    toy_config, rig_files, tmp_path, monkeypatch
):
    asked = []
    find = correspondences.find_correspondence
    monkeypatch.setattr(
        "reenact.run.find_correspondence", lambda a, b, n: asked.append((a.name, b.name)) or find(a, b, n)
    )
    config = replace(toy_config, cast=rig_files, run=str(tmp_path / "run"), pairs=PairsConfig(partners=2))
    run = Run.create(config)
    assert asked == [("ball", "egg"), ("ball", "bean"), ("ball", "pear")]
    partners = {key: run.partners(key) for key in run.keys}
    assert partners == {
        "ball": ["egg", "bean"],
        "egg": ["ball", "bean"],
        "bean": ["ball", "pear"],
        "pear": ["ball", "egg"],
    }
    assert Run.open(run.folder).correspondences.keys() == run.correspondences.keys()


def test_places_are_told_by_way_of_the_first_rig(three):
    """The toys share their topology, so the truth is known; found directly, they miss by as much."""
    run = Run.open(three)
    told = run.correspondence("egg", "bean")
    assert len(told) > 90  # of the 103 vertices that the toys' shapes move
    egg, bean = run.rigs["egg"], run.rigs["bean"]
    expected = told.source.of(bean.neutral)
    size = float(bean.neutral[:, 1].max() - bean.neutral[:, 1].min())
    missed = (told.target.of(bean.neutral) - expected).norm(dim=-1)
    assert float(missed.median()) < 0.03 * size
    assert told.source.corners.max() < len(egg.neutral)
    there, back = run.correspondence("ball", "egg"), run.correspondence("egg", "ball")
    assert len(there) == len(back)


def test_pairs_meet_at_vertices_of_the_rig_between():
    first = Correspondence(
        Places.at(torch.arange(6)), Places.at(torch.tensor([9, 8, 7, 6, 5, 4])), torch.full((6,), 0.5)
    )
    second = Correspondence(
        Places.at(torch.tensor([4, 5, 6, 7, 3])), Places.at(torch.arange(10, 15)), torch.ones(5) / 4
    )
    joined = first.then(second)
    assert joined.source.corners[:, 0].tolist() == [2, 3, 4, 5]
    assert joined.target.corners[:, 0].tolist() == [13, 12, 11, 10]
    assert joined.confidence.tolist() == [0.125] * 4
    with pytest.raises(ReenactError, match="expected at least 4 pairs that meet on a third rig, got 3"):
        first.then(second[torch.tensor([0, 1, 2, 4])])


def test_rigs_of_a_cast_are_chosen_by_any_of_their_names(three, rig_files, capsys, tmp_path):
    run = Run.open(three)
    assert run.pair() == ("ball", "egg")
    assert run.pair("bean") == ("bean", "ball")
    assert run.pair(None, "ball") == ("egg", "ball")
    assert run.pair(rig_files[2], "egg") == ("bean", "egg")
    out = tmp_path / "moved.csv"
    assert main(["infer", f"{three}", "synthetic:3:1", "--from", "bean", "--to", "egg", "--out", f"{out}"]) == 0
    assert "bean -> egg" in capsys.readouterr().out
    assert main(["infer", f"{three}", "synthetic:3:1", "--from", "cat", "--out", f"{out}"]) == 2
    assert "three: expected a rig of the run, ball, egg, bean, got cat" in capsys.readouterr().err
    assert main(["infer", f"{three}", "synthetic:3:1", "--to", "egg", "--from", "egg", "--out", f"{out}"]) == 2
    assert "expected two rigs, got egg twice; it has ball, egg, bean" in capsys.readouterr().err
    copied = ["--method", "copy", "--from", "bean", "--to", "ball"]
    assert main(["infer", f"{three}", "synthetic:3:1", *copied, "--out", f"{out}"]) == 0
    assert "bean -> ball" in capsys.readouterr().out
    assert main(["infer", "x.csv", *copied, "--out", f"{out}"]) == 2
    assert "expected a RUN beside --from and --to" in capsys.readouterr().err


def test_a_pair_of_a_cast_is_evaluated_and_shown(three, capsys):
    from reenact.viewer.session import Session

    assert main(["evaluate", f"{three}", "--frames", "24", "--from", "egg", "--to", "bean"]) == 0
    numbers = json.loads((three / "evaluation" / "metrics.json").read_text())
    assert (numbers["source"], numbers["target"]) == ("egg", "bean")
    assert (three / "report.html").is_file()
    session = Session.open([f"{three}"], "synthetic:3:1", source="egg", target="bean")
    assert list(session.rigs) == ["egg", "bean"]
    expected = ImageRetargeter.load(three, source="egg", target="bean")(session.clip).weights
    assert torch.allclose(torch.cat(list(session.track("bean", "networks"))), expected)


@pytest.mark.parametrize("network", ["components", "convolutional"])
@pytest.mark.parametrize("together", [True, False])
def test_every_kind_of_network_trains_a_cast(network, together, toy_config, rig_files, tmp_path):
    config = replace(
        toy_config,
        cast=rig_files[:3],
        run=str(tmp_path / "run"),
        pairs=PairsConfig(method="pictures"),
        reenactnet=replace(toy_config.reenactnet, network=network),
        training=replace(
            toy_config.training, elastic=0.02, together=together, cycle_loss=0.5 * together, align_loss=0.1 * together
        ),
    )
    folder = train(config)
    assert all(torch.isfinite(value).all() for value in networks_state(load_checkpoint(folder).tensors).values())
    if network == "convolutional" and together:
        grown = train(replace(config, cast=rig_files, base=str(folder), run=str(tmp_path / "grown")))
        before, after = (networks_state(load_checkpoint(each).tensors) for each in (folder, grown))
        assert all(torch.equal(after[name], value) for name, value in before.items())


def test_a_pair_can_grow_to_a_cast(toy_run, rig_files, tmp_path):
    assert main(["add", f"{toy_run.folder}", rig_files[2], "--run", f"{tmp_path / 'run'}", "--steps", "3"]) == 0
    assert Run.open(tmp_path / "run").keys == ["ball", "egg", "bean"]
    assert load_checkpoint(tmp_path / "run").step == 3


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"cast": ("a",)}, "cast: expected two rigs or more, got a alone"),
        ({"cast": ("a", "b"), "source_clip": "x.csv"}, "source_clip: expected a source and a target beside it, got a"),
        ({"base": "run"}, "base: expected the cast that it grows to"),
    ],
)
def test_settings_of_a_pair_do_not_go_with_a_cast(changes, sentence):
    with pytest.raises(ReenactError, match=sentence):
        check_config(replace(Config(), **changes))


def test_a_rig_that_is_added_has_no_stages():
    config = Config(cast=("a", "b"), base="run")
    with pytest.raises(ReenactError, match=r"base: expected training.together"):
        check_config(replace(config, training=replace(config.training, together=False)))


def test_what_does_not_fit_the_run_that_is_added_to_is_refused(toy_run, toy_config, rig_files, tmp_path, capsys):
    pair = toy_run.config.rigs
    good = replace(toy_config, base=str(toy_run.folder), cast=(*pair, rig_files[2]), run=str(tmp_path / "run"))
    bad = {
        "expected its rigs and at least one more as cast": replace(good, cast=rig_files),
        "expected its own settings of images": replace(good, images=replace(good.images, resolution=48)),
        "expected its own sizes of bpnet": replace(good, bpnet=replace(good.bpnet, hidden=8)),
    }
    for sentence, config in bad.items():
        with pytest.raises(ReenactError, match=sentence):
            Run.create(config)
    assert not (tmp_path / "run").exists()
    assert main(["add", f"{toy_run.folder}"]) == 2
    assert "expected at least one rig" in capsys.readouterr().err
