"""Checkpoints: bit for bit, whole or absent."""

import errno
import json
import os
import random

import numpy as np
import pytest
import safetensors.torch
import torch
from torch import nn

from reenact import checkpoint as module
from reenact.checkpoint import (
    best_checkpoint,
    flatten_optimizer,
    has_checkpoint,
    load_checkpoint,
    load_tensors,
    random_state,
    restore_optimizer,
    restore_random_state,
    save_checkpoint,
    save_tensors,
)
from reenact.errors import ReenactError

KINDS = {
    "float32": torch.tensor([[1.5, float("nan")], [float("-inf"), 1e-45]]),  # 1e-45 is subnormal
    "float64": torch.tensor([1 / 3], dtype=torch.float64),
    "bfloat16": torch.tensor([1.0, 3.140625], dtype=torch.bfloat16),
    "int64": torch.tensor(2**62),
    "bool": torch.tensor([True, False]),
    "empty": torch.zeros(0, 3),
    "transposed": torch.arange(6.0).reshape(2, 3).T,
}


def same(one, other):
    """Equal bits; `torch.equal` says that NaN differs from NaN."""
    return (
        one.dtype == other.dtype
        and one.shape == other.shape
        and one.contiguous().reshape(-1).view(torch.uint8).tolist()
        == other.contiguous().reshape(-1).view(torch.uint8).tolist()
    )


def steps_on_disk(run_dir):
    return sorted(int(path.name[5:13]) for path in (run_dir / "checkpoints").glob("step-*.safetensors"))


@pytest.mark.parametrize("kind", KINDS)
def test_tensors_come_back_bit_for_bit(kind, tmp_path):
    save_checkpoint(tmp_path, 1, {kind: KINDS[kind]}, {})
    assert same(load_checkpoint(tmp_path).tensors[kind], KINDS[kind])


def test_tensors_that_share_memory_come_back_as_two(tmp_path):
    shared = torch.arange(4.0)
    save_checkpoint(tmp_path, 1, {"a": shared, "b": shared[1:3]}, {})
    assert same(load_checkpoint(tmp_path).tensors["b"], shared[1:3])


def test_the_state_comes_back(tmp_path):
    state = {"stage": "bpnet", "epoch": 3, "rate": 1 / 3, "big": 2**127 + 1, "names": ["é", "日"], "none": None}
    save_checkpoint(tmp_path, 12, {}, state)
    found = load_checkpoint(tmp_path)
    assert (found.step, found.state) == (12, state)


def test_the_newest_are_kept_and_the_latest_is_loaded(tmp_path):
    assert not has_checkpoint(tmp_path)
    for step in (10, 20, 30, 40):
        save_checkpoint(tmp_path, step, {"step": torch.tensor(step)}, {}, keep=2)
    assert has_checkpoint(tmp_path)
    assert steps_on_disk(tmp_path) == [30, 40]
    assert load_checkpoint(tmp_path).step == 40
    assert sorted(path.name for path in (tmp_path / "checkpoints").iterdir()) == [
        "latest",
        "step-00000030.safetensors",
        "step-00000040.safetensors",
    ]


def test_a_run_that_went_back_does_not_lose_its_new_checkpoints_to_the_old_future(tmp_path):
    for step in (10, 20, 30):
        save_checkpoint(tmp_path, step, {}, {"life": 1}, keep=2)
    save_checkpoint(tmp_path, 25, {}, {"life": 2}, keep=1)
    assert load_checkpoint(tmp_path).state == {"life": 2}


def test_checkpoints_are_ordered_by_step_when_the_pointer_is_lost(tmp_path):
    for step in (99_999_999, 100_000_000):  # one digit more: not the order of the names
        save_checkpoint(tmp_path, step, {}, {})
    (tmp_path / "checkpoints" / "latest").unlink()
    assert load_checkpoint(tmp_path).step == 100_000_000


ERRORS = {10: 0.5, 20: 0.25, 30: 0.75, 40: None, 50: 0.25, 60: 0.3}
"""By step; of equal ones the earlier is the best."""


def _saved(run_dir, steps=tuple(ERRORS), **settings):
    for step in steps:
        save_checkpoint(run_dir, step, {"w": torch.full((50,), float(step))}, {}, error=ERRORS[step], **settings)


def _pointer(run_dir):
    return (run_dir / "checkpoints" / "best").read_text()


