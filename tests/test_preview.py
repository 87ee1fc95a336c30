"""A preview shows what there is to see, in its column."""

import pytest
import torch
from PIL import Image

from reenact.preview import save_contact_sheet, save_preview, shared_weights


def test_a_sheet_has_a_column_per_list_and_a_row_per_picture(tmp_path):
    red = torch.tensor([1.0, 0.0, 0.0])[:, None, None].expand(2, 3, 8, 8)
    path = tmp_path / "new" / "sheet.png"
    save_contact_sheet(path, [red, 2 * torch.ones(2, 3, 16, 16), torch.zeros(2, 3, 8, 8)])  # 2 is too bright: clamped
    with Image.open(path) as sheet:
        assert sheet.size == (3 * 128, 2 * 128)
        assert [sheet.getpixel((64 + 128 * k, 200)) for k in range(3)] == [(255, 0, 0), (255, 255, 255), (0, 0, 0)]


@pytest.mark.parametrize(("trained", "columns"), [([], 3), (["ball"], 3), (["ball", "egg"], 4)])
def test_predictions_are_shown_once_their_network_is_trained(trained, columns, toy_run, tmp_path):
    studios = {key: toy_run.studio(key) for key in toy_run.keys}
    save_preview(tmp_path / "p.png", studios, toy_run.trained_networks(), trained)
    with Image.open(tmp_path / "p.png") as sheet:
        assert sheet.size == (columns * 128, 6 * 128)


def test_weights_are_shared_by_arkit_name():
    weights = torch.tensor([[0.25, 0.5, 1.0]])
    shared = shared_weights(weights, ("jawOpen", "eyeBlinkLeft", "mine"), ("EyeBlink_L", "jawOpen", "theirs"))
    assert shared.tolist() == [[0.5, 0.25, 0.0]]


def test_truth_is_unknown_where_most_names_differ():
    assert shared_weights(torch.ones(1, 2), ("jawOpen", "a"), ("jawOpen", "b", "c")) is None
