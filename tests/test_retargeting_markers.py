import io
import sys

import numpy as np
import pytest
import torch

from reenact.errors import ReenactError
from reenact.retargeting.correspondence import Places
from reenact.retargeting.markers import Markers, load_markers


def cloud(frames: int = 40, count: int = 30, moving: int = 10, seed: int = 0) -> Markers:
    """Points on a skull; the first `moving` of them are on a jaw that opens and closes by 3 cm."""
    rng = np.random.default_rng(seed)
    rest = rng.normal(0, 0.06, (count, 3))
    swing = 0.03 * np.sin(np.linspace(0, 4 * np.pi, frames)) ** 2
    positions = np.repeat(rest[None], frames, 0)
    positions[:, :moving, 1] -= swing[:, None]
    names = tuple(f"m{index}" for index in range(count))
    return Markers(names, torch.tensor(positions), 60.0, torch.tensor(rest))


def turned(markers: Markers, seed: int = 1) -> tuple[Markers, torch.Tensor, torch.Tensor]:
    """The same on a head that nods and walks."""
    rng = np.random.default_rng(seed)
    frames = len(markers)
    angle = np.cumsum(rng.normal(0, 0.05, frames))
    rotations = np.zeros((frames, 3, 3))
    rotations[:, 0, 0] = 1
    rotations[:, 1, 1] = rotations[:, 2, 2] = np.cos(angle)
    rotations[:, 1, 2], rotations[:, 2, 1] = -np.sin(angle), np.sin(angle)
    shifts = np.cumsum(rng.normal(0, 0.01, (frames, 3)), 0)
    rotations, shifts = torch.tensor(rotations), torch.tensor(shifts)
    moved = torch.einsum("tij,tmj->tmi", rotations, markers.positions) + shifts[:, None]
    return Markers(markers.names, moved, markers.fps, markers.neutral), rotations, shifts


# ---- head motion ----


def test_the_motion_of_the_head_is_taken_away_and_that_of_the_jaw_stays():
    still = cloud()
    walking, rotations, shifts = turned(still)
    found, moved, weights = walking.head_motion()
    torch.testing.assert_close(found, rotations, rtol=0, atol=2e-4)
    torch.testing.assert_close(moved, shifts, rtol=0, atol=5e-5)  # metres; a jaw of 3 cm keeps a little weight
    assert weights[:10].max() < 1e-2 * weights[10:].min()
    torch.testing.assert_close(walking.stabilised().positions, still.positions, rtol=0, atol=5e-5)


def test_equal_weights_would_not_do():
    still = cloud()
    walking, _, _ = turned(still)
    everyone = walking.stabilised(head=walking.names)
    assert (everyone.positions - still.positions).norm(dim=-1).max() > 0.005


def test_markers_known_to_be_on_the_skull_fix_it_exactly():
    still = cloud()
    walking, _, _ = turned(still)
    fixed = walking.stabilised(head=still.names[10:16])
    torch.testing.assert_close(fixed.positions, still.positions, rtol=0, atol=1e-12)


def test_a_head_that_does_not_move_is_left_alone():
    still = cloud(moving=0)
    torch.testing.assert_close(still.stabilised().positions, still.positions, rtol=0, atol=1e-12)


def test_markers_align_with_places_without_or_with_a_change_of_size():
    markers = cloud()
    turn = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).double()  # a capture with +Z up
    places = markers.neutral @ turn.T + 0.2
    moved = markers.aligned(places)
    torch.testing.assert_close(moved.neutral, places, rtol=0, atol=1e-12)
    torch.testing.assert_close(moved.positions, markers.positions @ turn.T + 0.2, rtol=0, atol=1e-12)
    twice = 2 * places
    torch.testing.assert_close(markers.aligned(twice, scaled=True).neutral, twice, rtol=0, atol=1e-12)
    sizes = [points.sub(points.mean(0)).norm() for points in (markers.aligned(twice).neutral, markers.neutral)]
    torch.testing.assert_close(sizes[0], sizes[1])


# ---- made and chosen ----


def test_a_rig_records_what_its_places_do(toy_rig):
    places = Places(toy_rig.faces[:5], torch.full((5, 3), 1 / 3))
    weights = torch.rand(7, len(toy_rig.names), generator=torch.Generator().manual_seed(0))
    markers = Markers.from_rig(toy_rig, places, weights, 30.0)
    torch.testing.assert_close(markers.positions, places.of(toy_rig.vertices(weights)))
    torch.testing.assert_close(markers.neutral, places.of(toy_rig.neutral))
    with pytest.raises(ReenactError, match="expected weights"):
        Markers.from_rig(toy_rig, places, weights[:, :3], 30.0)


