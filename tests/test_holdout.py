"""The check at every save: worked out by hand, blind to nothing that trains, and without a trace in what is trained."""

import json
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
import torch
from conftest import make_toy_rig

from reenact import training as module
from reenact.checkpoint import best_checkpoint, load_checkpoint
from reenact.config import PairsConfig
from reenact.data import Studio
from reenact.holdout import Holdout
from reenact.inference import ImageRetargeter
from reenact.losses import VertexDistance
from reenact.pairs import LEAST_TRUST, Pairs, Teacher
from reenact.rigs import motion
from reenact.rigs.files import save_rig
from reenact.run import Run, networks_state
from reenact.training import next_save, train


def logged(folder) -> list[dict]:
    return [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]


@pytest.fixture(scope="module")
def parts(toy_run):
    """All that a holdout of the toys is made of."""
    studios = {key: toy_run.studio(key) for key in toy_run.keys}
    teachers = {
        (source, target): toy_run.teacher(studios[source], studios[target], source, target)
        for source, target in permutations(toy_run.keys, 2)
    }
    distances = {key: VertexDistance(studio.rig, studio.typical) for key, studio in studios.items()}
    return studios, toy_run.trained_networks(), teachers, distances


def test_the_numbers_are_what_inference_errs_by(parts, toy_run):
    """A slow twin: the clip of the same expressions through `ImageRetargeter`, one by one."""
    studios, networks, teachers, distances = parts
    found = Holdout(studios, networks, teachers, distances, toy_run.keys, seed=3, count=20)(networks, toy_run.keys)
    wrong = {}
    for place, (source, target) in enumerate((toy_run.keys, toy_run.keys[::-1])):
        random = np.random.default_rng([3, 0, 0, place, 0x68656C64])
        weights = studios[source].expressions(20, random)
        retargeter = ImageRetargeter.load(toy_run.folder, source=source, target=target)
        moved = torch.stack([retargeter.step(row) for row in weights])
        told = teachers[source, target].weights(weights)
        trust = teachers[source, target].confidence(weights, told).clamp_min(LEAST_TRUST)
        wrong[target] = float(distances[target](moved, told) @ trust / trust.sum())
        own = ImageRetargeter.load(toy_run.folder, source=target, target=source).read(
            studios[source].photograph(weights)
        )
        assert found[f"held_out_own.{source}"] == pytest.approx(float(distances[source](own, weights).mean()), rel=1e-4)
    for target, error in wrong.items():
        assert found[f"held_out.{target}"] == pytest.approx(error, rel=1e-4)  # sums in another order
    assert found["held_out"] == pytest.approx(sum(wrong.values()) / 2, rel=1e-4)


def test_networks_that_know_the_answer_err_by_nothing_and_still_ones_by_the_motion(parts, toy_run, monkeypatch):
    studios, networks, teachers, distances = parts
    holdout = Holdout(studios, networks, teachers, distances, toy_run.keys, seed=0)
    assert [len(each.weights) for each in holdout.directions] == [256, 256]
    answers = iter([*holdout.own.values(), *holdout.directions])
    monkeypatch.setattr(
        Holdout, "_error", lambda _, __, each: float(distances[each.target](each.weights, next(answers).weights).max())
    )
    assert set(holdout(networks, toy_run.keys).values()) == {0.0}
    monkeypatch.undo()
    for key, own in holdout.own.items():
        still = float(distances[key](torch.zeros_like(own.weights), own.weights).square().mean().sqrt())
        assert 0.8 < still < 1.25  # as large as the typical motion, which other expressions told


def test_without_teachers_own_pictures_stand_for_a_direction(parts, toy_run):
    studios, networks, _, distances = parts
    found = Holdout(studios, networks, {}, distances, toy_run.keys, seed=0, count=20)(networks, toy_run.keys)
    assert found["held_out.egg"] == found["held_out_own.egg"]
    assert found["held_out"] == pytest.approx((found["held_out.ball"] + found["held_out.egg"]) / 2)


def test_what_cannot_be_read_yet_has_no_number_and_no_mean(parts, toy_run):
    studios, networks, teachers, distances = parts
    holdout = Holdout(studios, networks, teachers, distances, toy_run.keys, seed=0, count=20)
    assert holdout(networks, []) == {}
    assert holdout(networks, ["ball"]).keys() == {"held_out.ball", "held_out_own.ball"}