def test_the_best_and_the_milestones_stay_beside_the_newest(tmp_path):
    _saved(tmp_path, keep=2, milestones=30)
    assert steps_on_disk(tmp_path) == [20, 30, 50, 60]
    assert _pointer(tmp_path) == "step-00000020.safetensors 0.25\n"
    assert best_checkpoint(tmp_path) == (20, 0.25)
    best = load_checkpoint(tmp_path, "best")
    assert (best.step, best.error, best.tensors["w"][0].item()) == (20, 0.25, 20.0)
    assert load_checkpoint(tmp_path).step == 60
    assert load_checkpoint(tmp_path, "30").step == 30


def test_a_better_one_takes_the_place_of_the_best(tmp_path):
    _saved(tmp_path, (10, 30, 60, 20, 40), keep=1)
    assert steps_on_disk(tmp_path) == [20, 40, 60]  # 60 was the future when 20 and 40 were saved
    _saved(tmp_path, (10, 20), keep=1)
    assert _pointer(tmp_path).startswith("step-00000020")


def test_the_best_of_an_abandoned_future_is_not_the_best(tmp_path):
    _saved(tmp_path, (10, 20), keep=3)
    save_checkpoint(tmp_path, 15, {}, {}, error=0.6, keep=3)
    assert _pointer(tmp_path) == "step-00000010.safetensors 0.5\n"
    assert load_checkpoint(tmp_path, "best").step == 10
    assert load_checkpoint(tmp_path, "20").step == 20  # still there for those who ask


def test_checkpoints_that_nobody_checked_have_no_best(tmp_path):
    for step in (10, 20, 30):
        save_checkpoint(tmp_path, step, {}, {}, error=float("nan") if step == 30 else None, keep=2)
    assert steps_on_disk(tmp_path) == [20, 30]
    assert not (tmp_path / "checkpoints" / "best").exists()
    assert best_checkpoint(tmp_path) is None
    with pytest.raises(ReenactError, match=r"expected one that was checked .* got none; there are those of steps 20, "):
        load_checkpoint(tmp_path, "best")


@pytest.mark.parametrize("which", ["45", "last", "", "-20", "²", "9" * 5000])
def test_a_checkpoint_that_is_not_there_is_refused_with_those_that_are(which, tmp_path):
    _saved(tmp_path, keep=2)
    with pytest.raises(
        ReenactError, match=r"expected newest, best or a step .*; there are those of steps 20 \(best\), 50"
    ):
        load_checkpoint(tmp_path, which)


@pytest.mark.parametrize("text", ["", "\xff\x00", "step-00000007.safetensors 0.1", "../../x 0.1", "[1]"])
def test_a_damaged_pointer_to_the_best_is_told_and_mended_by_the_next_save(text, tmp_path):
    _saved(tmp_path, (10, 20, 30))
    (tmp_path / "checkpoints" / "best").write_bytes(text.encode("latin-1"))
    with pytest.warns(
        UserWarning, match=r"best: expected the name of a checkpoint that is there, got .*; taking step-0*20"
    ):
        assert load_checkpoint(tmp_path, "best").step == 20
    assert load_checkpoint(tmp_path).step == 30
    _saved(tmp_path, (40,))
    assert _pointer(tmp_path) == "step-00000020.safetensors 0.25\n"


def test_a_lost_pointer_to_the_best_loses_nothing(tmp_path):
    _saved(tmp_path, (10, 20, 30))
    (tmp_path / "checkpoints" / "best").unlink()
    assert load_checkpoint(tmp_path, "best").step == 20
    (tmp_path / "checkpoints" / "step-00000020.safetensors").unlink()  # as a version does that knows of no best
    assert load_checkpoint(tmp_path, "best").step == 10
    _saved(tmp_path, (40,))
    assert _pointer(tmp_path) == "step-00000010.safetensors 0.5\n"


@pytest.mark.parametrize("place", [0, 40, -1])  # the length of the header, the header, the tensors
def test_a_damaged_best_falls_back_to_the_next_with_a_word(place, tmp_path):
    _saved(tmp_path, (10, 20, 30), keep=1)
    _saved(tmp_path, (40,), keep=2)
    assert steps_on_disk(tmp_path) == [20, 30, 40]
    path = tmp_path / "checkpoints" / "step-00000020.safetensors"
    data = bytearray(path.read_bytes())
    data[place] ^= 255
    path.write_bytes(data)
    if place == -1:
        with pytest.warns(UserWarning, match=r"step-00000020.*damaged.*; taking step-00000030"):
            assert load_checkpoint(tmp_path, "best").step == 30
    else:  # what it tells cannot be read
        assert load_checkpoint(tmp_path, "best").step == 30
    with (
        pytest.warns(UserWarning, match="damaged"),
        pytest.raises(ReenactError, match="take another checkpoint or train"),
    ):
        load_checkpoint(tmp_path, "20")


