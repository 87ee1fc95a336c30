"""ReenactNet and BPNet have the shapes and sizes that the settings promise."""

import pytest
import torch

from reenact.config import BPNetConfig, ReenactNetConfig
from reenact.models import BasisDecoder, BPNet, ReenactNet, forward_macs, parameter_count


def _convolutional(encoder: int, code: int, seed: int, decoder: int, blocks: int = 2) -> ReenactNetConfig:
    return ReenactNetConfig(
        encoder_channels=encoder,
        code=code,
        decoder="convolutional",
        seed_channels=seed,
        decoder_channels=decoder,
        decoder_blocks=blocks,
        normalize=blocks < 3,
    )


SIZES = [  # settings, pixels, millions of parameters with two decoders, billions of multiply-accumulates forward
    (_convolutional(16, 128, 64, 12, 3), 64, 1.93, 0.23),
    (_convolutional(24, 128, 96, 16, 3), 64, 3.54, 0.42),
    (_convolutional(24, 256, 96, 16, 3), 128, 7.67, 1.69),
]


@pytest.mark.parametrize(("config", "pixels", "parameters", "macs"), SIZES)
def test_sizes_are_those_of_the_table(config, pixels, parameters, macs):
    net = ReenactNet(["a", "b"], pixels, config)
    assert parameter_count(net) / 1e6 == pytest.approx(parameters, rel=0.01)
    assert forward_macs(net, torch.zeros(1, 3, pixels, pixels), "a") / 1e9 == pytest.approx(macs, rel=0.03)


def test_a_rig_is_drawn_by_its_own_decoder_from_the_shared_code():
    torch.manual_seed(0)
    net = ReenactNet(["a", "b"], 32, _convolutional(8, 16, 16, 8))
    pictures = torch.randn(2, 3, 32, 32)
    torch.testing.assert_close(net(pictures, "a"), net.decoders["a"](net.encode(pictures)))
    assert (net(pictures, "a") - net(pictures, "b")).abs().max() > 1e-3


def test_colours_stay_in_range_and_residuals_may_be_negative():
    torch.manual_seed(0)
    pictures = 10 * torch.randn(4, 3, 32, 32)
    colours = ReenactNet(["a"], 32, _convolutional(8, 16, 16, 8), residual=False)(pictures, "a")
    assert colours.min() >= 0
    assert colours.max() <= 1
    assert ReenactNet(["a"], 32, _convolutional(8, 16, 16, 8))(pictures, "a").min() < 0


def test_one_picture_gives_the_same_weights_alone_and_in_a_batch():
    torch.manual_seed(0)
    net = BPNet(7, 32, BPNetConfig(channels=8)).eval()
    pictures = torch.randn(5, 3, 32, 32)
    assert net(pictures).shape == (5, 7)
    torch.testing.assert_close(net(pictures)[2:3], net(pictures[2:3]), rtol=0, atol=1e-5)  # float32, other kernels


def test_a_basis_decoder_can_draw_every_mixture_of_the_pictures_it_was_fitted_to():
    torch.manual_seed(0)
    decoder = BasisDecoder(16, ReenactNetConfig(decoder_width=8, components=8))
    truth = torch.randn(40, 5) @ torch.randn(5, 3 * 16 * 16) + 1.0
    assert decoder.fit(truth.unflatten(1, (3, 16, 16))) == pytest.approx(1.0)
    outside = truth[:3] - decoder.mean
    basis = torch.nn.functional.normalize(decoder.components[:5], dim=1)
    torch.testing.assert_close(outside @ basis.T @ basis, outside, rtol=0, atol=1e-3)  # float32 eigenvectors
    deviations = (truth - truth.mean(0)) @ basis.T
    torch.testing.assert_close(decoder.components[:5].norm(dim=1), deviations.std(0, correction=0), rtol=1e-3, atol=0)


def test_a_basis_decoder_that_was_not_fitted_draws_nothing():
    decoder = BasisDecoder(16, ReenactNetConfig(decoder_width=8, components=8))
    assert not decoder(torch.randn(2, 8)).any()