def test_markers_are_chosen_by_name():
    markers = cloud()
    some = markers.chosen(["m4", "m2", "m9"])
    assert torch.equal(some.positions, markers.positions[:, [4, 2, 9]])
    with pytest.raises(ReenactError, match="'m99'"):
        markers.chosen(["m99"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"names": ("a", "b", "c")}, "positions a frame"),
        ({"names": ("a", "b", "b", "d")}, "doubled: b"),
        ({"fps": 0.0}, "positive frame rate"),
        ({"positions": torch.full((2, 4, 3), torch.nan)}, "fill the gaps"),
        ({"names": ("a", "b"), "positions": torch.zeros(2, 2, 3), "neutral": torch.zeros(2, 3)}, "at least 3 markers"),
        ({"positions": torch.zeros(0, 4, 3)}, "and a frame"),
    ],
)
def test_markers_that_make_no_sense_are_refused(change, message):
    fields = {"names": tuple("abcd"), "positions": torch.zeros(2, 4, 3), "fps": 30.0, "neutral": torch.zeros(4, 3)}
    with pytest.raises(ReenactError, match=message):
        Markers(**{**fields, **change})


# ---- files ----


def write_npz(folder, **change):
    rng = np.random.default_rng(0)
    arrays = {"names": np.array(list("abcd")), "positions": rng.normal(0, 0.1, (50, 4, 3)), "fps": np.float64(100)}
    np.savez(folder / "take.npz", **{key: value for key, value in {**arrays, **change}.items() if value is not None})
    return folder / "take.npz"


def test_an_archive_is_read_in_metres(tmp_path):
    markers = load_markers(write_npz(tmp_path), neutral_frame=3)
    assert markers.names == ("a", "b", "c", "d")
    assert markers.fps == 100
    assert torch.equal(markers.neutral, markers.positions[3])
    thousandth = load_markers(tmp_path / "take.npz", unit="mm")
    torch.testing.assert_close(thousandth.positions, markers.positions * 0.001)


def test_short_gaps_are_filled_linearly_and_held_at_the_ends(tmp_path):
    positions = np.zeros((10, 4, 3))
    positions[:, 1, 0] = np.arange(10)
    holes = positions.copy()
    holes[[0, 4, 5, 9], 1] = np.nan
    with pytest.warns(UserWarning, match="filled 4 missing positions of 40"):
        markers = load_markers(write_npz(tmp_path, positions=holes), longest_gap=0.02)
    assert markers.positions[:, 1, 0].tolist() == [1, 1, 2, 3, 4, 5, 6, 7, 8, 8]


def test_a_marker_that_is_lost_for_long_is_left_out_and_named(tmp_path):
    positions = np.zeros((50, 4, 3))
    positions[10:20, 2] = np.nan
    with pytest.warns(UserWarning, match=r"left out, lost for longer than 9 frames: c$"):
        markers = load_markers(write_npz(tmp_path, positions=positions), longest_gap=0.09)
    assert markers.names == ("a", "b", "d")
    positions[:, :2] = np.nan
    with (
        pytest.warns(UserWarning, match="left out"),
        pytest.raises(ReenactError, match="at least 3 markers without long gaps, got 1"),
    ):
        load_markers(write_npz(tmp_path, positions=positions), longest_gap=0.09)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positions": None}, "expected an array positions"),
        ({"positions": np.zeros((5, 3, 3))}, r"expected positions \(frames, 4, 3\)"),
        ({"names": np.array(list("aabc"))}, "doubled: a"),
        ({"fps": np.float64(0)}, "positive frame rate"),
        ({"positions": np.zeros((0, 4, 3))}, "got 0 frames"),
    ],
)
def test_a_wrong_archive_is_refused(tmp_path, change, message):
    with pytest.raises(ReenactError, match=message):
        load_markers(write_npz(tmp_path, **change))


def test_a_wrong_suffix_unit_or_neutral_frame_is_refused(tmp_path):
    path = write_npz(tmp_path)
    with pytest.raises(ReenactError, match=r"read from \.npz, \.csv, \.c3d"):
        load_markers(tmp_path / "take.trc")
    with pytest.raises(ReenactError, match="expected a unit"):
        load_markers(path, unit="ell")
    with pytest.raises(ReenactError, match="expected frame 50"):
        load_markers(path, neutral_frame=50)


def write_csv(folder, text: str):
    (folder / "take.csv").write_text(text)
    return folder / "take.csv"


HEAD = "time,a.x,a.y,a.z,b.x,b.y,b.z,c.x,c.y,c.z\n"


