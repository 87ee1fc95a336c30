"""ReenactNet and BPNet have the shapes and sizes that the settings promise."""

import pytest
import torch

from reenact.config import BPNetConfig, Config, ImageConfig, ReenactNetConfig
from reenact.models import (
    ComponentReenactNet,
    ConvolutionalReenactNet,
    Eigenpictures,
    LeakyClamp,
    Networks,
    component_bpnet,
    convolutional_bpnet,
    energy,
    forward_macs,
    motion_weight,
    parameter_count,
)


def _convolutional(encoder: int, code: int, seed: int, decoder: int, blocks: int = 2) -> ReenactNetConfig:
    return ReenactNetConfig(
        network="convolutional",
        encoder_channels=encoder,
        code=code,
        seed_channels=seed,
        decoder_channels=decoder,
        decoder_blocks=blocks,
        normalize=blocks < 3,
    )


def _toy(residual: bool = True) -> ConvolutionalReenactNet:
    torch.manual_seed(0)
    return ConvolutionalReenactNet(["a", "b"], 32, _convolutional(8, 16, 16, 8), 3, "l1+l2", residual)


SIZES = [  # settings, pixels, millions of parameters with two decoders, billions of multiply-accumulates forward
    (_convolutional(16, 128, 64, 12, 3), 64, 1.93, 0.23),
    (_convolutional(24, 128, 96, 16, 3), 64, 3.54, 0.42),
    (_convolutional(24, 256, 96, 16, 3), 128, 7.67, 1.69),
]


@pytest.mark.parametrize(("config", "pixels", "parameters", "macs"), SIZES)
def test_sizes_are_those_of_the_table(config, pixels, parameters, macs):
    net = ConvolutionalReenactNet(["a", "b"], pixels, config, 3, "l1")
    assert parameter_count(net) / 1e6 == pytest.approx(parameters, rel=0.01)
    assert forward_macs(net, torch.zeros(1, 3, pixels, pixels), "a", "b") / 1e9 == pytest.approx(macs, rel=0.03)


def test_a_rig_is_drawn_by_its_own_decoder_from_the_shared_code():
    net, pictures = _toy(), torch.randn(2, 3, 32, 32)
    torch.testing.assert_close(net(pictures, "a", "b"), net.decoders["b"](net.encode(pictures, "a")))
    assert (net(pictures, "a", "a") - net(pictures, "a", "b")).abs().max() > 1e-3


