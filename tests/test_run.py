"""A run folder appears whole, opens whole, and says what it lacks."""

import shutil
from dataclasses import replace

import pytest
import torch
from conftest import make_toy_rig

from reenact.checkpoint import save_checkpoint, save_tensors
from reenact.config import save_config
from reenact.errors import ReenactError
from reenact.rigs.clip import Clip
from reenact.rigs.files import save_clip
from reenact.run import Run, _keys, _new_folder, networks_state


@pytest.fixture
def copied(toy_run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(toy_run.folder, folder)
    return folder


@pytest.fixture
def quick(toy_config):
    return replace(toy_config, layout=replace(toy_config.layout, method="none"))


def test_an_opened_run_is_the_one_that_was_made(toy_run):
    again = Run.open(toy_run.folder)
    assert again.config == toy_run.config
    assert again.keys == toy_run.keys == ["ball", "egg"]
    assert again.layouts.keys() == {"egg"}
    assert torch.equal(again.layouts["egg"], toy_run.layouts["egg"])
    for key, rig in toy_run.rigs.items():
        assert torch.equal(again.rigs[key].deltas, rig.deltas)


def test_networks_begin_the_same_and_come_back_as_saved(toy_run):
    first, second = (toy_run.networks().state_dict() for _ in range(2))
    assert all(torch.equal(first[name], second[name]) for name in first)
    trained = toy_run.trained_networks()
    assert not trained.training
    assert trained.reenactnet.bases["egg"][0].components.any()


def _no_layouts(folder):
    (folder / "layouts.safetensors").unlink()


def _other_layouts(folder):
    save_tensors({"someone": torch.zeros(4, 4, 2)}, folder / "layouts.safetensors")


def _flat_layout(folder):
    save_tensors({"egg": torch.zeros(4, 3, 2)}, folder / "layouts.safetensors")


def _infinite_layout(folder):
    save_tensors({"egg": torch.full((4, 4, 2), torch.inf)}, folder / "layouts.safetensors")


@pytest.mark.parametrize(
    ("damage", "sentence"),
    [
        (lambda folder: shutil.rmtree(folder / "rigs"), "rigs: expected the rigs of a run, .* got 0 files"),
        (lambda folder: (folder / "rigs" / "0-ball.npz").unlink(), "rigs: expected the rigs of a run, .* got 1 files"),
        (lambda folder: (folder / "rigs" / "1-egg.npz").write_bytes(b"PK"), "1-egg.npz: "),
        (_no_layouts, "layouts.safetensors: expected the layouts of the run, got no file"),
        (lambda folder: (folder / "layouts.safetensors").write_bytes(b"{}"), "layouts.safetensors: expected tensors"),
        (_other_layouts, "layouts.safetensors: expected layouts for egg, got someone"),
        (_flat_layout, r"layouts.safetensors: egg: expected \(R, R, 2\) finite float32, got \(4, 3, 2\)"),
        (_infinite_layout, "layouts.safetensors: egg: expected .* finite"),
        (lambda folder: (folder / "config.toml").write_text("steps = 1"), "config.toml: unknown key steps"),
    ],
)
def test_a_damaged_run_says_what_it_lacks(damage, sentence, copied):
    damage(copied)
    with pytest.raises(ReenactError, match=sentence):
        Run.open(copied)


def test_no_run_and_no_checkpoint_are_said_so(copied):
    with pytest.raises(FileNotFoundError, match="expected a run folder"):
        Run.open(copied / "none")
    shutil.rmtree(copied / "checkpoints")
    with pytest.raises(FileNotFoundError, match="expected checkpoints"):
        Run.open(copied).trained_networks()


def test_networks_of_other_settings_are_refused(copied, toy_run):
    config = toy_run.config
    save_config(replace(config, reenactnet=replace(config.reenactnet, code=8)), copied / "config.toml")
    with pytest.raises(ReenactError, match=r"got others .*expected .*, got .*or train again"):
        Run.open(copied).trained_networks()
    tensors = {f"networks.{name}": tensor for name, tensor in toy_run.networks().state_dict().items()}
    shutil.copy(toy_run.folder / "config.toml", copied / "config.toml")
    save_checkpoint(copied, 2, tensors | {"networks.more": torch.zeros(1)}, {})
    with pytest.raises(ReenactError, match="more: expected none, got"):
        Run.open(copied).trained_networks()


def test_the_networks_part_of_a_checkpoint_is_told_by_its_prefix():
    tensors = {"networks.a": torch.ones(1), "optimizer.0.a": torch.zeros(1)}
    assert networks_state(tensors) == {"a": tensors["networks.a"]}


def test_a_folder_that_holds_something_is_left_alone(quick, tmp_path):
    (tmp_path / "mine").write_text("text")
    for folder in (tmp_path, tmp_path / "mine"):
        with pytest.raises(ReenactError, match="never overwrites"):
            Run.create(replace(quick, run=str(folder)))
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize("linked", [False, True])
def test_an_empty_folder_is_taken_over_even_through_a_link(linked, quick, tmp_path):
    folder = tmp_path / "empty"
    folder.mkdir()
    if linked:
        (tmp_path / "link").symlink_to(folder)
        folder = tmp_path / "link"
    Run.create(replace(quick, run=str(folder)))
    assert Run.open(folder).layouts == {}
    assert folder.is_symlink() == linked


def test_the_folder_that_the_user_stands_in_is_taken_over(quick, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = Run.create(replace(quick, run="."))
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["config.toml", "correspondences", "format.json", "layouts.safetensors", "rigs"]
    assert Run.open(run.folder).keys == ["ball", "egg"]


def test_what_cannot_be_trained_leaves_no_folder(quick, tmp_path):
    with pytest.raises(ReenactError, match="no such file"):
        Run.create(replace(quick, source_clip="none.csv", run=str(tmp_path / "run")))
    assert not list(tmp_path.iterdir())


def test_a_training_clip_may_move_after_the_run_began(quick, toy_rig, tmp_path):
    weights = torch.rand(9, len(toy_rig.names), generator=torch.Generator().manual_seed(0))
    path = tmp_path / "clip.csv"
    save_clip(Clip(toy_rig.names, weights, 30.0), path)
    made = Run.create(replace(quick, target_clip=str(path), run=str(tmp_path / "run")))
    before = made.studio("egg")
    path.unlink()
    after = Run.open(tmp_path / "run").studio("egg")
    assert torch.equal(before.pool, after.pool)
    assert torch.equal(before.contrast, after.contrast)
    assert made.studio("ball").pool is None


def test_keys_are_safe_in_files_and_networks_and_all_different():
    names = ["a/b: c", "train", "ü", "man", "man", "man-3", "man", "x" * 300]
    keys = _keys([make_toy_rig(name) for name in names])
    assert keys == ["a-b-c", "train-rig", "rig", "man", "man-2", "man-3", "man-4", "x" * 60]
    torch.nn.ModuleDict({key: torch.nn.Identity() for key in keys})


def test_a_new_run_is_numbered(toy_pair, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert _new_folder(list(toy_pair)).as_posix() == "runs/ball-to-egg-1"
    (tmp_path / "runs" / "ball-to-egg-1").mkdir(parents=True)
    assert _new_folder(list(toy_pair)).as_posix() == "runs/ball-to-egg-2"