def test_a_disk_that_fails_to_tell_what_a_checkpoint_is_worth_removes_none(tmp_path, monkeypatch):
    _saved(tmp_path, (20, 30), keep=2)
    real = module.json.loads
    monkeypatch.setattr(module.json, "loads", lambda _: (_ for _ in ()).throw(OSError(errno.EIO, "Input/output error")))
    with pytest.raises(OSError, match=r"Input/output error: '.*step-00000020"):
        _saved(tmp_path, (40,), keep=1)
    monkeypatch.setattr(module.json, "loads", real)
    assert steps_on_disk(tmp_path) == [20, 30, 40]
    assert load_checkpoint(tmp_path).step == 30


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize("number", range(1, 19))
def test_a_save_that_is_killed_anywhere_leaves_a_best_that_is_there(number, tmp_path):
    """A child ends at some call of the system; what is left must load, and the same save again must end as unbroken."""
    _saved(tmp_path / "run", (10, 20, 30), keep=1)
    child = os.fork()
    if child == 0:
        left = [number]

        def mortal(call):
            def wrapped(*arguments, **keywords):
                left[0] -= 1
                if left[0] == 0:
                    os._exit(9)
                return call(*arguments, **keywords)

            return wrapped

        for name in ("fsync", "replace", "open", "unlink", "close"):
            setattr(os, name, mortal(getattr(os, name)))
        save_checkpoint(tmp_path / "run", 60, {"w": torch.full((50,), 60.0)}, {}, error=0.1, keep=1)
        os._exit(0)
    died = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9
    assert died == (number <= 17)  # five calls for each of three files, and two removals
    assert load_checkpoint(tmp_path / "run").step in (30, 60)
    assert (tmp_path / "run" / "checkpoints" / _pointer(tmp_path / "run").split()[0]).is_file()
    assert load_checkpoint(tmp_path / "run", "best").step == (
        20 if load_checkpoint(tmp_path / "run").step == 30 else 60
    )
    save_checkpoint(tmp_path / "run", 60, {"w": torch.full((50,), 60.0)}, {}, error=0.1, keep=1)
    assert _pointer(tmp_path / "run") == "step-00000060.safetensors 0.1\n"
    assert steps_on_disk(tmp_path / "run") == [60]


@pytest.mark.parametrize("damage", ["empty", "torn", "header", "bit", "state", "foreign"])
def test_a_damaged_newest_falls_back_to_the_one_before_with_a_warning(damage, tmp_path):
    save_checkpoint(tmp_path, 1, {"w": torch.ones(100)}, {"a": 1})
    path = save_checkpoint(tmp_path, 2, {"w": torch.ones(100)}, {"a": 2})
    data = bytearray(path.read_bytes())
    if damage == "empty":
        data = bytearray()
    elif damage == "torn":
        data = data[:-7]
    elif damage == "header":
        data[:8] = (2**60).to_bytes(8, "little")
    elif damage == "bit":
        data[-1] ^= 1
    elif damage == "state":
        data = data.replace(b'\\"a\\": 2', b'\\"a\\": 3')
    elif damage == "foreign":
        data = bytearray(safetensors.torch.save({"w": torch.ones(100)}))
    assert bytes(data) != path.read_bytes()
    path.write_bytes(data)
    with pytest.warns(UserWarning, match=r"step-00000002.*damaged.*going on from step-00000001"):
        assert load_checkpoint(tmp_path).state == {"a": 1}


def test_no_damaged_byte_goes_unseen(tmp_path):
    path = save_checkpoint(tmp_path, 1, {"w": torch.ones(3), "b": torch.zeros(2)}, {"a": [1, None]})
    good = path.read_bytes()
    for place in range(0, len(good), 3):
        path.write_bytes(good[:place] + bytes([good[place] ^ (1 + place % 255)]) + good[place + 1 :])
        with pytest.warns(UserWarning, match="damaged"), pytest.raises(ReenactError, match="1 damaged ones"):
            load_checkpoint(tmp_path)


def _signed(content):
    text = json.dumps(content)
    return safetensors.torch.save({}, metadata={"reenact": text, "sha256": module._digest({}, text)})


