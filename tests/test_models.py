"""ReenactNet and BPNet have the shapes and sizes that the settings promise."""

import pytest
import torch

from reenact.config import BPNetConfig, ReenactNetConfig
from reenact.models import BPNet, ReenactNet, forward_macs, parameter_count

SIZES = [  # settings, pixels, millions of parameters with two decoders, billions of multiply-accumulates forward
    (ReenactNetConfig(16, 128, 64, 12, 3, 3, normalize=False), 64, 1.93, 0.23),
    (ReenactNetConfig(24, 128, 96, 16, 3, 3, normalize=False), 64, 3.54, 0.42),
    (ReenactNetConfig(24, 256, 96, 16, 3, 3, normalize=False), 128, 7.67, 1.69),
]


@pytest.mark.parametrize(("config", "pixels", "parameters", "macs"), SIZES)
def test_sizes_are_those_of_the_table(config, pixels, parameters, macs):
    net = ReenactNet(["a", "b"], pixels, config)
    assert parameter_count(net) / 1e6 == pytest.approx(parameters, rel=0.01)
    assert forward_macs(net, torch.zeros(1, 3, pixels, pixels), "a") / 1e9 == pytest.approx(macs, rel=0.03)


def test_a_rig_is_drawn_by_its_own_decoder_from_the_shared_code():
    torch.manual_seed(0)
    net = ReenactNet(["a", "b"], 32, ReenactNetConfig(8, 16, 16, 8))
    pictures = torch.randn(2, 3, 32, 32)
    torch.testing.assert_close(net(pictures, "a"), net.decoders["a"](net.encode(pictures)))
    assert (net(pictures, "a") - net(pictures, "b")).abs().max() > 1e-3


def test_colours_stay_in_range_and_residuals_may_be_negative():
    torch.manual_seed(0)
    pictures = 10 * torch.randn(4, 3, 32, 32)
    colours = ReenactNet(["a"], 32, ReenactNetConfig(8, 16, 16, 8), residual=False)(pictures, "a")
    assert colours.min() >= 0
    assert colours.max() <= 1
    assert ReenactNet(["a"], 32, ReenactNetConfig(8, 16, 16, 8))(pictures, "a").min() < 0


def test_one_picture_gives_the_same_weights_alone_and_in_a_batch():
    torch.manual_seed(0)
    net = BPNet(7, 32, BPNetConfig(channels=8)).eval()
    pictures = torch.randn(5, 3, 32, 32)
    assert net(pictures).shape == (5, 7)
    torch.testing.assert_close(net(pictures)[2:3], net(pictures[2:3]), rtol=0, atol=1e-5)  # float32, other kernels