def test_doubtful_labels_count_less_and_none_is_no_division_by_zero(parts, toy_run):
    studios, networks, _, distances = parts
    doubtful = Pairs(torch.zeros(7, 7), torch.tensor([1.0, *[0.0] * 6]), (), torch.ones(7), torch.zeros(7, 7))
    nothing = Pairs(torch.zeros(7, 7), torch.zeros(7), (), torch.ones(7), torch.zeros(7, 7))
    for pairs, even in ((doubtful, False), (nothing, True)):
        teachers = {("ball", "egg"): Teacher(pairs, None)}
        holdout = Holdout(studios, networks, teachers, distances, toy_run.keys, seed=0, count=20)
        direction, own = holdout.directions
        assert (direction.target, own.target) == ("egg", "ball")  # nobody shows the ball
        assert float(direction.share.sum()) == pytest.approx(1)
        assert bool((direction.share == direction.share[0]).all()) == even


def test_no_expression_of_it_is_trained_on(toy_config, tmp_path, monkeypatch):
    drawn, checked = [], []
    expressions = motion.expressions

    def told(names, count, seed, *shares):
        made = expressions(names, count, seed, *shares)
        if isinstance(seed, np.random.Generator):
            drawn.append(made)
        return made

    monkeypatch.setattr(motion, "expressions", told)
    monkeypatch.setattr(
        module, "_holdout", lambda shop, real=module._holdout: (checked.append(len(drawn)), real(shop))[1]
    )
    train(replace(toy_config, run=str(tmp_path / "run")))
    place = checked[0]
    held, others = torch.cat(drawn[place : place + 2]), torch.cat(drawn[:place] + drawn[place + 2 :])
    assert len(held) == 32  # no more than the 16 that the training has in memory, of each rig
    assert len(others) > 500
    assert float((held[:, None] - others).abs().amax(2).min()) > 0  # of one shape alone some come near


def test_the_check_changes_no_bit_of_a_training(toy_config, tmp_path, monkeypatch):
    with_it = train(replace(toy_config, run=str(tmp_path / "with")))
    monkeypatch.setattr(module, "_holdout", lambda _: None)
    without = train(replace(toy_config, run=str(tmp_path / "without")))
    one, other = (load_checkpoint(folder).tensors for folder in (with_it, without))
    assert one.keys() == other.keys()
    assert all(torch.equal(one[name], other[name]) for name in one)  # the optimizer's too
    ignored = ("steps_per_second", "held_out")
    lines = [
        [{key: value for key, value in line.items() if not key.startswith(ignored)} for line in logged(folder)]
        for folder in (with_it, without)
    ]
    assert lines[0] == lines[1]
    assert not any("held_out" in line for line in logged(without))
    assert best_checkpoint(without) is None


@pytest.mark.parametrize("network", ["components", "convolutional"])
def test_the_best_is_the_least_of_the_logged_numbers(network, toy_config, tmp_path):
    config = replace(
        toy_config,
        run=str(tmp_path / "run"),
        reenactnet=replace(toy_config.reenactnet, network=network),
        training=replace(
            toy_config.training, steps=40, save_every=5, keep=1, milestones=14, learning_rate=0.05, schedule="constant"
        ),
    )
    folder = train(config)
    numbers = {line["step"]: line["held_out"] for line in logged(folder) if "held_out" in line}
    assert list(numbers) == [5, 10, 14, 15, 20, 25, 28, 30, 35, 40]
    best = min(numbers, key=numbers.__getitem__)
    assert best_checkpoint(folder) == (best, numbers[best])
    assert (folder / "checkpoints" / "best").read_text() == f"step-{best:08d}.safetensors {numbers[best]!r}\n"
    kept = sorted(int(path.stem.removeprefix("step-")) for path in folder.glob("checkpoints/step-*"))
    assert kept == sorted({14, 28, 40, best})
    assert load_checkpoint(folder, "best").error == numbers[best]
    assert all(set(line) >= {"loss", "steps_per_second"} for line in logged(folder))


def test_stages_have_a_best_only_where_every_rig_is_read(toy_config, tmp_path):
    staged = replace(toy_config.training, together=False, keep=1)
    folder = train(replace(toy_config, run=str(tmp_path / "run"), training=staged))
    named = {"reenactnet": set(), "bpnet.ball": {"held_out.ball", "held_out_own.ball"}}
    named["bpnet.egg"] = {"held_out", "held_out.egg", "held_out_own.egg"} | named["bpnet.ball"]
    for line in logged(folder):
        assert {key for key in line if key.startswith("held_out")} == named[line["stage"]]
    last = {24 + line["step"]: line["held_out"] for line in logged(folder) if "held_out" in line}
    assert list(last) == [29, 34, 36]
    assert best_checkpoint(folder) == min(last.items(), key=lambda each: each[1])


