"""Rigs, runs and a browser that several test files share."""

import shutil

import numpy as np
import pytest
import torch
import trimesh

from reenact.config import BPNetConfig, Config, ImageConfig, LayoutConfig, ReenactNetConfig, TrainingConfig
from reenact.rigs.rig import Rig

_BUMPS = {  # shape: where on the unit sphere it pushes, which way
    "eyeBlinkLeft": ((0.35, 0.35, 0.85), (0.0, -0.10, 0.02)),
    "eyeBlinkRight": ((-0.35, 0.35, 0.85), (0.0, -0.10, 0.02)),
    "browInnerUp": ((0.0, 0.6, 0.75), (0.0, 0.15, 0.05)),
    "jawOpen": ((0.0, -0.6, 0.75), (0.0, -0.25, 0.0)),
    "mouthPucker": ((0.0, -0.35, 0.9), (0.0, 0.0, 0.2)),
    "mouthSmileLeft": ((0.3, -0.3, 0.85), (0.12, 0.12, 0.0)),
    "mouthSmileRight": ((-0.3, -0.3, 0.85), (-0.12, 0.12, 0.0)),
}


def make_toy_rig(name: str, stretch: float = 1.0, hue: float = 0.0) -> Rig:
    """A ball of 10 cm with seven bumps for shapes; `stretch` makes it taller, `hue` recolours it."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    points = np.asarray(ball.vertices)
    deltas = [
        np.exp(-np.square(points - place).sum(1, keepdims=True) / 0.05) * direction
        for place, direction in _BUMPS.values()
    ]
    size = np.array([0.1, 0.1 * stretch, 0.1])
    colors = 0.5 + 0.4 * np.sin(5 * points + hue + np.array([0.0, 2.0, 4.0]))
    return Rig(
        name,
        torch.tensor(points * size, dtype=torch.float32),
        torch.tensor(np.stack(deltas) * size, dtype=torch.float32),
        tuple(_BUMPS),
        torch.tensor(np.asarray(ball.faces), dtype=torch.int64),
        colors=torch.tensor(colors, dtype=torch.float32),
    )


@pytest.fixture(scope="session")
def toy_rig() -> Rig:
    return make_toy_rig("ball")


@pytest.fixture(scope="session")
def toy_pair() -> tuple[Rig, Rig]:
    return make_toy_rig("ball"), make_toy_rig("egg", stretch=1.25, hue=2.0)


@pytest.fixture(scope="session")
def toy_config(toy_pair, tmp_path_factory) -> Config:
    """Settings that train both toys in a few seconds; the rigs lie in files."""
    from reenact.rigs.files import save_rig

    folder = tmp_path_factory.mktemp("rigs")
    for rig in toy_pair:
        save_rig(rig, folder / f"{rig.name}.npz")
    return Config(
        source=str(folder / "ball.npz"),
        target=str(folder / "egg.npz"),
        images=ImageConfig(resolution=32),
        layout=LayoutConfig(steps=10, samples=16),
        reenactnet=ReenactNetConfig(
            code=16, components=16, color_components=8, width=32, encoder_channels=8, seed_channels=8
        ),
        bpnet=BPNetConfig(channels=8, hidden=32, steps=12, batch_size=4),
        training=TrainingConfig(steps=12, batch_size=4, save_every=5, threads=1, frames=16, refresh=7),
    )


def make_random_rig(seed: int) -> Rig:
    """A bumpy 5 x 5 grid of 32 triangles: a dense, a sparse and a still shape; seeds differ in what else it has."""
    rng = np.random.default_rng(seed)
    across, up = np.meshgrid(np.linspace(-0.1, 0.1, 5), np.linspace(-0.1, 0.1, 5))
    neutral = np.stack([across.ravel(), up.ravel(), np.zeros(25)], axis=1) + rng.normal(0, 0.01, (25, 3))
    corner = (np.arange(4)[:, None] * 5 + np.arange(4)).reshape(-1)
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + 6], 1), np.stack([corner, corner + 6, corner + 5], 1)]
    )
    deltas = rng.normal(0, 0.02, (3, 25, 3))
    deltas[1, 4:] = 0
    deltas[2] = 0
    fields = {}
    if seed % 2:
        fields["colors"] = torch.tensor(rng.random((25, 3)), dtype=torch.float32)
    if seed % 3:
        fields["parts"] = torch.tensor(rng.integers(0, 8, 25))
    if seed % 5:
        fields["uv"] = torch.tensor(rng.random((40, 2)), dtype=torch.float32)
        fields["uv_faces"] = torch.tensor(rng.integers(0, 40, (32, 3)))
        if seed % 4:
            fields["texture"] = torch.tensor(rng.integers(0, 256, (6, 8, 3)) / 255, dtype=torch.float32)
    tensors = [torch.tensor(array, dtype=torch.float32) for array in (neutral, deltas)]
    names = ("jawOpen", "eyeBlink_L", "ünïcode shape")
    return Rig(f"grid {seed}", tensors[0], tensors[1], names, torch.tensor(faces), **fields)


@pytest.fixture(scope="session")
def toy_run(toy_config, tmp_path_factory):
    """An opened run of the toys whose networks were saved after a glance at their pictures, without training."""
    from dataclasses import replace

    from reenact.checkpoint import save_checkpoint
    from reenact.run import Run

    run = Run.create(replace(toy_config, run=str(tmp_path_factory.mktemp("runs") / "toy")))
    networks = run.networks()
    studios = {key: run.studio(key) for key in run.keys}
    networks.fit(list(studios), lambda key: studios[key].show(studios[key].survey(20)))
    tensors = {f"networks.{name}": tensor for name, tensor in networks.state_dict().items()}
    save_checkpoint(run.folder, 1, tensors, {})
    return run


@pytest.fixture
def older_run(toy_run, tmp_path):
    """The folder of a run of the toys with three checkpoints, of which the second is the best: steps 10, 20 and 30."""
    from reenact.checkpoint import save_checkpoint

    folder = tmp_path / "older"
    shutil.copytree(toy_run.folder, folder)
    shutil.rmtree(folder / "checkpoints")
    for step, error in ((10, 0.5), (20, 0.25), (30, 0.4)):
        networks = toy_run.trained_networks()
        for bpnet in networks.bpnets.values():
            list(bpnet.parameters())[-1].data.fill_(step / 40)  # what the last layer adds to everything
        tensors = {f"networks.{name}": tensor for name, tensor in networks.state_dict().items()}
        save_checkpoint(folder, step, tensors, {}, error=error)
    return folder


@pytest.fixture(scope="module")
def chromium():
    """A browser without a window, whose 3D is drawn by software."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="needs playwright, of the extra dev")
    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if path is None:
        pytest.skip("needs chromium or google-chrome")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=path, args=["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
        )
        yield browser
        browser.close()


CLOUD_NAMES = (
    "jawOpen",
    "eyeBlinkLeft",
    "eyeBlinkRight",
    "mouthSmileLeft",
    "mouthSmileRight",
    "browInnerUp",
    "cheekPuff",
)


def make_cloud_rig(name: str, names: tuple[str, ...] = CLOUD_NAMES, seed: int = 0) -> Rig:
    """Forty vertices in a box, which every shape moves at random."""
    generator = torch.Generator().manual_seed(seed)
    vertices = torch.rand(40, 3, generator=generator)
    deltas = 0.1 * torch.randn(len(names), 40, 3, generator=generator)
    return Rig(name, vertices, deltas, names, torch.randint(0, 40, (60, 3), generator=generator))