def test_a_newer_format_is_refused_with_what_to_do(tmp_path):
    path = save_checkpoint(tmp_path, 1, {}, {})
    path.write_bytes(_signed({"format": module.FORMAT + 1, "step": 1, "state": {}}))
    with pytest.raises(ReenactError, match=f"of format {module.FORMAT} or older, got 2; update Reenact"):
        load_checkpoint(tmp_path)


@pytest.mark.parametrize("content", [{"format": "1", "step": 1, "state": {}}, {"format": 1, "step": 1}, [], 5])
def test_a_signed_header_of_another_kind_is_a_damaged_checkpoint(content, tmp_path):
    save_checkpoint(tmp_path, 1, {}, {}).write_bytes(_signed(content))
    with pytest.warns(UserWarning, match="damaged"), pytest.raises(ReenactError, match="damaged"):
        load_checkpoint(tmp_path)


def test_no_checkpoint_is_said_so(tmp_path):
    for run_dir in (tmp_path, tmp_path / "missing"):
        with pytest.raises(FileNotFoundError, match=r"expected checkpoints in .* got none"):
            load_checkpoint(run_dir)


@pytest.mark.parametrize(
    ("call", "number"),
    [("fsync", number) for number in range(6)]
    + [(call, number) for call in ("replace", "open") for number in range(3)],
)  # three files, each with its folder
def test_a_save_that_fails_anywhere_says_so_and_leaves_a_checkpoint_that_loads(call, number, tmp_path, monkeypatch):
    save_checkpoint(tmp_path, 1, {"w": torch.ones(5)}, {}, error=0.5, keep=1)
    real, calls = getattr(os, call), iter(range(100))

    def fail(*arguments, **keywords):
        if next(calls) == number:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(*arguments, **keywords)

    monkeypatch.setattr(os, call, fail)
    with pytest.raises(OSError, match="No space left"):
        save_checkpoint(tmp_path, 2, {"w": torch.zeros(5)}, {}, error=0.4, keep=1)
    monkeypatch.undo()
    assert load_checkpoint(tmp_path, "best").step == load_checkpoint(tmp_path).step
    found = load_checkpoint(tmp_path)
    assert found.tensors["w"].tolist() == [float(found.step == 1)] * 5
    assert not list((tmp_path / "checkpoints").glob(".*"))


def test_leftovers_of_a_killed_save_are_removed_by_the_next(tmp_path):
    save_checkpoint(tmp_path, 1, {}, {})
    leftover = tmp_path / "checkpoints" / ".step-00000002.safetensors.4242.tmp"
    leftover.write_bytes(b"half")
    save_checkpoint(tmp_path, 3, {}, {})
    assert not leftover.exists()


def test_named_tensors_alone_come_back(tmp_path):
    save_tensors(KINDS, tmp_path / "x.safetensors")
    found = load_tensors(tmp_path / "x.safetensors")
    assert set(found) == set(KINDS)
    assert all(same(found[kind], KINDS[kind]) for kind in KINDS)
    save_tensors({}, tmp_path / "x.safetensors")
    assert load_tensors(tmp_path / "x.safetensors") == {}


def test_bad_tensor_files_are_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"x\.safetensors: there is no such file"):
        load_tensors(tmp_path / "x.safetensors")
    (tmp_path / "x.safetensors").write_bytes(b"nothing of the kind")
    with pytest.raises(ReenactError, match=r"x\.safetensors: expected tensors, got a damaged file"):
        load_tensors(tmp_path / "x.safetensors")


OPTIMIZERS = {
    "adam": lambda parameters: torch.optim.Adam(parameters, lr=1e-2),
    "adamw": lambda parameters: torch.optim.AdamW(parameters, lr=1e-2, weight_decay=0.1, amsgrad=True),
    "momentum": lambda parameters: torch.optim.SGD(parameters, lr=1e-2, momentum=0.9),
    "groups": lambda parameters: torch.optim.AdamW([{"params": [p], "lr": 10.0**-k} for k, p in enumerate(parameters)]),
}


def _network():
    torch.manual_seed(3)
    return nn.Sequential(nn.Linear(4, 8), nn.SiLU(), nn.Linear(8, 2))


def _step(network, optimizer):
    optimizer.zero_grad()
    (network(torch.randn(5, 4)) ** 2).mean().backward()
    optimizer.step()