def test_a_cast_is_checked_in_every_direction_and_an_added_rig_in_its_own(toy_config, tmp_path):
    names = ("ball", "egg", "bean")
    for index, name in enumerate(names):
        save_rig(make_toy_rig(name, stretch=1 + 0.12 * index, hue=index), tmp_path / f"{name}.npz")
    rigs = tuple(f"{tmp_path / name}.npz" for name in names)
    config = replace(toy_config, cast=rigs, run=str(tmp_path / "cast"))
    cast = train(config)
    assert {f"held_out.{name}" for name in names} <= logged(cast)[-1].keys()
    pair = train(replace(config, cast=rigs[:2], run=str(tmp_path / "pair")))
    grown = train(replace(config, base=str(pair), run=str(tmp_path / "grown")))
    line = logged(grown)[-1]
    assert [key for key in line if key.startswith("held_out_own")] == ["held_out_own.bean"]  # the others read as before
    weights = [1, 1, 2]  # bean is moved by both others, each of which is moved by bean alone
    parts = [line[f"held_out.{name}"] for name in names]
    assert line["held_out"] == pytest.approx(np.average(parts, weights=weights))
    run = Run.open(cast)
    counted = {}

    def counting(self, weights, buffers=None, photograph=Studio.photograph):
        counted[self.rig.name] = counted.get(self.rig.name, 0) + len(weights)
        return photograph(self, weights, buffers)

    with pytest.MonkeyPatch.context() as patch:
        studios = {key: run.studio(key) for key in run.keys}
        teachers = {
            (source, target): Teacher(Pairs(torch.eye(7), torch.ones(7), (), torch.ones(7), torch.zeros(7, 7)), None)
            for source in run.keys
            for target in run.partners(source)
        }
        distances = {key: VertexDistance(studio.rig, studio.typical) for key, studio in studios.items()}
        patch.setattr(Studio, "photograph", counting)
        holdout = Holdout(studios, run.trained_networks(), teachers, distances, run.keys, 0, 31)
    assert counted == dict.fromkeys(names, 31)  # as much for three as for two
    assert sorted(len(each.weights) for each in holdout.directions) == [15, 15, 15, 16, 16, 16]


def test_a_check_that_fails_stops_no_save(toy_config, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(Holdout, "__call__", lambda *_: (_ for _ in ()).throw(RuntimeError("no memory")))
    folder = train(replace(toy_config, run=str(tmp_path / "run"), pairs=PairsConfig(method="none")))
    assert "check skipped: no memory" in capsys.readouterr().out
    assert load_checkpoint(folder).step == 12
    assert best_checkpoint(folder) is None
    monkeypatch.setattr(Holdout, "__call__", lambda *_: {"held_out": float("nan"), "held_out.egg": 0.5})
    folder = train(replace(toy_config, run=str(tmp_path / "nan"), pairs=PairsConfig(method="none")))
    assert {line["held_out.egg"] for line in logged(folder)} == {0.5}
    assert not any("held_out" in line for line in logged(folder))
    assert best_checkpoint(folder) is None


def test_saves_say_what_they_are_worth(toy_config, tmp_path, capsys):
    folder = train(replace(toy_config, run=str(tmp_path / "run")))
    said = [line for line in capsys.readouterr().out.splitlines() if ": saved step " in line]
    numbers = [line["held_out"] for line in logged(folder)]
    assert said[0] == f"networks: saved step 5, held-out error {numbers[0]:.4f}, the best so far"
    assert len(said) == 3


def test_a_run_that_has_no_numbers_yet_gets_them_as_it_goes_on(toy_config, tmp_path, monkeypatch):
    config = replace(toy_config, run=str(tmp_path / "run"))

    class Stopped(Exception):
        pass

    def stop(*arguments, save=module._save):
        save(*arguments)
        raise Stopped

    with monkeypatch.context() as patch:
        patch.setattr(module, "_save", stop)
        patch.setattr(module, "_holdout", lambda _: None)
        with pytest.raises(Stopped):
            train(config)
    assert best_checkpoint(tmp_path / "run") is None
    train(config, resume=True)
    whole = train(replace(config, run=str(tmp_path / "whole")))
    assert [line.get("held_out") for line in logged(tmp_path / "run")][1:] == [
        line["held_out"] for line in logged(whole)
    ][1:]
    one, other = (networks_state(load_checkpoint(folder).tensors) for folder in (whole, tmp_path / "run"))
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_saves_are_due_at_the_end_at_every_so_many_steps_and_at_milestones(toy_config):
    training = replace(toy_config.training, save_every=10, milestones=25)
    assert [next_save(training, step, 40, 0) for step in (0, 9, 10, 20, 25, 30)] == [10, 10, 20, 25, 30, 40]
    assert [next_save(training, step, 40, 17) for step in (0, 8, 30, 33)] == [8, 10, 33, 40]
    assert next_save(replace(training, milestones=0), 20, 40, 17) == 30
