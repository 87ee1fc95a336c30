"""Studio: expressions of one rig, rendered to the pictures that the networks see."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from kornia.filters import gaussian_blur2d
from torch import Tensor

from reenact.config import ImageConfig
from reenact.errors import ReenactError
from reenact.losses import VertexDistance, motion_weight
from reenact.portrait import Portrait, made_up
from reenact.rigs import motion
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig

_SURVEY = 256
"""Random expressions from which a studio learns how the rig typically moves."""


class Studio:
    """Photographs one rig, in the shared layout, as residuals against its neutral."""

    def __init__(
        self,
        rig: Rig,
        config: ImageConfig,
        layout: Float[Tensor, "R R 2"] | None = None,
        clip: Clip | None = None,
        fixed_frames: int | None = None,
        seed: int = 0,
    ):
        """
        Args:
            rig: Photographed by `Portrait.of`.
            config: Resolution of the pictures, their paint, and whether networks see differences from the neutral.
            layout: Sampling grid in [-1, 1] (x, y) of any resolution that warps each picture onto the shared layout;
                None leaves it.
            clip: Training motion with the rig's names; None samples random valid expressions without end.
            fixed_frames: Draw only this many expressions, once.
            seed: Of the survey and of the fixed expressions.

        Raises:
            ReenactError: The rig has no eyes above a mouth, or its pictures do not change.
        """
        self.seed = seed
        self.rig, self.resolution, self.residual = rig, config.resolution, config.residual
        self.rendered_at = config.supersample * config.resolution
        self.layout = None if layout is None else resize_grid(layout, self.rendered_at)
        self.portrait = Portrait.of(made_up(rig) if config.makeup else rig)
        self.pool = None if clip is None else clip.weights
        if fixed_frames is not None:
            self.pool = self.draw(fixed_frames, np.random.default_rng([seed, 1]))
        self.neutral = self.photograph(torch.zeros(1, len(rig.names)))[0]  # (3, R, R)
        survey = self.draw(_SURVEY, np.random.default_rng([seed, 2]))
        self.mean_weights = survey.mean(0)
        residuals = self.photograph(survey) - self.neutral
        self.contrast = residuals.square().mean().sqrt()
        if not self.contrast > 0:
            raise ReenactError(
                f"{rig.name}: expected expressions that change its picture, got {_SURVEY} equal ones; check that the "
                "export kept the deltas, and that the training clip moves"
            )
        self.motion = motion_weight(residuals)
        self.energy = _energy(residuals)
        self.vertex_distance = VertexDistance(rig, survey)

    def draw(self, count: int, random: np.random.Generator) -> Float[Tensor, "N K"]:
        """Weights of training expressions: from the clip or the fixed set if there is one, else fresh."""
        if self.pool is None:
            return motion.expressions(self.rig.names, count, random)
        return self.pool[random.integers(len(self.pool), size=count)]

    @torch.no_grad()
    def survey(self, count: int) -> Float[Tensor, "N 3 R R"]:
        """Pictures of that many training expressions, always the same ones; no gradient."""
        weights = self.draw(count, np.random.default_rng([self.seed, 3]))
        return torch.cat([self.photograph(chunk) for chunk in weights.split(64)])

    def photograph(
        self, weights: Float[Tensor, "N K"], buffers: tuple[str, ...] = ("color",)
    ) -> Float[Tensor, "N C R R"]:
        """Pictures in the shared layout, the named buffers stacked along channels; "color" is in [0, 1].

        Differentiable to the weights.
        """
        rendered = self.portrait.render(self.rig.vertices(weights), self.rendered_at, buffers)
        picture = torch.cat([rendered[name] for name in buffers], dim=1)
        if self.layout is not None:
            picture = warp(picture, self.layout)
        return F.adaptive_avg_pool2d(picture, self.resolution)

    def show(self, pictures: Float[Tensor, "N 3 R R"]) -> Float[Tensor, "N 3 R R"]:
        """What a network sees of pictures: residuals of unit size on average, or the pictures themselves.

        Residuals are a few hundredths; unscaled, the first normalisation would drown them in its biases.
        """
        return (pictures - self.neutral) / self.contrast if self.residual else pictures

    def level(self, shown: Float[Tensor, "N 3 R R"]) -> Float[Tensor, "N 3 R R"]:
        """What the encoder sees of what the networks are shown: each place and channel divided by how much it varies.

        Dark lips on pale skin and red lips on dark skin move alike and look unlike; after this, less so. Ours.
        """
        return shown / self.energy if self.residual else shown

    def picture(self, shown: Float[Tensor, "N 3 R R"]) -> Float[Tensor, "N 3 R R"]:
        """The pictures in [0, 1] behind what a network drew: the inverse of `show`, clamped."""
        return (shown * self.contrast + self.neutral if self.residual else shown).clamp(0, 1)


def _energy(residuals: Float[Tensor, "N 3 R R"]) -> Float[Tensor, "3 R R"]:
    """Smoothed root mean square residual of each pixel and channel, over the channel's mean; at least 0.15."""
    resolution = residuals.shape[-1]
    sigma, size = resolution / 32, 2 * (resolution // 16) + 1
    smooth = gaussian_blur2d(residuals.square().mean(0, keepdim=True), (size, size), (sigma, sigma))[0].sqrt()
    return (smooth / smooth.mean(dim=(1, 2), keepdim=True).clamp_min(1e-9)).clamp_min(0.15)


def warp(pictures: Float[Tensor, "N C H W"], grid: Float[Tensor, "H W 2"]) -> Float[Tensor, "N C H W"]:
    """Pictures resampled at the grid's positions, (x, y) in [-1, 1] with -1 the outer edge of the first pixel."""
    return F.grid_sample(
        pictures, grid.expand(len(pictures), -1, -1, -1), mode="bilinear", padding_mode="border", align_corners=False
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
    coarse = elastic * torch.randn(count, 2, 4, 4, generator=random)
    fine = F.interpolate(coarse, size=(resolution, resolution), mode="bicubic", align_corners=True)
    grid = identity_grid(resolution) + fine.permute(0, 2, 3, 1)
    return F.grid_sample(pictures, grid, mode="bilinear", padding_mode="border", align_corners=False)