def test_colours_stay_in_range_and_residuals_may_be_negative():
    pictures = 10 * torch.randn(4, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    colours = _toy(residual=False)(pictures, "a", "b")
    assert colours.min() >= 0
    assert colours.max() <= 1
    assert _toy()(pictures, "a", "b").min() < 0


def test_picture_distance_is_the_weighted_mean_difference():
    net = _toy()
    a, b = torch.zeros(1, 3, 32, 32), torch.full((1, 3, 32, 32), 2.0)
    assert net.distances("a", a, b) == pytest.approx(2 + 4)  # L1 and squares
    net.squared = False
    net.scales["a"].emphasis[:, :16] = 0.0
    assert net.distances("a", a, b) == pytest.approx(1.0)


def test_one_picture_gives_the_same_weights_alone_and_in_a_batch():
    torch.manual_seed(0)
    net = convolutional_bpnet(7, 32, BPNetConfig(channels=8)).eval()
    pictures = torch.randn(5, 3, 32, 32)
    assert net(pictures).shape == (5, 7)
    torch.testing.assert_close(net(pictures)[2:3], net(pictures[2:3]), rtol=0, atol=1e-5)  # float32, other kernels


def test_answers_beyond_the_range_count_a_hundredth_and_still_learn():
    x = torch.tensor([[-3.0, 0.0, 0.25, 1.0, 2.0]], requires_grad=True)
    y = LeakyClamp()(x)
    torch.testing.assert_close(y, torch.tensor([[-0.03, 0.0, 0.25, 1.0, 1.01]]))
    y.sum().backward()
    torch.testing.assert_close(x.grad[0, [0, 2, 4]], torch.tensor([0.01, 1.0, 0.01]))


@pytest.mark.parametrize("hidden", [0, 16])
@pytest.mark.parametrize("kind", ["components", "convolutional"])
def test_bounded_answers_are_the_published_ones_within_the_range(kind, hidden):
    def answers(bounded):
        torch.manual_seed(0)
        config = BPNetConfig(channels=8, hidden=hidden, bounded=bounded)
        net = component_bpnet(9, 12, config) if kind == "components" else convolutional_bpnet(9, 32, config)
        return net(10 * torch.randn(64, *((12,) if kind == "components" else (3, 32, 32))))

    free, bounded = answers(False), answers(True)
    inside = (free >= 0) & (free <= 1)
    assert inside.any()
    assert torch.equal(free[inside], bounded[inside])
    assert free.min() < -0.1
    torch.testing.assert_close(bounded[free < 0], free[free < 0] / 100)


def _low_rank(rank: int, count: int = 40, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    flat = torch.randn(count, rank, generator=generator) @ torch.randn(rank, 3 * 16 * 16, generator=generator) + 1.0
    return flat.unflatten(1, (3, 16, 16))


def test_pictures_come_back_from_their_mixtures():
    pictures, basis = _low_rank(5), Eigenpictures(8, 16)
    weight = 0.2 + torch.rand(1, 16, 16, generator=torch.Generator().manual_seed(1))
    assert basis.fit(pictures, weight) == pytest.approx(1.0)
    torch.testing.assert_close(basis.depict(basis.describe(pictures)), pictures, rtol=0, atol=1e-3)  # float32 vectors
    assert basis.describe(pictures).std(0, correction=0)[0] == pytest.approx(4.0, rel=1e-3)
    assert not basis.components[5:].any()  # five kinds of change need five components


def test_a_frozen_basis_says_the_same_of_what_varies_and_of_what_never_did():
    pictures, basis = _low_rank(5), Eigenpictures(8, 16)
    pictures[:, :, 4:] = 0.25  # three quarters never vary
    basis.fit(pictures, torch.ones(1, 16, 16))
    others = pictures + torch.randn(pictures.shape, generator=torch.Generator().manual_seed(1))
    before = basis.describe(others)
    basis.freeze()
    assert len(basis.places) == pictures[0].numel() // 4
    assert basis.state_dict().keys() == Eigenpictures(8, 16).state_dict().keys()
    torch.testing.assert_close(basis.describe(others), before, rtol=1e-4, atol=1e-4)  # sums in another order
    assert basis.describe(others).abs().max() > 1


def test_with_equal_components_the_distance_is_that_of_the_pictures():
    """Two orthogonal patterns of equal energy: both components count alike, so Parseval holds to the last digit."""
    patterns = torch.zeros(4, 3, 16, 16)
    patterns[0, 0, :8], patterns[1, 0, :8], patterns[2, 0, 8:], patterns[3, 0, 8:] = 1, -1, 1, -1
    basis = Eigenpictures(2, 16)
    basis.fit(patterns, torch.ones(1, 16, 16))
    a, b = basis.describe(patterns[:1]), basis.describe(patterns[2:3])
    deviation = patterns.flatten(1).square().sum(1).mean().sqrt()
    expected = (patterns[0] - patterns[2]).norm() / deviation
    torch.testing.assert_close(basis.distances(a, b)[0], expected, rtol=1e-4, atol=0)


def test_a_basis_that_was_not_fitted_draws_nothing():
    basis = Eigenpictures(8, 16)
    assert not basis.depict(torch.randn(2, 8)).any()


def test_both_rigs_are_seen_through_the_same_components():
    """The map to the common components gives what they make of the pictures themselves."""
    net = ComponentReenactNet(["a", "b"], 16, ReenactNetConfig(components=8, width=8, code=4), colored=False)
    shown = {"a": _low_rank(5, seed=1), "b": _low_rank(5, seed=2)}
    net.fit(list(shown), shown.__getitem__)
    level = torch.cat([pictures / energy(pictures) for pictures in shown.values()]).flatten(1)
    common = torch.cat([net.to_common[key](net.describe(key, pictures)) for key, pictures in shown.items()])
    # Components are a rotation: distances between pictures are kept, up to the unit.
    distances, expected = torch.cdist(common, common), torch.cdist(level, level)
    ratio = distances[0, 1:] / expected[0, 1:]
    torch.testing.assert_close(ratio, ratio.mean().expand_as(ratio), rtol=1e-2, atol=0)  # float32 eigenvectors


def test_colours_are_drawn_beside_what_is_read():
    config = Config(images=ImageConfig(resolution=16), reenactnet=ReenactNetConfig(components=8, color_components=4))
    networks = Networks({"a": 3, "b": 5}, config)
    shown = {"a": torch.cat([_low_rank(5), _low_rank(3)], 1), "b": torch.cat([_low_rank(4), _low_rank(6)], 1)}
    networks.fit(list(shown), shown.__getitem__)
    shown = torch.cat([_low_rank(5), _low_rank(3)], 1)[:2]
    assert networks.redraw(shown, "a", "b").shape == (2, 6, 16, 16)
    assert networks.read(shown, "b").shape == (2, 5)
    without_colours = networks.retarget(shown[:, 3:], "a", "b")
    torch.testing.assert_close(without_colours, networks.retarget(shown, "a", "b"))


def test_motion_weight_is_larger_where_pictures_move_and_bounded():
    residuals = torch.zeros(3, 3, 4, 4)
    residuals[:, :, 0, 0] = 1.0
    weight = motion_weight(residuals)
    assert weight.shape == (1, 4, 4)
    assert weight[0, 0, 0] == 4.0
    assert weight[0, 3, 3] == pytest.approx(0.2)