@pytest.mark.parametrize("kind", OPTIMIZERS)
def test_a_resumed_optimizer_takes_the_same_steps_bit_for_bit(kind, tmp_path):
    network = _network()
    optimizer = OPTIMIZERS[kind](list(network.parameters()))
    for _ in range(3):
        _step(network, optimizer)
    tensors, state = flatten_optimizer(optimizer)
    tensors |= {f"network.{name}": value for name, value in network.state_dict().items()}
    save_checkpoint(tmp_path, 3, tensors, {"optimizer": state, "random": random_state()})
    for _ in range(4):
        _step(network, optimizer)

    saved = load_checkpoint(tmp_path)
    resumed = _network()
    resumed.load_state_dict(
        {name.removeprefix("network."): value for name, value in saved.tensors.items() if name.startswith("network.")}
    )
    again = OPTIMIZERS[kind](list(resumed.parameters()))
    restore_optimizer(again, saved.tensors, saved.state["optimizer"])
    restore_random_state(saved.state["random"])
    for _ in range(4):
        _step(resumed, again)
    for one, other in zip(network.parameters(), resumed.parameters(), strict=True):
        assert same(one.detach(), other.detach())
    assert again.param_groups[0].keys() == optimizer.param_groups[0].keys()
    assert again.param_groups[0].get("betas") == optimizer.param_groups[0].get("betas")


def test_two_optimizers_in_one_checkpoint_do_not_mix():
    networks = _network(), _network()
    optimizers = [OPTIMIZERS["adam"](list(network.parameters())) for network in networks]
    for network, optimizer in zip(networks, optimizers, strict=True):
        _step(network, optimizer)
    one, state = flatten_optimizer(optimizers[0], "one")
    two, _ = flatten_optimizer(optimizers[1], "one.two")
    fresh = OPTIMIZERS["adam"](list(_network().parameters()))
    restore_optimizer(fresh, one | two, state, "one")
    assert same(fresh.state_dict()["state"][0]["exp_avg"], one["one.0.exp_avg"])
    assert not same(one["one.0.exp_avg"], two["one.two.0.exp_avg"])


def test_an_optimizer_of_another_network_is_refused():
    network, other, wider = _network(), nn.Linear(4, 8), nn.Sequential(nn.Linear(4, 9), nn.SiLU(), nn.Linear(9, 2))
    optimizer = OPTIMIZERS["adam"](list(network.parameters()))
    _step(network, optimizer)
    tensors, state = flatten_optimizer(optimizer)
    with pytest.raises(ReenactError, match=r"optimizer: expected a state for \[2\] parameters, got one for \[4\]"):
        restore_optimizer(OPTIMIZERS["adam"](list(other.parameters())), tensors, state)
    with pytest.raises(ReenactError, match=r"optimizer\.0\.exp_avg: expected shape \(9, 4\), got \(8, 4\)"):
        restore_optimizer(OPTIMIZERS["adam"](list(wider.parameters())), tensors, state)
    with pytest.raises(ReenactError, match=r"optimizer\.7\.exp_avg: expected shape None"):
        restore_optimizer(optimizer, {"optimizer.7.exp_avg": torch.zeros(2)}, state)


def _draws(own, torch_own):
    return (
        random.random(),
        float(np.random.random()),  # noqa: NPY002 - it is saved because libraries draw from it
        torch.rand(()).item(),
        float(own.standard_normal()),
        torch.rand((), generator=torch_own).item(),
    )


def test_every_random_number_after_a_restore_is_the_same():
    own, torch_own = np.random.default_rng(5), torch.Generator().manual_seed(6)
    np.random.standard_normal()  # noqa: NPY002 - leaves a second normal number behind, which is part of the state
    state = json.loads(json.dumps(random_state(data=own, noise=torch_own)))
    expected = [_draws(own, torch_own) for _ in range(3)]
    fresh, fresh_torch = np.random.default_rng(0), torch.Generator()
    restore_random_state(state, data=fresh, noise=fresh_torch)
    assert [_draws(fresh, fresh_torch) for _ in range(3)] == expected
    with pytest.raises(ReenactError, match=r"expected generators \['data'\], got \['data', 'noise'\]"):
        restore_random_state(state, data=fresh)


def test_nothing_on_disk_is_pickle(tmp_path):
    tensors, state = flatten_optimizer(OPTIMIZERS["adam"](list(_network().parameters())))
    save_checkpoint(tmp_path, 1, tensors, {"optimizer": state, "random": random_state()})
    for path in (tmp_path / "checkpoints").iterdir():
        data = path.read_bytes()
        assert not data.startswith((b"\x80", b"PK"))  # pickle protocol 2 and later; torch.save's zip
        assert b"__reduce__" not in data
