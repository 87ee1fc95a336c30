"""Camera: world -> camera -> clip space -> pixels."""

from __future__ import annotations

import math

import pytest
import torch

from render.camera import Camera, to_pixels


def test_a_point_at_the_edge_of_the_field_of_view_lands_on_the_edge_of_the_picture():
    camera = Camera(torch.eye(3, 4), focal=1 / math.tan(math.radians(15)))  # 30 degrees from bottom to top
    top = torch.tensor([[0.0, math.tan(math.radians(15)), -1.0]])
    column, row = to_pixels(camera.project(top), height=64, width=32)[0]
    # The picture's upper edge lies half a pixel above the centre of row 0; the axis between columns 15 and 16.
    assert (column.item(), row.item()) == pytest.approx((15.5, -0.5), abs=1e-4)  # float32, 64 pixels


def test_look_at_puts_its_target_in_the_middle_at_its_distance_and_keeps_up_upright():
    eye, target = torch.tensor([0.3, 0.2, 0.9]), torch.tensor([0.0, 0.1, 0.0])
    camera = Camera.look_at(eye, target, focal=3.0)
    x, y, _, w = camera.project(target)
    assert (x.item(), y.item()) == pytest.approx((0, 0), abs=1e-6)  # float32
    assert w.item() == pytest.approx((eye - target).norm().item(), rel=1e-6)
    above = to_pixels(camera.project(target + torch.tensor([0.0, 0.01, 0.0])), 64, 64)
    assert above[0].item() == pytest.approx(31.5, abs=1e-4)  # same column, float32
    assert above[1].item() < 31.5  # a smaller row


@pytest.mark.parametrize("focal", [0.0, -1.0, math.inf, math.nan])
def test_a_focal_length_that_is_no_length_is_refused(focal):
    with pytest.raises(ValueError, match="positive focal length"):
        Camera(torch.eye(3, 4), focal)
