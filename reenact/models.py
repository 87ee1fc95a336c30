"""ReenactNet draws an expression on another face; BPNet reads blendshape weights from a picture.

Kim, Jung, Yun, Seo, Noh 2021, "Deep Learning-Based Unsupervised Human Facial Retargeting", CGF 40(7),
doi:10.1111/cgf.14400 (KI21).

Paper   Code                              Shape
E       ReenactNet.encode                 readable part of descriptions -> (B, D) or (B, A, R / 8, R / 8)
D_s,t   ReenactNet.decoders[key]          -> descriptions of pictures of the rig `key`
BPNet   BPNet                             readable part of descriptions -> (B, K)

There are two ReenactNets, and a BPNet for each. `ConvolutionalReenactNet` is the published family (shared encoder, one
decoder per face, from the "deepfake" line); the paper leaves layers and sizes to a supplement that is not public, so
every layer is our choice. `ComponentReenactNet`, the default, is ours: it works between the principal components of
each rig's pictures. Both answer the same calls:

    description = net.describe(key, shown)    pictures as the network holds them: mixtures of components, or themselves
    readable = net.readable(description)      the part that is read from: without the colours, where motion is known
    drawn = net(readable, source, target)     the same expression, described as a picture of another rig
    net.distances(key, drawn, description)    (B,), how far apart two descriptions are
    shown = net.depict(key, drawn)            the picture behind a description

Pictures are what `Studio.show` makes of them: (B, C, R, R), colours and, where `images.motion` asks for it, the motion
pass behind them. There are no skip connections past the code: they would carry the source's identity along.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import scipy.linalg
import torch
import torch.nn.functional as F
from jaxtyping import Float
from kornia.filters import gaussian_blur2d
from torch import Tensor, nn

from reenact.config import BPNetConfig, Config, ReenactNetConfig

READ = 3
"""Channels that are read from, the last ones of a picture: its motion pass, or its colours if it has no other."""
PICTURES_PER_COMPONENT = 6
"""Pictures of a rig, per principal component, that its components are taken from."""
_LEAK = 0.01
"""What of a number beyond [0, 1] is left by a `LeakyClamp`."""
_SPREAD = 4.0
"""Standard deviation of the strongest component in a description; activations of that size train well."""
_COLUMNS = 8192
"""Numbers of each picture that are in double precision at a time."""
_COMMON = 1200
"""Pictures of each of two rigs from which the components that the encoder sees are taken; more rigs share as many."""


class Eigenpictures(nn.Module):
    """Pictures of one rig as mixtures of the principal components of its own pictures.

    A few hundred components hold 99 % of what a rig's pictures show, more where they show motion. Pixels are weighted,
    so that the squared distance of two mixtures is the weighted squared distance of the pictures (Parseval). Until
    `fit`, every picture is described by zeros and drawn as the zero picture.

    Source: Turk & Pentland 1991, "Eigenfaces for Recognition", doi:10.1162/jocn.1991.3.1.71; residuals and weights are
    ours.
    """

    def __init__(self, count: int, resolution: int):
        super().__init__()
        size = READ * resolution * resolution
        self.resolution = resolution
        self.register_buffer("weight", torch.ones(size))
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("components", torch.zeros(count, size))
        self.register_buffer("unit", torch.ones(()))
        self.register_buffer("importance", torch.zeros(count))
        for name in ("places", "weight_there", "mean_there", "components_there"):  # see `freeze`
            self.register_buffer(name, None, persistent=False)

    def describe(self, shown: Float[Tensor, "B 3 R R"]) -> Float[Tensor, "B N"]:
        """The mixture that comes closest to each picture."""
        flat, weight, mean, components = shown.flatten(1), self.weight, self.mean, self.components
        if self.places is not None:
            flat, weight, mean = flat[:, self.places], self.weight_there, self.mean_there
            components = self.components_there
        return (flat * weight - mean) @ components.T / self.unit

    def freeze(self) -> None:
        """Describe faster from now on, for a basis that does not change any more.

        What never varies says nothing of any component: half of a portrait's motion pass.
        """
        self.places = self.components.any(0).nonzero().flatten()
        self.weight_there, self.mean_there = self.weight[self.places], self.mean[self.places]
        self.components_there = self.components[:, self.places]

    def depict(self, mixtures: Float[Tensor, "B N"]) -> Float[Tensor, "B 3 R R"]:
        """The picture of each mixture."""
        flat = torch.addmm(self.mean, mixtures * self.unit, self.components) / self.weight
        return flat.unflatten(1, (READ, self.resolution, self.resolution))

    def distances(self, a: Float[Tensor, "B N"], b: Float[Tensor, "B N"]) -> Float[Tensor, "B"]:
        """Distances in units of the pictures' own deviation: 1 is as far as a typical picture from the mean one.

        Components of little energy count more than their share: a blink moves few pixels.
        """
        return ((a - b).square() @ self.importance + 1e-8).sqrt()

    @torch.no_grad()
    def fit(self, shown: Float[Tensor, "N 3 R R"], weight: Float[Tensor, "1 R R"]) -> float:
        """The share of the weighted variance that the components hold, which are taken from these pictures.

        With fewer pictures than components the rest stay zero.
        """
        self.weight.copy_(weight.sqrt().expand(READ, -1, -1).flatten())
        flat = shown.flatten(1) * self.weight
        self.mean.copy_(flat.mean(0))
        flat -= self.mean
        parts = flat.split(_COLUMNS, dim=1)
        # Energies span six orders of magnitude, float32 sums would drown the last components.
        gram = sum(part @ part.T for part in map(Tensor.double, parts))  # of the small side
        size, count = len(flat), min(len(self.components), len(flat) - 1)
        strongest = scipy.linalg.eigh(gram.numpy(force=True), subset_by_index=[size - count, size - 1])  # ascending
        values, vectors = (torch.from_numpy(each).to(gram) for each in strongest)
        values, vectors = values.flip(0).clamp_min(0), vectors.flip(1)
        kept = values > 1e-9 * values[0]
        turned = vectors.T * kept[:, None]
        self.components.zero_()
        for rows, part in zip(self.components[:count].split(_COLUMNS, dim=1), parts):
            rows.copy_(turned @ part.double())  # U^T X: components times singular values
        self.components[:count] = F.normalize(self.components[:count], dim=1)
        deviations = (values * kept / size).sqrt().float()
        self.unit.copy_(deviations[0] / _SPREAD)
        even = torch.where(kept, deviations.clamp_min(1e-12).rsqrt(), 0.0)  # 1 / sqrt: energies become deviations
        self.importance.zero_()
        self.importance[:count] = even * self.unit**2 / (even * deviations.square()).sum()
        return float((values * kept).sum() / gram.trace().clamp_min(1e-12))


class ComponentReenactNet(nn.Module):
    """One shared encoder and one linear decoder per rig, from principal components to principal components. Ours.

    A motion pass is nearly linear in the weights, which a convolutional network has to discover and this one is built
    for: straight maps beside every dense layer. A picture costs a tenth. All that is nonlinear stays in the part that
    the rigs share, which keeps their codes together.
    """

    def __init__(self, keys: list[str], resolution: int, config: ReenactNetConfig, colored: bool):
        """`colored`: pictures have colours besides what is read from them."""
        super().__init__()
        self.count = config.components
        sizes = [config.components] + [config.color_components] * colored
        self.bases = nn.ModuleDict({key: nn.ModuleList(Eigenpictures(n, resolution) for n in sizes) for key in keys})
        # Each rig's mixtures as mixtures of components that all rigs share, of pictures that vary everywhere alike.
        self.to_common = nn.ModuleDict({key: _Affine(self.count, 2 * self.count) for key in keys})
        self.trunk = Perceptron(2 * self.count, config.width, config.code)
        self.unfold = Perceptron(config.code, config.width, config.width)
        self.decoders = nn.ModuleDict({key: nn.Linear(config.width, sum(sizes)) for key in keys})

    def describe(self, key: str, shown: Float[Tensor, "B C R R"]) -> Float[Tensor, "B N"]:
        """Mixtures of the rig's components; those of its colours come last, and are left out if the picture is."""
        blocks = [shown[:, -READ:], shown[:, :READ]][: shown.shape[1] // READ]
        return torch.cat([basis.describe(block) for basis, block in zip(self.bases[key], blocks)], dim=1)

    def depict(self, key: str, description: Float[Tensor, "B N"]) -> Float[Tensor, "B C R R"]:
        """Pictures, as `Studio.show` makes them."""
        blocks = description.split([len(basis.components) for basis in self.bases[key]], dim=1)
        return torch.cat([basis.depict(block) for basis, block in zip(self.bases[key], blocks)][::-1], dim=1)

    def readable(self, description: Float[Tensor, "B N"]) -> Float[Tensor, "B M"]:
        """Mixtures of what is read from, without the colours beside it."""
        return description[:, : self.count]

    def encode(self, readable: Float[Tensor, "B M"], key: str) -> Float[Tensor, "B D"]:
        """The expression as every decoder understands it: E."""
        return self.unfold(self.code(readable, key))

    def code(self, readable: Float[Tensor, "B M"], key: str) -> Float[Tensor, "B D"]:
        """The bottleneck, where equal expressions of two rigs should meet."""
        return self.trunk(self.to_common[key](readable))

    def forward(self, readable: Float[Tensor, "B M"], source: str, target: str) -> Float[Tensor, "B N"]:
        """The source's expression, described as a picture of the target. Source: KI21, ReenactNet(I) = D_t(E(I))."""
        return self.decoders[target](self.encode(readable, source))

    def distances(self, key: str, a: Float[Tensor, "B N"], b: Float[Tensor, "B N"]) -> Float[Tensor, "B"]:
        """Mean over what is read and colours, each in units of its own energy; see `Eigenpictures.distances`."""
        sizes = [len(basis.components) for basis in self.bases[key]]
        parts = zip(self.bases[key], a.split(sizes, dim=1), b.split(sizes, dim=1))
        return torch.stack([basis.distances(*block) for basis, *block in parts]).mean(0)

    @torch.no_grad()
    def fit(self, keys: list[str], survey: Callable[[str], Float[Tensor, "N C R R"]]) -> None:
        """Take the components from pictures of each rig, one rig at a time: all at once would fill a memory.

        Args:
            keys: Of the rigs.
            survey: Gives pictures of a rig, as `Studio.show` makes them; asked once for each.
        """
        energies, level = {}, []
        for key in keys:
            pictures = survey(key)
            self._fit_bases(key, pictures)
            read = pictures[:, -READ:]
            energies[key] = energy(read).flatten()
            level.append(read[: 2 * _COMMON // len(keys)] / energies[key].unflatten(0, read.shape[1:]))
            del pictures, read  # before the next rig's come
        common = Eigenpictures(2 * self.count, level[0].shape[-1]).to(level[0].device)
        common.fit(torch.cat(level), common.weight.new_ones(1, common.resolution, common.resolution))
        for key in keys:
            basis = self.bases[key][0]
            place = basis.weight * energies[key]
            self.to_common[key].weight.copy_(
                (basis.components * basis.unit / place) @ common.components.T / common.unit
            )
            self.to_common[key].bias.copy_((basis.mean / place - common.mean) @ common.components.T / common.unit)

    @torch.no_grad()
    def join(self, shown: dict[str, Float[Tensor, "N C R R"]], new: list[str]) -> None:
        """Take the components of new rigs from their pictures; those of the others stay.

        The components that all rigs share are not kept. What they say of any picture is told by least squares from the
        pictures of the others, whose mixtures of them are known.
        """
        level = {
            key: pictures[:, -READ:].flatten(1) / energy(pictures[:, -READ:]).flatten()
            for key, pictures in shown.items()
        }
        known = [key for key in shown if key not in new]
        seen = torch.cat([level[key] for key in known]).double()
        said = torch.cat([self.to_common[key](self.describe(key, shown[key][:, -READ:])) for key in known]).double()
        centre, said_centre = seen.mean(0), said.mean(0)
        seen -= centre
        gram = seen @ seen.T
        gram.diagonal().add_(1e-6 * gram.diagonal().mean())
        tell = (seen.T @ torch.linalg.solve(gram, said - said_centre)).float()  # picture to mixture of what is shared
        for key in new:
            pictures = shown[key]
            self._fit_bases(key, pictures)
            basis = self.bases[key][0]
            place = basis.weight * energy(pictures[:, -READ:]).flatten()
            self.to_common[key].weight.copy_((basis.components * basis.unit / place) @ tell)
            self.to_common[key].bias.copy_((basis.mean / place - centre.float()) @ tell + said_centre.float())

    def _fit_bases(self, key: str, pictures: Float[Tensor, "N C R R"]) -> None:
        """Each basis of a rig takes its components from as many of the pictures as it needs."""
        for basis, block in zip(self.bases[key], (pictures[:, -READ:], pictures[:, :READ])):
            basis.fit(block[: PICTURES_PER_COMPONENT * len(basis.components)], motion_weight(block))

    def own(self, key: str) -> list[Tensor]:
        """What belongs to one rig and can be learnt; the encoder's first map of it is fitted otherwise."""
        return [*self.to_common[key].buffers(), *self.decoders[key].parameters()]


class ConvolutionalReenactNet(nn.Module):
    """One shared convolutional encoder, one convolutional decoder per rig: the published family."""

    def __init__(
        self,
        keys: list[str],
        resolution: int,
        config: ReenactNetConfig,
        channels: int,
        loss: str,
        residual: bool = True,
    ):
        """`channels` of the pictures that it draws; `loss` and `residual` as in the settings."""
        super().__init__()
        self.squared = loss == "l1+l2"
        first, seed = config.encoder_channels, config.seed_channels
        layer = _Layer(config.normalize)
        small = resolution // 16
        self.trunk = nn.Sequential(
            layer.down(READ, first, config.kernel),
            layer.down(first, 2 * first, config.kernel),
            layer.down(2 * first, 4 * first, config.kernel),
            layer.down(4 * first, 8 * first, config.kernel),
            nn.Flatten(),
            nn.Linear(8 * first * small * small, config.code),
        )
        self.unfold = nn.Sequential(
            nn.Linear(config.code, seed * small * small),
            nn.Unflatten(1, (seed, small, small)),
            layer.up(seed, seed),
        )
        self.decoders = nn.ModuleDict({key: _decoder(seed, config, layer, channels, residual) for key in keys})
        self.scales = nn.ModuleDict({key: _Scales(channels, resolution) for key in keys})

    def describe(self, key: str, shown: Float[Tensor, "B C R R"]) -> Float[Tensor, "B C R R"]:
        """The pictures themselves."""
        return shown

    def depict(self, key: str, description: Float[Tensor, "B C R R"]) -> Float[Tensor, "B C R R"]:
        """The pictures themselves."""
        return description

    def readable(self, description: Float[Tensor, "B C R R"]) -> Float[Tensor, "B 3 R R"]:
        """The channels that are read from."""
        return description[:, -READ:]

    def encode(self, readable: Float[Tensor, "B 3 R R"], key: str) -> Float[Tensor, "B A r r"]:
        """The expression as every decoder understands it, a small picture: E."""
        return self.unfold(self.code(readable, key))

    def code(self, readable: Float[Tensor, "B 3 R R"], key: str) -> Float[Tensor, "B D"]:
        """The bottleneck, where equal expressions of two rigs should meet."""
        return self.trunk(readable / self.scales[key].energy)

    def forward(self, readable: Float[Tensor, "B 3 R R"], source: str, target: str) -> Float[Tensor, "B C R R"]:
        """The source's expression as a picture of the target. Source: KI21, ReenactNet(I) = D_t(E(I))."""
        return self.decoders[target](self.encode(readable, source))

    def distances(self, key: str, a: Float[Tensor, "B C R R"], b: Float[Tensor, "B C R R"]) -> Float[Tensor, "B"]:
        """Mean absolute difference, where asked plus squares, weighted by where the rig moves. Source: KI21, L_recon.

        The paper does not state the reduction. Squares are ours: where most pixels are still, the median that an
        absolute difference asks for is the still picture.
        """
        difference = (a - b).abs()
        if self.squared:
            difference = difference + difference.square()
        return (difference * self.scales[key].emphasis).mean((1, 2, 3))

    @torch.no_grad()
    def fit(
        self, keys: list[str], survey: Callable[[str], Float[Tensor, "N C R R"]], leveled: bool, weighted: bool
    ) -> None:
        """Measure where each rig's pictures vary.

        Args:
            keys: Of the rigs.
            survey: Gives pictures of a rig, asked once for each.
            leveled: The encoder sees each place and channel divided by how much it varies.
            weighted: Distances count pixels by how much they move.
        """
        for key in keys:
            pictures = survey(key)
            if leveled:
                self.scales[key].energy.copy_(energy(pictures[:, -READ:]))
            if weighted:
                blocks = pictures.split(READ, dim=1)
                self.scales[key].emphasis.copy_(
                    torch.cat([motion_weight(block).expand(READ, -1, -1) for block in blocks])
                )

    def own(self, key: str) -> list[Tensor]:
        """What belongs to one rig and can be learnt."""
        return list(self.decoders[key].parameters())


class Perceptron(nn.Module):
    """Two hidden layers, and a straight map beside them: what is linear need not be learnt the hard way."""

    def __init__(self, size_in: int, width: int, size_out: int):
        super().__init__()
        self.straight = nn.Linear(size_in, size_out)
        self.bent = nn.Sequential(
            nn.Linear(size_in, width), nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, size_out)
        )

    def forward(self, x: Float[Tensor, "B N"]) -> Float[Tensor, "B M"]:
        return self.straight(x) + self.bent(x)


class LeakyClamp(nn.Module):
    """Of what a number exceeds [0, 1] by, where no weight is, only a hundredth is left. Ours.

    A network can then say by any number below zero that a shape rests, and need not hit zero itself, which a smooth
    function of a picture does badly; most shapes rest in most frames. A clamp would do the same, but what it cuts off
    has no gradient and may never come back.
    """

    def forward(self, x: Float[Tensor, "B K"]) -> Float[Tensor, "B K"]:
        return torch.lerp(x.clamp(0, 1), x, _LEAK)


def component_bpnet(shape_count: int, components: int, config: BPNetConfig) -> nn.Module:
    """Reads blendshape weights from a mixture of components: (B, M) -> (B, K). Ours."""
    net = Perceptron(components, config.hidden, shape_count) if config.hidden else nn.Linear(components, shape_count)
    return nn.Sequential(net, LeakyClamp()) if config.bounded else net


def convolutional_bpnet(shape_count: int, resolution: int, config: BPNetConfig) -> nn.Module:
    """Reads blendshape weights from a picture: (B, 3, R, R) -> (B, K).

    GroupNorm, since batches are small and drawn pictures differ from rendered ones.
    """
    sizes = [READ, *(config.channels * factor for factor in (1, 2, 4, 8))]
    blocks: list[nn.Module] = []
    for size_in, size_out in pairwise(sizes):
        blocks += [nn.Conv2d(size_in, size_out, 3, 2, 1), nn.GroupNorm(8, size_out), nn.SiLU()]
    read, hidden = sizes[-1] * (resolution // 16) ** 2, config.hidden
    dense: list[nn.Module] = [nn.Linear(read, shape_count)]
    if hidden:
        dense = [nn.Linear(read, hidden), nn.SiLU(), nn.Linear(hidden, shape_count)]
    return nn.Sequential(*blocks, nn.Flatten(), *dense, *[LeakyClamp()] * config.bounded)


class Networks(nn.Module):
    """Everything that a run trains: one ReenactNet, and a BPNet per rig, keyed alike."""

    def __init__(self, shape_counts: dict[str, int], config: Config):
        super().__init__()
        keys, resolution, settings = list(shape_counts), config.images.resolution, config.reenactnet
        if settings.network == "components":
            self.reenactnet = ComponentReenactNet(keys, resolution, settings, colored=config.images.motion)
            read = {key: component_bpnet(n, settings.components, config.bpnet) for key, n in shape_counts.items()}
        else:
            channels = 2 * READ if config.images.motion else READ
            self.reenactnet = ConvolutionalReenactNet(
                keys, resolution, settings, channels, config.training.loss, config.images.residual
            )
            read = {key: convolutional_bpnet(n, resolution, config.bpnet) for key, n in shape_counts.items()}
        self.bpnets = nn.ModuleDict(read)
        self.config = config

    def fit(self, keys: list[str], survey: Callable[[str], Float[Tensor, "N C R R"]]) -> None:
        """Take from pictures what the networks know of each rig before any training.

        Args:
            keys: Of the rigs.
            survey: Gives pictures of a rig, asked once for each.
        """
        if isinstance(self.reenactnet, ComponentReenactNet):
            self.reenactnet.fit(keys, survey)
        else:
            self.reenactnet.fit(keys, survey, self.config.images.residual, self.config.training.motion_weighting)

    def join(self, shown: dict[str, Float[Tensor, "N C R R"]], new: list[str]) -> None:
        """As `fit`, of new rigs beside others that are trained already; nothing of the others changes.

        Args:
            shown: Pictures of the new rigs, and of at least one other.
            new: Keys of the new ones.
        """
        if isinstance(self.reenactnet, ComponentReenactNet):
            self.reenactnet.join(shown, new)
        else:
            self.fit(new, shown.__getitem__)

    def freeze(self) -> Networks:
        """The networks themselves, faster, for use only: they must not learn or be loaded any more."""
        for module in self.modules():
            if isinstance(module, Eigenpictures):
                module.freeze()
        return self.eval()

    def own(self, key: str) -> list[Tensor]:
        """What belongs to one rig alone and can be learnt: its part of ReenactNet, and its BPNet."""
        return [*self.reenactnet.own(key), *self.bpnets[key].parameters()]

    def retarget(self, shown: Float[Tensor, "B C R R"], source: str, target: str) -> Float[Tensor, "B K"]:
        """The target's weights for pictures of the source, not clamped; colours may be left out beside motion."""
        net = self.reenactnet
        drawn = net(net.readable(net.describe(source, shown)), source, target)
        return self.bpnets[target](net.readable(drawn))

    def redraw(self, shown: Float[Tensor, "B C R R"], source: str, target: str) -> Float[Tensor, "B C R R"]:
        """The source's pictures drawn as the target."""
        net = self.reenactnet
        return net.depict(target, net(net.readable(net.describe(source, shown)), source, target))

    def read(self, shown: Float[Tensor, "B C R R"], key: str) -> Float[Tensor, "B K"]:
        """Weights of a rig from its own pictures, not clamped."""
        net = self.reenactnet
        return self.bpnets[key](net.readable(net.describe(key, shown)))


def motion_weight(residuals: Float[Tensor, "N C R R"]) -> Float[Tensor, "1 R R"]:
    """Where a rig's pictures move: mean absolute residual per pixel over its mean, clamped to [0.2, 4]. Ours."""
    energy = residuals.abs().mean(dim=(0, 1), keepdim=True)[0]
    return (energy / energy.mean().clamp_min(1e-12)).clamp(0.2, 4.0)


def energy(residuals: Float[Tensor, "N C R R"]) -> Float[Tensor, "C R R"]:
    """Smoothed root mean square residual of each pixel and channel, over the channel's mean; at least 0.15. Ours.

    What the encoder sees is divided by it: dark lips on pale skin and red lips on dark skin, a long jaw and a short one
    move alike and look unlike; after this, less so.
    """
    resolution = residuals.shape[-1]
    sigma, size = resolution / 32, 2 * (resolution // 16) + 1
    smooth = gaussian_blur2d(residuals.square().mean(0, keepdim=True), (size, size), (sigma, sigma))[0].sqrt()
    return (smooth / smooth.mean(dim=(1, 2), keepdim=True).clamp_min(1e-9)).clamp_min(0.15)


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


class _Affine(nn.Module):
    """A fixed map x W + b, not trained."""

    def __init__(self, size_in: int, size_out: int):
        super().__init__()
        self.register_buffer("weight", torch.zeros(size_in, size_out))
        self.register_buffer("bias", torch.zeros(size_out))

    def forward(self, x: Tensor) -> Tensor:
        return torch.addmm(self.bias, x, self.weight)


class _Scales(nn.Module):
    """How much each place of a rig's pictures varies, and how much it counts."""

    def __init__(self, channels: int, resolution: int):
        super().__init__()
        self.register_buffer("energy", torch.ones(READ, resolution, resolution))
        self.register_buffer("emphasis", torch.ones(channels, resolution, resolution))


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


def _decoder(seed: int, config: ReenactNetConfig, layer: _Layer, channels: int, residual: bool) -> nn.Sequential:
    """Three doublings from R / 8, the last without blocks of their own; linear for residuals, sigmoid for colours."""
    blocks, size = [], seed
    for index in range(config.decoder_blocks):
        wide = config.decoder_channels * 2 ** (config.decoder_blocks - index)
        blocks += [layer.up(size, wide), layer.residual(wide)]
        size = wide
    rest = 2 ** (3 - config.decoder_blocks)
    if rest == 1:
        blocks.append(nn.Conv2d(size, channels, 1))
    else:
        blocks += [nn.Conv2d(size, channels * rest * rest, 3, 1, 1), nn.PixelShuffle(rest)]
    return nn.Sequential(*blocks, nn.Identity() if residual else nn.Sigmoid())