def test_a_table_is_read_and_empty_cells_are_gaps(tmp_path):
    rows = "".join(f"{i / 50},{i},0,0,1,1,{'' if i == 2 else i},2,2,2\n" for i in range(5))
    with pytest.warns(UserWarning, match="filled 1 missing"):
        markers = load_markers(write_csv(tmp_path, HEAD + rows))
    assert markers.fps == 50
    assert markers.names == ("a", "b", "c")
    assert markers.positions[:, 0, 0].tolist() == [0, 1, 2, 3, 4]
    assert markers.positions[2, 1].tolist() == [1, 1, 2]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,a.x,a.y\n0,1,2\n", r"NAME\.x, NAME\.y, NAME\.z"),
        ("a.x,a.y,a.z\n1,2,3\n", "columns time"),
        (HEAD + ",1,2,3,1,2,3,1,2,3\n", "a time in every row, row 1"),
        (HEAD + "0,1,2,oops,1,2,3,1,2,3\n", "expected a number in row 1, column a.z"),
        (HEAD + "0,1,2\n", "expected 10 cells"),
        (HEAD, "at least one frame"),
    ],
)
def test_a_wrong_table_is_refused(tmp_path, text, message):
    with pytest.raises(ReenactError, match=message):
        load_markers(write_csv(tmp_path, text))


def c3d_bytes(positions: np.ndarray, names: tuple[str, ...], unit: str | None, rate: float = 120.0) -> bytes:
    """A .c3d file of positions (T, M, 3) in its unit; NaN is written as residual -1."""
    c3d = pytest.importorskip("c3d")
    writer = c3d.Writer(point_rate=rate, analog_rate=0, point_scale=-1.0, point_units="mm  " if unit is None else unit)
    lost = np.isnan(positions).any(-1, keepdims=True)
    points = np.concatenate([np.nan_to_num(positions), np.where(lost, -1.0, 0.0), np.zeros_like(lost)], -1)
    writer.add_frames([(frame.astype(np.float32), np.zeros((0, 1))) for frame in points])
    writer.set_point_labels(list(names))
    stream = io.BytesIO()
    writer.write(stream)
    return stream.getvalue()


@pytest.mark.parametrize(("unit", "size"), [("mm", 1000), ("cm", 100), ("m", 1)])
def test_synthetic_capture_survives_a_c3d_file_in_any_unit(tmp_path, toy_rig, unit, size):
    places = Places.at(torch.arange(0, 600, 40))
    weights = torch.rand(25, len(toy_rig.names), generator=torch.Generator().manual_seed(1))
    made = Markers.from_rig(toy_rig, places, weights, 120.0)
    (tmp_path / "take.c3d").write_bytes(c3d_bytes(made.positions.double().numpy() * size, made.names, unit))
    read = load_markers(tmp_path / "take.c3d")
    assert read.names == made.names
    assert read.fps == 120
    torch.testing.assert_close(read.positions, made.positions, rtol=0, atol=1e-7)  # float32, 20 cm


def test_lost_points_of_a_c3d_file_are_gaps_and_unlabelled_ones_are_left_out(tmp_path):
    positions = np.zeros((30, 5, 3))
    positions[:, 1, 2] = np.arange(30)
    holes = positions.copy()
    holes[7:9, 1] = np.nan
    (tmp_path / "take.c3d").write_bytes(c3d_bytes(holes, ("a", "b", "c", "*12", "d"), "m"))
    with pytest.warns(UserWarning, match="filled 2"):
        markers = load_markers(tmp_path / "take.c3d")
    assert markers.names == ("a", "b", "c", "d")
    assert markers.positions[:, 1, 2].tolist() == list(range(30))


def test_damaged_c3d_files_raise_the_one_error(tmp_path):
    sound = c3d_bytes(np.random.default_rng(0).normal(0, 100, (20, 5, 3)), tuple("abcde"), "mm")
    rng = np.random.default_rng(1)
    refused = 0
    for trial in range(150):
        data = bytearray(sound[: rng.integers(1, len(sound))] if trial % 3 == 0 else sound)
        for place in rng.integers(0, min(len(data), 1500), 0 if trial % 3 == 0 else 4):
            data[place] = rng.integers(0, 256)
        (tmp_path / "take.c3d").write_bytes(bytes(data))
        try:
            load_markers(tmp_path / "take.c3d")
        except ReenactError:
            refused += 1
    assert refused > 60


def test_a_c3d_file_that_is_cut_off_is_refused(tmp_path):
    sound = c3d_bytes(np.zeros((2000, 5, 3)), tuple("abcde"), "mm")
    (tmp_path / "take.c3d").write_bytes(sound[: len(sound) // 2])
    with pytest.raises(ReenactError, match="c3d"):
        load_markers(tmp_path / "take.c3d")


def test_without_the_package_its_name_is_said(tmp_path, monkeypatch):
    (tmp_path / "take.c3d").write_bytes(b"x" * 2000)
    monkeypatch.setitem(sys.modules, "c3d", None)
    with pytest.raises(ReenactError, match=r"pip install 'reenact\[mocap\]'"):
        load_markers(tmp_path / "take.c3d")
