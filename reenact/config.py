"""Every setting of a training run, with its default."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class ImageConfig:
    """The pictures that the networks see."""

    resolution: int = 64
    """Height and width in pixels; a multiple of 16."""
    residual: bool = True
    """Show each network the picture minus the rig's own neutral picture, so that identity, texture and light cancel."""


@dataclass(frozen=True)
class LayoutConfig:
    """One 2-D warp per rig that puts its eyes, mouth and outline on the pixels of the source's."""

    method: Literal["found", "none"] = "found"
    """`found` registers neutral pictures, part maps and motion energy; `none` leaves the pictures as framed."""
    grid: int = 9
    """Control points along each side of the displacement grid."""
    steps: int = 120
    """Optimizer steps at each of the scales, coarse to fine."""
    bending: float = 0.02
    """Penalty on the second differences of the displacement grid."""
    samples: int = 256
    """Random expressions per rig from which motion energy is measured."""


@dataclass(frozen=True)
class ReenactNetConfig:
    """Shape of ReenactNet: one shared encoder, one decoder per rig."""

    encoder_channels: int = 24
    """Channels after the first convolution; doubled at each of the next three."""
    code: int = 128
    """Size of the bottleneck. Far larger ones let identity leak into the code."""
    seed_channels: int = 96
    """Channels of the small picture that the code is unfolded to."""
    decoder_channels: int = 16
    """Channels of the decoder's last block; doubled at each earlier one."""
    kernel: int = 3
    """Width of the encoder's convolutions."""
    normalize: bool = True
    """GroupNorm and SiLU; without it plain leaky ReLU, as the published description suggests."""


@dataclass(frozen=True)
class BPNetConfig:
    """Shape and training of BPNet, which reads blendshape weights from a picture."""

    channels: int = 24
    """Channels after the first convolution."""
    hidden: int = 256
    """Width of the hidden dense layer."""
    epochs: float | None = None
    """Passes over a fixed set of `training.fixed_frames` pictures; None counts in `steps`."""
    steps: int = 3000
    """Optimizer steps per rig."""
    batch_size: int = 16
    """Pictures per step."""
    learning_rate: float = 1e-3
    """Peak of the schedule."""
    weight_loss: float = 1.0
    """Factor of L_w, the mean absolute error of the weights."""
    image_loss: float = 1.0
    """Factor of L_r, the mean absolute difference between the picture and the render of the predicted weights."""
    vertex_loss: float = 1.0
    """Factor of the root mean square vertex error of the predicted weights, relative to the motion (ours)."""
    decoded_fraction: float = 0.3
    """Share of the pictures that are first passed through ReenactNet, as they will be at inference."""


@dataclass(frozen=True)
class TrainingConfig:
    """Optimization of ReenactNet, and what both networks share."""

    steps: int = 3000
    """Optimizer steps of ReenactNet."""
    epochs: float | None = None
    """Passes over a fixed set of `fixed_frames` pictures; None counts in `steps`."""
    batch_size: int = 16
    """Pictures of each rig per step."""
    learning_rate: float = 1e-3
    """Peak of the schedule."""
    schedule: Literal["one-cycle", "constant"] = "one-cycle"
    """How the learning rate changes over the steps."""
    optimizer: Literal["adamw", "adam"] = "adamw"
    """AdamW with weight decay, or plain Adam."""
    weight_decay: float = 0.01
    """Decoupled weight decay of AdamW."""
    elastic: float = 0.05
    """Elastic jitter of the encoder's input: standard deviation of a 4 x 4 grid, in halves of the picture's width."""
    motion_weighting: bool = True
    """Weight the reconstruction by where each rig's pictures move."""
    fixed_frames: int | None = None
    """Train on this many pictures per rig, drawn once; None renders fresh expressions at every step."""
    seed: int = 0
    """Seed of every random number in the run."""
    save_every: int = 500
    """Steps between checkpoints; each writes a preview picture."""
    keep: int = 3
    """Newest checkpoints that are kept."""
    threads: int | None = None
    """CPU threads; None takes all cores."""


@dataclass(frozen=True)
class Config:
    """Train networks that move expressions between two rigs."""

    source: str = "anny:man"
    """Rig that the motion comes from: a built-in name (see `reenact rigs`) or a file."""
    target: str = "anny:toon"
    """Rig that the motion goes to."""
    source_clip: str | None = None
    """Training motion of the source: a file or `synthetic:SEED[:SECONDS]`; None samples random valid expressions."""
    target_clip: str | None = None
    """Training motion of the target, never the same as the source's."""
    run: str | None = None
    """Folder to create for the run; None makes a new one below `runs/`."""
    images: ImageConfig = field(default_factory=ImageConfig)
    layout: LayoutConfig = field(default_factory=LayoutConfig)
    reenactnet: ReenactNetConfig = field(default_factory=ReenactNetConfig)
    bpnet: BPNetConfig = field(default_factory=BPNetConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
