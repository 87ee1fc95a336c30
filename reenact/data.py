"""Studio: expressions of one rig, rendered to the pictures that the networks see."""

from __future__ import annotations

import importlib.util
from functools import cached_property

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from reenact.config import ImageConfig
from reenact.errors import ReenactError
from reenact.portrait import BACKGROUND, Portrait, made_up
from reenact.rigs import motion
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig

_SURVEY = 256
"""Random expressions from which a studio learns how the rig typically moves."""
_PIXELS = 16 * 128 * 128
"""Pixels that are rendered at once where no gradient is wanted: bounds memory, not results."""


def check_device(device: str) -> None:
    """Refuse a device that is not there.

    Raises:
        ReenactError: No NVIDIA GPU that this PyTorch can use, or no Warp, which renders on it.
    """
    if device == "cpu":
        return
    if not torch.cuda.is_available():
        built = "no such GPU" if torch.version.cuda else "a PyTorch that was built without CUDA"
        raise ReenactError(f'device: expected an NVIDIA GPU for "cuda", got {built}; `reenact doctor` says more')
    if importlib.util.find_spec("warp") is None:
        raise ReenactError("device: expected Warp to render on the GPU, got none; pip install warp-lang")


class Studio:
    """Photographs one rig, in the shared layout, as residuals against its neutral.

    A picture has the channels of `buffers`: colours, sRGB in [0, 1], and behind them the motion pass if there is one.
    """

    def __init__(
        self,
        rig: Rig,
        config: ImageConfig,
        layout: Float[Tensor, "R R 2"] | None = None,
        clip: Clip | None = None,
        seed: int = 0,
        crowded: float = 0.0,
        uneven: float = 0.0,
        device: str = "cpu",
    ):
        """
        Args:
            rig: Photographed by `Portrait.of`.
            config: Resolution of the pictures, their paint and passes, and whether networks see differences from the
                neutral.
            layout: Sampling grid in [-1, 1] (x, y) of any resolution that warps each picture onto the shared layout;
                None leaves it.
            clip: Training motion with the rig's names; None samples random valid expressions without end.
            seed: Of the survey.
            crowded: Share of random expressions that move any number of shapes; see `motion.expressions`.
            uneven: Share of those whose shapes differ in strength.
            device: Where pictures are made and stay. Weights come from anywhere, and are drawn on the CPU.

        Raises:
            ReenactError: The rig has no eyes above a mouth, or its pictures do not change.
        """
        self.seed, self.crowded, self.uneven = seed, crowded, uneven
        self.rig, self.resolution, self.residual = rig, config.resolution, config.residual
        self.buffers = ("color", "motion") if config.motion else ("color",)
        self.rendered_at = config.supersample * config.resolution
        self.layout = None if layout is None else resize_grid(layout, self.rendered_at).to(device)
        portrait = Portrait.of(made_up(rig) if config.makeup else rig)
        self.device, self.portrait = device, portrait.to(device)
        self.pool = None if clip is None else clip.weights
        self.neutral = self.photograph(torch.zeros(1, len(rig.names)))[0]  # (C, R, R)
        self.typical = self.draw(_SURVEY, np.random.default_rng([seed, 2]))
        """Weights (N, K) of expressions that show how the rig moves."""
        residuals = (self.photograph(self.typical) - self.neutral).unflatten(1, (len(self.buffers), 3))
        contrast = residuals.square().mean((0, 2, 3, 4)).sqrt()  # of each buffer
        if not bool((contrast > 0).all()):
            raise ReenactError(
                f"{rig.name}: expected expressions that change its picture, got {_SURVEY} equal ones; check that the "
                "export kept the deltas, and that the training clip moves"
            )
        self.contrast = contrast.repeat_interleave(3)[:, None, None]  # (C, 1, 1)

    def draw(self, count: int, random: np.random.Generator) -> Float[Tensor, "N K"]:
        """Weights of training expressions: from the clip if there is one, else fresh."""
        if self.pool is None:
            return self.expressions(count, random)
        return self.pool[random.integers(len(self.pool), size=count)]

    def expressions(self, count: int, random: np.random.Generator) -> Float[Tensor, "N K"]:
        """Weights of random expressions, as many of them crowded as the settings say."""
        return motion.expressions(self.rig.names, count, random, self.crowded, self.uneven)

    def surveyed(self, count: int) -> Float[Tensor, "N K"]:
        """That many training expressions, always the same ones."""
        return self.draw(count, np.random.default_rng([self.seed, 3]))

    @torch.no_grad()
    def survey(self, count: int) -> Float[Tensor, "N C R R"]:
        """Pictures of what is `surveyed`; no gradient."""
        return self.photograph(self.surveyed(count))

    def photograph(
        self, weights: Float[Tensor, "N K"], buffers: tuple[str, ...] | None = None
    ) -> Float[Tensor, "N C R R"]:
        """Pictures in the shared layout: the studio's buffers, or those named, stacked along channels.

        Differentiable to the weights. Motion is in metres.
        """
        buffers = buffers or self.buffers
        if weights.requires_grad and torch.is_grad_enabled():
            return self._photograph(weights, buffers)
        chunks = weights.split(max(1, _PIXELS // self.rendered_at**2))
        return torch.cat([self._photograph(chunk, buffers) for chunk in chunks])

    def _photograph(self, weights: Float[Tensor, "N K"], buffers: tuple[str, ...]) -> Float[Tensor, "N C R R"]:
        """All at once."""
        vertices = self.portrait.rig.vertices(weights.to(self.device))
        rendered = self.portrait.render(vertices, self.rendered_at, buffers)
        picture = torch.cat([rendered[name] for name in buffers], dim=1)
        if self.layout is not None:  # beyond the picture lies background, which only colours have
            beyond = torch.cat([_beyond(name, rendered[name].shape[1]) for name in buffers])[:, None, None].to(picture)
            picture = warp(picture - beyond, self.layout, "zeros") + beyond
        return _shrunk(picture, self.rendered_at // self.resolution)

    def glance(self, weights: Float[Tensor, "N K"]) -> Float[Tensor, "N 3 R R"]:
        """What networks are shown of the buffer that they read from, without the cost of the others."""
        return self.show(self.photograph(weights, self.buffers[-1:]))

    @cached_property
    @torch.no_grad()
    def looks(self) -> Float[Tensor, "K P"]:
        """What networks are shown of each shape at 1, as rows."""
        return self.glance(torch.eye(len(self.rig.names))).flatten(1)

    def show(self, pictures: Float[Tensor, "N C R R"]) -> Float[Tensor, "N C R R"]:
        """What a network sees of pictures: residuals of unit size on average, or the pictures themselves.

        Residuals are a few hundredths; unscaled, the first normalisation would drown them in its biases. Pictures may
        lack their first buffers.
        """
        if not self.residual:
            return pictures
        channels = pictures.shape[1]
        return (pictures - self.neutral[-channels:]) / self.contrast[-channels:]

    def picture(self, shown: Float[Tensor, "N C R R"]) -> Float[Tensor, "N C R R"]:
        """The pictures behind what a network drew: the inverse of `show`, with colours clamped to [0, 1]."""
        pictures = shown * self.contrast + self.neutral if self.residual else shown
        return torch.cat([pictures[:, :3].clamp(0, 1), pictures[:, 3:]], dim=1)


def _shrunk(pictures: Float[Tensor, "N C H W"], factor: int) -> Float[Tensor, "N C h w"]:
    """Means of squares of so many pixels a side.

    As sums that are too small to be shared among threads where there is one picture. PyTorch's pooling wakes its
    threads for it, which fight with the renderer's for the cores: a frame then takes 30 ms instead of 10.
    """
    rows = sum(pictures[:, :, start::factor] for start in range(factor))
    return sum(rows[..., start::factor] for start in range(factor)) / factor**2


def _beyond(buffer: str, channels: int) -> Float[Tensor, "C"]:
    return torch.tensor(BACKGROUND) if buffer == "color" else torch.zeros(channels)


def warp(
    pictures: Float[Tensor, "N C H W"], grid: Float[Tensor, "H W 2"], beyond: str = "border"
) -> Float[Tensor, "N C H W"]:
    """Pictures resampled at the grid's positions, (x, y) in [-1, 1] with -1 the outer edge of the first pixel.

    `beyond` the picture lies its "border" for ever, or "zeros".
    """
    return F.grid_sample(
        pictures, grid.expand(len(pictures), -1, -1, -1), mode="bilinear", padding_mode=beyond, align_corners=False
    )


def resize_grid(grid: Float[Tensor, "H W 2"], resolution: int) -> Float[Tensor, "R R 2"]:
    """A sampling grid at another resolution; positions are relative, so its smooth displacement is interpolated."""
    if len(grid) == resolution:
        return grid
    displacement = (grid - identity_grid(len(grid))).permute(2, 0, 1)[None]
    fine = F.interpolate(displacement, size=(resolution, resolution), mode="bicubic", align_corners=False)
    return identity_grid(resolution) + fine[0].permute(1, 2, 0)


def identity_grid(resolution: int) -> Float[Tensor, "R R 2"]:
    """The grid that changes nothing: centres of the pixels."""
    centres = (torch.arange(resolution, dtype=torch.float32) + 0.5) * (2 / resolution) - 1
    y, x = torch.meshgrid(centres, centres, indexing="ij")
    return torch.stack([x, y], dim=-1)


def jitter(pictures: Float[Tensor, "N C R R"], elastic: float, random: torch.Generator) -> Float[Tensor, "N C R R"]:
    """Each picture bent by its own smooth random displacement, so that the encoder cannot rely on exact places.

    Args:
        pictures: Left as they are; the bent ones are new.
        elastic: Standard deviation of a 4 x 4 grid of displacements, in halves of the picture's width.
        random: Advanced.
    """
    count, resolution = len(pictures), pictures.shape[-1]
    coarse = elastic * torch.randn(count, 2, 4, 4, generator=random).to(pictures)
    fine = F.interpolate(coarse, size=(resolution, resolution), mode="bicubic", align_corners=True)
    grid = identity_grid(resolution).to(pictures) + fine.permute(0, 2, 3, 1)
    return F.grid_sample(pictures, grid, mode="bilinear", padding_mode="border", align_corners=False)
