"""Report: one page that holds everything, says what the numbers say, and is safe to open."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
import torch
from accessibility import nameless, poor_contrast, tab_stops
from PIL import Image

from reenact import evaluation, report
from reenact.errors import ReenactError
from reenact.retargeting import METHODS
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig

NAMES = ("jawOpen", "eyeBlinkLeft", "eyeBlinkRight", "mouthSmileLeft", "mouthSmileRight", "browInnerUp")


def make_head(name: str, names: tuple[str, ...] = NAMES, width: float = 0.07) -> Rig:
    """An egg of 96 vertices whose shapes are bumps where a face has its features."""
    polar, around = torch.meshgrid(torch.linspace(0.2, 2.94, 8), torch.arange(12) * (6.2832 / 12), indexing="ij")
    radius = torch.tensor([width, 0.11, 0.08])
    unit = torch.stack([polar.sin() * around.sin(), polar.cos(), polar.sin() * around.cos()], dim=-1).flatten(0, 1)
    places = {"jaw": (0, -0.5), "eyeBlinkLeft": (0.3, 0.4), "eyeBlinkRight": (-0.3, 0.4), "brow": (0, 0.6)}
    deltas = []
    for k, key in enumerate(NAMES[: len(names)]):
        x, y = next((place for start, place in places.items() if key.startswith(start)), (0.25 * (-1) ** k, -0.35))
        near = torch.exp(-((unit - torch.tensor([x, y, (1 - x * x - y * y) ** 0.5])).square().sum(-1)) / 0.08)
        deltas.append(near[:, None] * torch.tensor([0.004 * (-1) ** k, -0.02, 0.01]))
    faces = []
    for row in range(7):
        for column in range(12):
            a, b = 12 * row + column, 12 * row + (column + 1) % 12
            faces += [[a, a + 12, b], [b, a + 12, b + 12]]
    colors = torch.tensor([0.8, 0.6, 0.5]).expand(96, 3).clone()
    return Rig(name, unit * radius, torch.stack(deltas), names, torch.tensor(faces), colors)


class Halved:
    """Moves half as far as it should, and draws grey."""

    def __init__(self, source: Rig, target: Rig):
        self.source, self.target = source, target

    def __call__(self, clip: Clip) -> Clip:
        return Clip(self.target.names, 0.5 * clip.weights, clip.fps)

    def step(self, weights):
        return 0.5 * weights

    def source_pictures(self, weights):
        return 0.5 + 0.3 * weights.mean(1)[:, None, None, None].expand(-1, 3, 16, 16)

    target_pictures = source_pictures

    def source_masks(self, weights):
        return torch.ones(len(weights), 1, 16, 16)

    target_masks = source_masks

    def reenact(self, pictures):
        return pictures.clone()

    def read(self, pictures):
        return ((pictures.mean((1, 2, 3)) - 0.5) / 0.3)[:, None].expand(-1, len(self.target.names)).clamp(0, 1)

    read_direct = read

    def paired(self, weights):
        return None


def make_run(folder, source, target, frames=36, methods=()):
    """An evaluated run folder and its numbers."""
    forward, reverse = Halved(source, target), Halved(target, source)
    beside = {name: METHODS[name](source, target) for name in methods}
    numbers, arrays = evaluation.evaluate_retargeters(forward, reverse, frames, 0, methods=beside)
    (folder / "evaluation").mkdir(parents=True)
    np.savez_compressed(folder / "evaluation" / "frames.npz", **arrays)
    (folder / "evaluation" / "metrics.json").write_text(json.dumps(evaluation.finite(numbers)))
    lines = [{"stage": "reenactnet", "step": 50 * i, "loss": 1 / (1 + i)} for i in range(1, 9)]
    lines += [{"stage": "bpnet.b", "step": 20 * i, "loss": 0.5, "held_out": 0.8 / i} for i in range(1, 4)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines) + '{"stage": "ree')
    (folder / "config.toml").write_text('source_clip = "synthetic:1"\n[images]\nresolution = 64\n')
    return forward, numbers


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "first"
    forward, numbers = make_run(folder, make_head("sour<b>ce"), make_head("target", width=0.09))
    return folder, forward, numbers


@pytest.fixture(scope="module")
def page(run):
    folder, forward, numbers = run
    path = report.write_report([folder], [numbers], load=lambda _: forward)
    assert path == folder / "report.html"
    return path.read_text()


class Links(HTMLParser):
    """Every address that a browser would ask for, and whether each tag is closed."""

    def __init__(self, page: str):
        super().__init__()
        self.addresses: list[str] = []
        self.open: list[str] = []
        self.tags: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.addresses += [value for key, value in attrs if key in ("src", "srcset", "data", "poster") and value]
        self.addresses += [value for key, value in attrs if key == "href" and tag == "link"]
        if tag not in ("meta", "img", "input", "br", "line", "polyline", "path", "rect"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        if self.open and self.open[-1] == tag:
            self.open.pop()
        elif tag not in ("path", "line", "polyline", "rect"):
            raise AssertionError(f"</{tag}> closes <{self.open[-1]}>")


def test_the_page_asks_nobody_for_anything(page):
    links = Links(page)
    assert links.addresses
    assert all(address.startswith("data:image/") for address in links.addresses)
    assert not re.search(r"url\(|@import|fetch\(|https?://", page)


def test_the_page_is_well_formed_and_stays_small(page):
    assert Links(page).open == []
    assert len(page) < 4_000_000
    assert "Undefined" not in page
    assert "None" not in re.sub(r"base64,[^\"]*", "", page)


def test_names_from_files_are_text_never_markup(page):
    assert "<b>ce" not in page
    assert "sour&lt;b&gt;ce" in page


def test_the_page_shows_the_numbers_beside_the_baselines(page, run):
    truth = run[2]["truth"]
    assert truth["ver"] == pytest.approx(0.5, rel=1e-5)
    for words in (
        "this run",
        "without ReenactNet",
        "neutral, never moves",
        "mean pose",
        "shuffled truth",
        "what comes back",
        "blinks",
    ):
        assert words in page
    assert ">0.50</td>" in page


def test_the_page_has_player_sheets_curves_maps_and_training(page):
    tags = Links(page).tags
    assert tags.count("canvas") == 3  # source, reenacted, truth
    assert page.count("Weight of ") >= 4
    assert "Training loss of reenactnet" in page
    assert "Held-out error of bpnet.b" in page
    assert "Held-out error of reenactnet" not in page
    assert page.count("Error map: ") == 4
    assert page.count('class="sheet"') == 3  # worst frames, from bad to good, single shapes


def test_the_player_knows_each_frame_of_its_sheet(page):
    data = json.loads(re.search(r"const PLAYERS = (.*);", page)[1])[0]
    assert data["count"] == len(data["frames"]) == len(data["labels"]) == len(data["positions"])
    assert max(data["positions"]) < data["length"]
    assert data["frames"] == sorted(set(data["frames"]))


def test_each_shape_alone_stands_beside_what_it_should_do(page, run):
    alone = report._alone(run[1])
    assert alone["matrix"]["rows"] == list(NAMES)
    assert [(cell["x"], cell["y"], cell["does"], cell["should"]) for cell in alone["matrix"]["cells"]] == [
        (k, k, 0.5, True) for k in range(len(NAMES))
    ]
    assert "Of 6 shapes whose right answer is known, 6 move the right shape most" in page
    assert "The median misses 50 % of its motion" in page
    assert "jawOpen → jawOpen 0.50, should be 1.00" in page


def test_a_shape_that_moves_another_is_named():
    class Swapped(Halved):
        """Both smiles are answered by the left one."""

        def __call__(self, clip):
            weights = clip.weights.clone()
            weights[:, 3] += weights[:, 4]
            weights[:, 4] = 0
            return Clip(self.target.names, weights.clamp(0, 1), clip.fps)

    alone = report._alone(Swapped(make_head("source"), make_head("target")))
    assert "5 move the right shape most" in alone["sentence"]
    assert "the worst is mouthSmileRight" in alone["sentence"]
    assert "moves mouthSmileLeft by 1.00" in alone["sentence"]
    stray = next(cell for cell in alone["matrix"]["cells"] if not cell["should"])
    assert (alone["matrix"]["rows"][stray["y"]], alone["matrix"]["columns"][stray["x"]]) == NAMES[4:2:-1]
    assert alone["sheet"]["frames"][0]["title"] == "mouthSmileRight"


def test_a_corrective_is_asked_with_its_base():
    heads = [make_head(name, ("jawOpen", "eyeBlinkLeft", "eyeBlinkRight", "mouthClose")) for name in ("one", "two")]
    assert report._alone(Halved(*heads))["matrix"]["rows"][-1] == "mouthClose + jawOpen"


def test_error_lies_on_the_face_in_millimetres():
    head = make_head("target")
    truth = torch.eye(6).numpy()
    heat = report._heat(head, {"truth": truth, "truth_predicted": 0.5 * truth})
    moved = 1000 * head.deltas.norm(dim=-1).mean(0)  # of each shape alone, and so of the six frames
    error, motion = heat["shown"]
    assert motion["limit"] == pytest.approx(float(moved.quantile(0.995)), rel=1e-5)
    assert error["limit"] == pytest.approx(0.5 * motion["limit"], rel=1e-5)
    assert report._heat(head, {}) is None


def test_a_page_of_many_shapes_shows_the_worst(monkeypatch):
    monkeypatch.setattr(report, "MOST_SHAPES", 4)
    alone = report._alone(Halved(make_head("source"), make_head("target")))
    assert (len(alone["matrix"]["rows"]), alone["left_out"]) == (4, 2)


def test_methods_stand_beside_the_run_in_numbers_faces_and_curves(tmp_path):
    forward, numbers = make_run(tmp_path / "run", make_head("a"), make_head("b"), 36, ("copy", "neutral"))
    assert numbers["methods"]["copy"]["truth"]["ver"] == pytest.approx(0, abs=1e-6)  # the truth is by name
    assert numbers["methods"]["neutral"]["truth"]["ver"] == pytest.approx(1)
    page = report.write_report([tmp_path / "run"], [numbers], load=lambda _: forward).read_text()
    assert Links(page).tags.count("canvas") == 5
    assert "copy, no network" in page
    assert "--methods copy neutral" in page
    curves = json.loads(re.search(r"const CURVES = (.*);", page)[1])[0]
    assert [name for name, _ in curves["lines"]] == ["truth", "predicted", "copy", "neutral"]


def test_the_sentence_on_several_runs_says_whether_the_order_is_sure():
    def entry(name, ver, low, high):
        result = {"truth": {"ver": ver, "ver_interval": [low, high]}, "methods": {}}
        return {"name": name, "source": "a", "target": "b", "result": result}

    sure = report.compared([entry("one", 0.4, 0.3, 0.5), entry("two", 0.1, 0.05, 0.2)])
    assert sure.startswith(
        "a → b: two comes closest to the truth (VER 0.10), one follows (0.40); their intervals do not"
    )
    assert "overlap" in report.compared([entry("one", 0.4, 0.3, 0.5), entry("two", 0.35, 0.3, 0.41)])
    unknown = entry("three", None, None, None)
    assert report.compared([unknown, entry("one", 0.4, 0.3, 0.5)]) == ""


@pytest.fixture
def opened(chromium, tmp_path):
    """Opens pages, and makes sure that they ask nobody and say nothing."""
    said, asked, pages = [], [], []

    def open_page(path, **context):
        page = chromium.new_page(**{"reduced_motion": "reduce"} | context)
        page.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: said.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(path.as_uri())
        page.wait_for_function("[...document.images].every(image => image.complete)")
        pages.append(page)
        return page

    yield open_page
    for page in pages:
        page.close()
    assert said == []
    assert [url for url in asked if not url.startswith(("file:", "data:"))] == []


PIXELS = (
    "canvas => [...canvas.getContext('2d').getImageData(0, 0, 256, 256).data].reduce((a, b) => (a * 31 + b) % 65521)"
)


def test_in_a_browser_the_player_scrubs_and_any_shape_is_drawn(opened, tmp_path):
    forward, numbers = make_run(tmp_path / "run", make_head("a"), make_head("b"), 36, ("neutral",))
    page = opened(report.write_report([tmp_path / "run"], [numbers], load=lambda _: forward))
    canvas, scrubber = page.locator("canvas").nth(1), page.get_by_label("Frame", exact=True)
    seen = set()
    for frame in range(3):
        scrubber.fill(str(frame))
        seen.add(canvas.evaluate(PIXELS))
    assert len(seen) == 3

    def drawn(name):
        return page.locator(f".any polyline[data-name={name}]").get_attribute("points")

    before = drawn("predicted")
    page.get_by_label("Shape whose curve is drawn").select_option("eyeBlinkLeft")
    assert drawn("predicted") != before
    heights = [float(point.split(",")[1]) for point in drawn("predicted").split()]
    with np.load(tmp_path / "run" / "evaluation" / "frames.npz") as arrays:
        wanted = 100 - 100 * arrays["predicted"][:, 1]
    assert np.abs(heights - wanted).max() < 0.3  # steps of 1/255, half of one, in percent; one digit
    assert "eyeBlinkLeft" in page.locator(".any svg").get_attribute("aria-label")

    hidden = page.locator("figure.hidden")
    assert hidden.count() == 2
    page.get_by_label("truth", exact=True).check()
    assert hidden.count() == 1


def test_in_a_browser_runs_of_one_source_play_in_step(run, opened):
    folder, forward, numbers = run
    page = opened(report.write_report([folder, folder], [numbers, numbers], load=lambda _: forward))
    box = page.locator(".player").first
    box.get_by_label("Frame", exact=True).fill("2")
    pictures = [canvas.evaluate(PIXELS) for canvas in box.locator("figure:not(.hidden) canvas").all()]
    assert len(pictures) == 3
    assert pictures[1] == pictures[2] != pictures[0]  # twice the same run


@pytest.mark.parametrize("context", [{"color_scheme": "dark"}, {"viewport": {"width": 360, "height": 640}}])
def test_in_a_browser_nothing_is_wider_than_the_page(run, page, opened, context):
    shown = opened(run[0] / "report.html", **context)
    wide, window = shown.evaluate("[document.documentElement.scrollWidth, innerWidth]")
    assert wide <= window


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_in_a_browser_everything_has_a_name_text_has_contrast_and_the_focus_is_seen(run, page, opened, scheme):
    shown = opened(run[0] / "report.html", color_scheme=scheme)
    assert nameless(shown) == []
    assert poor_contrast(shown) == []
    stops = tab_stops(shown)
    assert len(stops) >= 4
    assert [name for name, seen in stops if not seen] == []


def test_in_a_browser_the_player_moves_by_itself_unless_motion_is_to_be_reduced(run, page, opened):
    for wish in ("reduce", "no-preference"):
        shown = opened(run[0] / "report.html", reduced_motion=wish)
        shown.wait_for_timeout(700)
        label = shown.locator(".transport button").first.get_attribute("aria-label")
        assert label == {"reduce": "Play", "no-preference": "Pause"}[wish]


def test_the_same_page_from_the_command_line(run, page, monkeypatch, capsys):
    folder, forward, _ = run
    monkeypatch.setattr("reenact.inference.ImageRetargeter.load", lambda _: forward)
    assert report.main([str(folder)]) == 0
    assert capsys.readouterr().out.strip() == str(folder / "report.html")
    assert (folder / "report.html").read_text() == page


def test_several_runs_share_a_page_with_their_mean_and_spread(run, tmp_path):
    folder, forward, numbers = run
    better = json.loads(json.dumps(evaluation.finite(numbers)))
    better["truth"]["ver"] = 0.3
    path = report.write_report([folder, folder], [numbers, better], load=lambda _: forward)
    page = path.read_text()
    assert "2 runs compared" in page
    assert "0.40 ± 0.14" in page  # of 0.5 and 0.3
    assert Links(page).open == []
    assert Links(page).tags.count("canvas") == 10  # three of each run, and the source, both and the truth in step


def test_rigs_without_shared_names_are_judged_by_pictures_alone(tmp_path):
    target = make_head("target", tuple(f"shape {k}" for k in range(6)))
    forward, numbers = make_run(tmp_path / "run", make_head("source"), target, frames=18)
    page = report.write_report([tmp_path / "run"], [numbers], load=lambda _: forward).read_text()
    assert "share no shape name" in page
    assert "Frame by frame" in page
    assert "against the truth</th>" not in page
    assert Links(page).tags.count("canvas") == 2
    assert Links(page).open == []


def make_result(ver=0.2, direct=0.4, bpnet=0.05, gain=1.0, paired=None):
    def part(value):
        return {"truth": {"ver": value}, "cyclic": {"skill": 0.5}}

    truth = {"ver": ver, "ver_interval": [ver - 0.01, ver + 0.01], "gain": gain}
    return {
        "source": "a",
        "target": "b",
        "frames": 600,
        "truth": truth,
        "cyclic": {"skill": 0.5},
        "direct": part(direct),
        "paired": part(paired) if paired is not None else None,
        "bpnet": {"ver": bpnet},
        "baselines": {"neutral": part(1.0), "mean_pose": part(0.9), "shuffled": part(1.3)},
        "kinds": {"speech": part(0.1), "blinks": part(0.6)},
    }


def test_the_verdict_follows_the_numbers():
    good = report.verdict(make_result())
    assert "20 % of the motion" in good
    assert "it follows well" in good
    assert "beats the best trivial answer (mean pose, 0.90)" in good
    assert "ReenactNet earns its place" in good
    assert "lost between the two faces" in good
    assert "weakest on blinks (0.60)" in good
    assert "gain" not in good


def test_the_verdict_does_not_flatter():
    bad = report.verdict(make_result(ver=1.1, direct=0.4, bpnet=0.9, gain=0.5))
    assert "no better than leaving the face still" in bad
    assert "does not beat the best trivial answer" in bad
    assert "ReenactNet does not help here" in bad
    assert "reading weights from pictures is a large part" in bad
    assert "Shapes move too little (gain 0.50)" in bad
    assert "Shapes move too far" in report.verdict(make_result(gain=1.5))


def test_the_verdict_says_when_pairs_alone_do_better():
    assert "pairs" not in report.verdict(make_result())
    assert "labels" not in report.verdict(make_result())
    assert "copying by look is better" in report.verdict(make_result(paired=0.0))
    assert "reach 0.50 without any network. " in report.verdict(make_result(paired=0.5))


def test_a_sprite_sheet_holds_its_pictures_row_by_row():
    pictures = np.arange(5, dtype=np.uint8)[:, None, None, None].repeat(2, 1).repeat(2, 2).repeat(3, 3)
    sheet = report._grid(pictures, columns=3)
    assert sheet.shape == (4, 6, 3)
    assert sheet[::2, ::2, 0].tolist() == [[0, 1, 2], [3, 4, 0]]


def test_an_error_of_zero_is_black_and_the_limit_is_bright():
    colors = report._colored(np.array([[0.0, 0.2, 9.0]]), limit=0.2)
    assert colors[0, 0].max() < 10
    assert colors[0, 1].tolist() == colors[0, 2].tolist()
    assert colors[0, 1].min() > 150


def test_pictures_become_data_uris_that_decode():
    import base64
    import io

    pixels = np.zeros((4, 6, 3), np.uint8)
    kind, data = report._picture(pixels, "PNG").split(";base64,")
    assert kind == "data:image/png"
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))), pixels)


def test_mistakes_are_one_sentence_and_status_2(run, tmp_path, capsys):
    assert report.main([]) == 2
    assert "usage" in capsys.readouterr().err
    assert report.main([str(tmp_path)]) == 2
    message = capsys.readouterr().err
    assert "metrics.json: expected the numbers of a run" in message
    assert len(message.splitlines()) == 1


def test_a_report_needs_evaluated_runs(run, tmp_path):
    _, forward, numbers = run
    with pytest.raises(ReenactError, match="one result for each"):
        report.write_report([], [])
    with pytest.raises(ReenactError, match="frames of an evaluation"):
        report.write_report([tmp_path], [numbers], load=lambda _: forward)
