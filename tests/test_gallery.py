"""The page of everything that moves, in a browser. What it shows is drawn by parts that have tests of their own."""

import importlib.util
import sys
from pathlib import Path

import pytest
import torch
from accessibility import nameless, poor_contrast, tab_stops

from reenact.rigs.clip import Clip


@pytest.fixture(scope="module")
def gallery():
    path = Path(__file__).parents[1] / "figures" / "gallery.py"
    spec = importlib.util.spec_from_file_location("gallery", path)
    module = importlib.util.module_from_spec(spec)
    sys.modules["gallery"] = module  # where its dataclasses look
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def page(gallery, toy_pair, tmp_path_factory):
    """Two faces, the second of which does what the first does."""
    rig = toy_pair[0]
    clip = Clip(rig.names, torch.rand(90, 7, generator=torch.Generator().manual_seed(0)), 30.0)
    faces = [gallery.face(name, "a note", rig, clip) for name in ("first", "second")]
    path = tmp_path_factory.mktemp("gallery") / "gallery.html"
    path.write_text(gallery.page_of([{"title": "All", "note": "Of them.", "faces": faces}]))
    return path


def test_a_clip_that_goes_round_is_at_rest_at_both_ends_and_itself_between(gallery):
    clip = Clip(("jawOpen",), torch.ones(91, 1), 30.0)
    made = gallery.going_round(clip, seconds=0.5).weights
    assert made[0] == made[-1] == 0
    assert torch.equal(made[15:-15], clip.weights[15:-15])
    assert torch.allclose(made, made.flip(0))
    assert float(made.diff(dim=0).abs().max()) < 0.12  # pi / 2 / 15 frames


def test_faces_play_in_step_and_stop_when_asked(page, chromium):
    shown = chromium.new_page()
    shown.goto(page.as_uri())
    shown.wait_for_function("document.getElementById('play').textContent === 'Pause'")
    both = "() => [...document.querySelectorAll('canvas')].map((each) => each.toDataURL())"
    seen = set()
    for _ in range(5):
        first, second = shown.evaluate(both)
        assert first == second
        seen.add(first)
        shown.wait_for_timeout(150)
    assert len(seen) > 1
    shown.get_by_role("button", name="Pause").click()
    shown.wait_for_timeout(100)
    still = shown.evaluate(both)
    shown.wait_for_timeout(300)
    assert shown.evaluate(both) == still
    shown.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_moves_where_motion_is_to_be_reduced_and_all_is_named_and_readable(page, chromium, scheme):
    shown = chromium.new_page(reduced_motion="reduce", color_scheme=scheme)
    asked = []
    shown.on("request", lambda request: asked.append(request.url))
    shown.goto(page.as_uri())
    shown.get_by_role("button", name="Play").wait_for()
    assert nameless(shown) == poor_contrast(shown) == []
    assert tab_stops(shown) == [("play", True)]
    assert [url for url in asked if not url.startswith(("file:", "data:"))] == []
    shown.close()
