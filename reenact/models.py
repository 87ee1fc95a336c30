"""ReenactNet draws an expression on another face; BPNet reads blendshape weights from a picture.

Kim, Jung, Yun, Seo, Noh 2021, "Deep Learning-Based Unsupervised Human Facial Retargeting", CGF 40(7),
doi:10.1111/cgf.14400 (KI21).

Paper   Code                        Shape
E       ReenactNet.encode           (B, C, R, R) -> (B, D) or (B, A, R / 8, R / 8)
D_s,t   ReenactNet.decoders[key]    (B, D) or (B, A, R / 8, R / 8) -> (B, C, R, R)
BPNet   BPNet                       (B, C, R, R) -> (B, K)

The paper names the family (shared encoder, one decoder per face, from the "deepfake" line) and leaves layers and sizes
to a supplement that is not public; every layer below is our choice within that family. There are no skip connections
from encoder to decoder: they would carry the source's identity past the code.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from reenact.config import BPNetConfig, Config, ReenactNetConfig


class ReenactNet(nn.Module):
    """One shared encoder, one decoder per rig.

    Pictures are residuals against the neutral, of unit size on average, or colours in [0, 1] where `residual` is False.
    """

    def __init__(self, keys: list[str], resolution: int, config: ReenactNetConfig, residual: bool = True):
        super().__init__()
        channels, seed = config.encoder_channels, config.seed_channels
        layer = _Layer(config.normalize)
        small = resolution // 16
        self.trunk = nn.Sequential(
            layer.down(3, channels, config.kernel),
            layer.down(channels, 2 * channels, config.kernel),
            layer.down(2 * channels, 4 * channels, config.kernel),
            layer.down(4 * channels, 8 * channels, config.kernel),
            nn.Flatten(),
            nn.Linear(8 * channels * small * small, config.code),
        )
        if config.decoder == "basis":
            width = config.decoder_width
            self.unfold = nn.Sequential(nn.Linear(config.code, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU())
            self.decoders = nn.ModuleDict({key: BasisDecoder(resolution, config) for key in keys})
        else:
            self.unfold = nn.Sequential(
                nn.Linear(config.code, seed * small * small),
                nn.Unflatten(1, (seed, small, small)),
                layer.up(seed, seed),
            )
            self.decoders = nn.ModuleDict({key: _decoder(seed, config, layer, residual) for key in keys})

    def encode(self, pictures: Float[Tensor, "B C R R"]) -> Float[Tensor, "B *shape"]:
        """The expression as every decoder understands it: E. Features (B, D), or a small picture."""
        return self.unfold(self.trunk(pictures))

    def code(self, pictures: Float[Tensor, "B C R R"]) -> Float[Tensor, "B D"]:
        """The bottleneck, where equal expressions of two rigs should meet."""
        return self.trunk(pictures)

    def forward(self, pictures: Float[Tensor, "B C R R"], key: str) -> Float[Tensor, "B C R R"]:
        """The expression of the pictures, drawn on the rig `key`. Source: KI21, ReenactNet(I) = D_t(E(I))."""
        return self.decoders[key](self.encode(pictures))


class BasisDecoder(nn.Module):
    """A decoder that mixes the principal components of its rig's own pictures. Ours.

    Where a convolutional decoder learns to draw from nothing, this one is told what the rig's pictures can look like: a
    few hundred components hold 99 % of their variance, one dense layer finds the mixture, and a step costs a quarter.
    All that is nonlinear stays in the part that the rigs share, which keeps their codes together. Until `fit` it draws
    the zero picture.
    """

    def __init__(self, resolution: int, config: ReenactNetConfig):
        super().__init__()
        count = config.components
        self.resolution = resolution
        self.mix = nn.Linear(config.decoder_width, count)
        self.register_buffer("mean", torch.zeros(3 * resolution * resolution))
        self.register_buffer("components", torch.zeros(count, 3 * resolution * resolution))

    def forward(self, features: Float[Tensor, "B D"]) -> Float[Tensor, "B 3 R R"]:
        """Pictures; each component is scaled by how much it varies, so that mixtures are of unit size."""
        flat = torch.addmm(self.mean, self.mix(features), self.components)
        return flat.unflatten(1, (3, self.resolution, self.resolution))

    @torch.no_grad()
    def fit(self, pictures: Float[Tensor, "N 3 R R"]) -> float:
        """The share of variance that the components hold, which are taken from these pictures of the rig.

        With fewer pictures than components the rest stay zero.
        """
        flat = pictures.flatten(1)
        self.mean.copy_(flat.mean(0))
        centred = flat - self.mean
        values, vectors = torch.linalg.eigh((centred @ centred.T).double())  # of the small side, ascending
        count = min(len(self.components), len(flat) - 1)
        values, vectors = values.flip(0).clamp_min(0), vectors.flip(1)
        # Rows of U^T X are components times singular values; over sqrt(N) they are components times deviations.
        self.components[:count] = (vectors[:, :count].T.float() @ centred) / len(flat) ** 0.5
        return float(values[:count].sum() / values.sum().clamp_min(1e-12))


class BPNet(nn.Module):
    """Blendshape weights of one rig from its picture. Linear output: clamp to [0, 1] at inference, not in training."""

    def __init__(self, shape_count: int, resolution: int, config: BPNetConfig):
        super().__init__()
        sizes = [3, *(config.channels * factor for factor in (1, 2, 4, 8))]
        blocks = []
        for size_in, size_out in pairwise(sizes):
            blocks += [nn.Conv2d(size_in, size_out, 3, 2, 1), nn.GroupNorm(8, size_out), nn.SiLU()]
        small = resolution // 16
        self.features = nn.Sequential(*blocks, nn.Flatten())
        self.head = nn.Sequential(
            nn.Linear(sizes[-1] * small * small, config.hidden), nn.SiLU(), nn.Linear(config.hidden, shape_count)
        )

    def forward(self, pictures: Float[Tensor, "B C R R"]) -> Float[Tensor, "B K"]:
        """Weights, unbounded. GroupNorm, since batches are small and decoded pictures differ from rendered ones."""
        return self.head(self.features(pictures))


class _Layer:
    """The three kinds of block, normalised or plain."""

    def __init__(self, normalize: bool):
        self.normalize = normalize

    def _finish(self, channels: int, slope: float = 0.1) -> list[nn.Module]:
        return [nn.GroupNorm(8, channels), nn.SiLU()] if self.normalize else [nn.LeakyReLU(slope)]

    def down(self, size_in: int, size_out: int, kernel: int) -> nn.Module:
        return nn.Sequential(nn.Conv2d(size_in, size_out, kernel, 2, kernel // 2), *self._finish(size_out))

    def up(self, size_in: int, size_out: int) -> nn.Module:
        """Pixel shuffle: no checkerboards, and cheaper than a transposed convolution."""
        return nn.Sequential(nn.Conv2d(size_in, 4 * size_out, 3, 1, 1), *self._finish(4 * size_out), nn.PixelShuffle(2))

    def residual(self, channels: int) -> nn.Module:
        return _Residual(channels, self._finish(channels, 0.2), self._finish(channels, 0.2))


class _Residual(nn.Module):
    def __init__(self, channels: int, inner: list[nn.Module], outer: list[nn.Module]):
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(channels, channels, 3, 1, 1), *inner, nn.Conv2d(channels, channels, 3, 1, 1)
        )
        self.finish = nn.Sequential(*outer)

    def forward(self, x: Tensor) -> Tensor:
        return self.finish(x + self.body(x))


def _decoder(seed: int, config: ReenactNetConfig, layer: _Layer, residual: bool) -> nn.Sequential:
    """Three doublings from R / 8, the last without blocks of their own; linear for residuals, sigmoid for colours."""
    blocks, size = [], seed
    for index in range(config.decoder_blocks):
        wide = config.decoder_channels * 2 ** (config.decoder_blocks - index)
        blocks += [layer.up(size, wide), layer.residual(wide)]
        size = wide
    rest = 2 ** (3 - config.decoder_blocks)
    if rest == 1:
        blocks.append(nn.Conv2d(size, 3, 1))
    else:
        blocks += [nn.Conv2d(size, 3 * rest * rest, 3, 1, 1), nn.PixelShuffle(rest)]
    return nn.Sequential(*blocks, nn.Identity() if residual else nn.Sigmoid())


def parameter_count(module: nn.Module) -> int:
    """Trainable numbers in a network."""
    return sum(p.numel() for p in module.parameters() if p.requires_grad)


def forward_macs(module: nn.Module, *example: Tensor | str) -> int:
    """Multiply-accumulates of one forward pass, counted on the convolutions and dense layers that ran."""
    total = 0

    def count(layer: nn.Module, _inputs: tuple, output: Tensor) -> None:
        nonlocal total
        total += output.numel() // len(output) * layer.weight[0].numel()

    hooks = [m.register_forward_hook(count) for m in module.modules() if isinstance(m, nn.Conv2d | nn.Linear)]
    with torch.no_grad():
        module(*example)
    for hook in hooks:
        hook.remove()
    return total


class Networks(nn.Module):
    """Everything that a run trains: one ReenactNet, and a BPNet per rig, keyed alike."""

    def __init__(self, shape_counts: dict[str, int], config: Config):
        super().__init__()
        resolution, residual = config.images.resolution, config.images.residual
        self.reenactnet = ReenactNet(list(shape_counts), resolution, config.reenactnet, residual)
        self.bpnets = nn.ModuleDict(
            {key: BPNet(count, resolution, config.bpnet) for key, count in shape_counts.items()}
        )
