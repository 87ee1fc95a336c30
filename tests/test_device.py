"""Devices: what is not there is refused in a sentence, and nothing of a training strays from where it belongs.

No GPU is needed here. PyTorch's device "meta" stands in for one: it holds shapes without numbers, and refuses, as a GPU
does, to meet what lies on the CPU.
"""

from dataclasses import replace

import pytest
import torch

from reenact import stages
from reenact.cli import main
from reenact.data import Studio, check_device
from reenact.errors import ReenactError
from reenact.inference import ImageRetargeter
from reenact.losses import VertexDistance
from reenact.rigs.rig import Rig
from reenact.team import Team

LACKING = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")


@LACKING
def test_a_gpu_that_is_not_there_is_refused_in_a_sentence(toy_run, toy_config, tmp_path, capsys):
    check_device("cpu")
    with pytest.raises(ReenactError, match=r'device: expected an NVIDIA GPU for "cuda", got .*; `reenact doctor` says'):
        check_device("cuda")
    command = ["train", "--run", f"{tmp_path / 'run'}", "--training.device", "cuda"]
    assert main(command) == 2
    assert "expected an NVIDIA GPU" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
    moving = ["infer", f"{toy_run.folder}", "synthetic:1:1", "--device", "cuda", "--out", f"{tmp_path / 'x.csv'}"]
    assert main(moving) == 2
    assert "expected an NVIDIA GPU" in capsys.readouterr().err


def test_a_gpu_without_what_renders_on_it_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr("reenact.data.importlib.util.find_spec", lambda _: None)
    with pytest.raises(ReenactError, match="expected Warp to render on the GPU, got none; pip install warp-lang"):
        check_device("cuda")


@pytest.fixture
def elsewhere(monkeypatch):
    """Studios whose pictures lie on another device, without numbers."""

    def photograph(self, weights, buffers=None):
        place = self.portrait.rig.neutral.device
        vertices = self.portrait.rig.vertices(weights.to(self.device))
        channels = sum(1 if name == "mask" else 3 for name in buffers or self.buffers)
        return vertices.mean((1, 2)).view(-1, 1, 1, 1).expand(-1, channels, self.resolution, self.resolution).to(place)

    original = Studio.photograph
    monkeypatch.setattr(
        Studio, "photograph", lambda self, *others: (photograph if self.device == "meta" else original)(self, *others)
    )


def _far(portrait):
    """The portrait on the other device; a rig looks at its numbers when it is made."""
    rig = object.__new__(Rig)
    for name, value in vars(portrait.rig).items():
        object.__setattr__(rig, name, value.to("meta") if isinstance(value, torch.Tensor) else value)
    return replace(portrait, rig=rig, position=portrait.position.to("meta"))


@pytest.mark.parametrize("network", ["components", "convolutional"])
@pytest.mark.parametrize("together", [True, False])
def test_what_a_training_computes_stays_on_its_device(network, together, elsewhere, toy_run, toy_config):
    config = replace(
        toy_config,
        reenactnet=replace(toy_config.reenactnet, network=network),
        bpnet=replace(toy_config.bpnet, image_from=0.0),
        training=replace(toy_config.training, together=together, elastic=0.02, cycle_loss=0.5),
    )
    run = replace(toy_run, config=config)
    here = {key: run.studio(key) for key in run.keys}
    partners = {key: run.partners(key) for key in run.keys}
    teachers = {
        pair: run.teacher(here[pair[0]], here[pair[1]], *pair)
        for pair in (run.keys, run.keys[::-1])
        for pair in [tuple(pair)]
    }
    studios = {}
    for key, studio in here.items():  # their constructor looks at numbers
        studios[key] = object.__new__(Studio)
        vars(studios[key]).update(vars(studio))
        studios[key].device, studios[key].portrait = "meta", _far(studio.portrait)
        studios[key].neutral, studios[key].contrast = studio.neutral.to("meta"), studio.contrast.to("meta")
    distances = {key: VertexDistance(studio.rig, studio.typical, "meta") for key, studio in studios.items()}
    networks = run.networks().to("meta")
    shop = stages.Workshop(config, studios, networks, run.keys, partners, teachers, distances, Team())
    for index, stage in enumerate(stages.find_stages(shop)):
        pools = stage.render([0, index, 0])
        assert {pool.described.device.type for pool in pools.values()} == {"meta"}
        losses = stage.losses(pools, stage.draw(pools, torch.Generator().manual_seed(0)), 1.0)
        assert all(value.device.type == "meta" for value in losses.values())
        torch.stack(list(losses.values())).sum().backward()


@pytest.fixture
def brought(monkeypatch):
    """What comes to the CPU from the device without numbers becomes zeros, where PyTorch would refuse."""
    bring = torch.Tensor.cpu
    monkeypatch.setattr(
        torch.Tensor,
        "cpu",
        lambda self: torch.zeros(self.shape, dtype=self.dtype) if self.device.type == "meta" else bring(self),
    )


def test_pictures_are_taken_to_the_networks_and_brought_back(elsewhere, brought, toy_run):
    moving = ImageRetargeter.load(toy_run.folder)
    for studio in (moving.source_studio, moving.target_studio):
        studio.device, studio.portrait = "meta", _far(studio.portrait)
        studio.neutral, studio.contrast = studio.neutral.to("meta"), studio.contrast.to("meta")
    moving.networks.to("meta")
    pictures = torch.rand(2, 6, 32, 32)
    for look in (moving.reenact, moving.read, moving.read_direct):
        assert look(pictures).device.type == "cpu"
    for look in (moving.source_pictures, moving.target_pictures, moving.source_masks, moving.target_masks):
        assert look(torch.rand(2, len(moving.source.names))).device.type == "cpu"


@pytest.mark.parametrize("command", ["evaluate RUN", "view RUN", "render RUN --out x.mp4", "batch MANIFEST"])
@LACKING
def test_every_command_that_runs_networks_takes_a_device(command, toy_run, tmp_path, capsys):
    (tmp_path / "m.csv").write_text(f"run,clip,out\n{toy_run.folder},synthetic:1:1,{tmp_path / 'x.csv'}\n")
    places = {"RUN": f"{toy_run.folder}", "MANIFEST": f"{tmp_path / 'm.csv'}", "x.mp4": f"{tmp_path / 'x.mp4'}"}
    assert main([*(places.get(word, word) for word in command.split()), "--device", "cuda"]) == 2
    assert "expected an NVIDIA GPU" in capsys.readouterr().err
