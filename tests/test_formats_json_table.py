"""Plain tables of weights as .json."""

import json
import warnings

import numpy as np
import pytest
import torch

from reenact.errors import ReenactError
from reenact.rigs.clip import Clip
from reenact.rigs.formats import audio2face, json_table

GOOD = {"names": ["a", "b"], "fps": 30, "weights": [[0, 0.5], [1, 0.25]]}


@pytest.mark.parametrize("seed", range(20))
def test_a_clip_comes_back_exactly_and_writes_the_same_bytes(seed, tmp_path):
    rng = np.random.default_rng(seed)
    weights = rng.random((50, 3)) ** rng.integers(1, 30) * rng.choice([1, -1, 1e-30, 1e30], (50, 1))
    weights[rng.random((50, 3)) < 0.2] = rng.integers(0, 2)
    names = ("jawOpen", "口あ\u3000👩‍🦰", 'ü "x"\\\n')
    clip = Clip(names, torch.tensor(weights, dtype=torch.float32), (30.0, 24.0, 30000 / 1001, 12.5)[seed % 4])
    json_table.save(clip, tmp_path / "one.json")
    again = json_table.load(tmp_path / "one.json")
    assert (again.names, again.fps) == (clip.names, clip.fps)
    assert torch.equal(again.weights, clip.weights)
    json_table.save(again, tmp_path / "two.json")
    assert (tmp_path / "one.json").read_bytes() == (tmp_path / "two.json").read_bytes()


def test_a_file_is_as_a_reader_would_write_it(tmp_path):
    json_table.save(Clip(("a", "b"), torch.tensor([[0, 0.1], [1, 0.25]]), 24.0), tmp_path / "t.json")
    expected = '{\n"names": ["a", "b"],\n"fps": 24.0,\n"weights": [\n[0, 0.1],\n[1, 0.25]\n]\n}\n'
    assert (tmp_path / "t.json").read_text() == expected


def test_times_count_where_there_is_no_rate(tmp_path):
    path = tmp_path / "t.json"
    path.write_text('\ufeff{"time": [0, 1, 3, 4], "names": ["a"], "weights": [[0], [1], [3], [4.5]]}', encoding="utf-8")
    clip = json_table.load(path)
    assert clip.fps == 1
    assert clip.weights[:, 0].tolist() == [0, 1, 2, 3, 4.5]


def test_fields_that_move_are_named_and_others_are_let_be(tmp_path):
    more = {"note": "x", "tags": ["y", "z"], "still": [[1, 2], [1, 2]], "rotations": [[0, 1], [1, 0]]}
    (tmp_path / "t.json").write_text(json.dumps(GOOD | more))
    with pytest.warns(UserWarning, match=r"t\.json: fields that move .* not loaded: rotations$"):
        json_table.load(tmp_path / "t.json")
    (tmp_path / "t.json").write_text(json.dumps(GOOD | dict(list(more.items())[:3])))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        json_table.load(tmp_path / "t.json")


BAD = {
    "empty": ("", "empty file"),
    "no JSON": ("time,a\n0,1\n", "expected JSON, it cannot be parsed"),
    "cut off": ('{"names": ["a"], "weights": [[0', "is it cut off"),
    "deep": ("[" * 100_000, "nested too deeply"),
    "deep object": ('{"a":' * 100_000, "nested too deeply"),
    "NaN": ('{"names": ["a"], "fps": 30, "weights": [[NaN]]}', "NaN is not JSON"),
    "Infinity": ('{"names": ["a"], "fps": 30, "weights": [[-Infinity]]}', "-Infinity is not JSON"),
    "doubled field": ('{"names": ["a"], "names": ["b"], "fps": 30, "weights": [[0]]}', "'names' stands twice"),
    "digits": ('{"names": ["a"], "fps": 30, "weights": [[' + "9" * 5000 + "]]}", "cannot be parsed"),
    "a list": ("[1, 2]", "expected names and weights .*got a list of 2"),
    "a number": ("7", "got 7"),
    "other fields": ('{"shapes": [], "rate": 3}', "got an object of shapes, rate"),
    "no fields": ("{}", "got an empty object"),
}
BAD_FIELDS = {
    "names text": ({"names": "ab"}, "names as a list of strings, got 'ab'"),
    "names mixed": ({"names": ["a", 1]}, "names as a list of strings, got a list of 2"),
    "nameless": ({"names": ["a", ""]}, r"expected a name in names\[1\], got ''"),
    "half a pair": ({"names": ["a", "\ud83d"]}, r"expected a name in names\[1\]"),
    "doubled": ({"names": ["a", "a"]}, "doubled: a"),
    "no names": ({"names": [], "weights": [[]]}, "a name for every column"),
    "no weights": ({"weights": None}, "weights as a list of one or more rows, got None"),
    "no rows": ({"weights": []}, "weights as a list of one or more rows"),
    "flat": ({"weights": [0, 1]}, "2 weights, one per name, in weights row 1, got 0"),
    "short row": ({"weights": [[0, 1], [0]]}, "2 weights, one per name, in weights row 2, got 1"),
    "text": ({"weights": [[0, "1"]]}, "a number in weights row 1, b, got '1'"),
    "true": ({"weights": [[0, 1], [True, 0]]}, "a number in weights row 2, a, got True"),
    "nothing": ({"weights": [[0, None]]}, "a number in weights row 1, b, got None"),
    "nested": ({"weights": [[0, [1]]]}, "a number in weights row 1, b, got a list of 1"),
    "too large": ({"weights": [[0, 1e300]]}, r"a weight in weights row 1, b, got 1e\+300"),
    "infinite": ({"weights": [[0, 1], ["HUGE", 0]]}, "a weight in weights row 2, a, got inf"),
    "huge whole": ({"weights": [[0, 10**400]]}, "row 1, b, got a whole number of more than 40 digits"),
    "rate 0": ({"fps": 0}, "fps as frames per second above 0, got 0"),
    "rate text": ({"fps": "30"}, "fps as frames per second above 0, got '30'"),
    "rate true": ({"fps": True}, "fps as frames per second above 0, got True"),
    "rate huge": ({"fps": 10**400}, "fps as frames per second above 0"),
    "no rate": ({"fps": ...}, "expected fps or time"),
    "few times": ({"fps": ..., "time": [0]}, "2 seconds in time, one per row, got a list of 1"),
    "time text": ({"fps": ..., "time": [0, "1"]}, "a number in time, row 2, got '1'"),
    "time huge": ({"fps": ..., "time": [0, 10**400]}, "a number in time, row 2, got a whole number"),
    "time far": ({"fps": ..., "time": [0, 1e200]}, "times must be finite, row 2"),
    "time gap": ({"fps": ..., "time": [0, 0.1, 1e9], "weights": [[0, 0]] * 3}, "about one row per frame"),
}


@pytest.mark.parametrize(("text", "message"), BAD.values(), ids=BAD)
@pytest.mark.parametrize("load", [json_table.load, audio2face.load])
def test_what_is_no_table_is_refused(load, text, message, tmp_path):
    (tmp_path / "bad.json").write_text(text)
    if load is audio2face.load:
        message = message.replace("names and weights ", "facsNames and weightMat ")
    with pytest.raises(ReenactError, match=message) as caught:
        load(tmp_path / "bad.json")
    assert str(caught.value).startswith(str(tmp_path / "bad.json"))


@pytest.mark.parametrize(("change", "message"), BAD_FIELDS.values(), ids=BAD_FIELDS)
def test_fields_that_are_no_clip_are_refused_by_row_and_name(change, message, tmp_path):
    fields = {key: value for key, value in (GOOD | change).items() if value is not ...}
    (tmp_path / "bad.json").write_text(json.dumps(fields).replace('"HUGE"', "1e999"))
    with pytest.raises(ReenactError, match=message) as caught:
        json_table.load(tmp_path / "bad.json")
    assert str(caught.value).startswith(str(tmp_path / "bad.json"))


def test_what_is_too_large_or_missing_is_refused_unread(tmp_path, monkeypatch):
    monkeypatch.setattr(json_table, "BYTES", 20)
    (tmp_path / "big.json").write_text(json.dumps(GOOD))
    with pytest.raises(ReenactError, match=r"at most 20 bytes of JSON, got \d+; convert it to \.npz"):
        json_table.load(tmp_path / "big.json")
    with pytest.raises(ReenactError, match="expected a file, found nothing"):
        json_table.load(tmp_path / "none.json")
    with pytest.raises(ReenactError, match="expected a file"):
        json_table.load(tmp_path / "nu\0l.json")


def mutants(sample: bytes, count: int, seed: int):
    """The sample with a few bytes changed, moved, doubled or cut."""
    rng = np.random.default_rng(seed)
    for round_ in range(count):
        data = bytearray(sample)
        for place in rng.integers(0, len(data), rng.integers(1, 6)):
            data[place] = rng.integers(256) if round_ % 3 == 0 else rng.choice(list(b'0123456789.,-[]{}:"eEtruNn\\'))
        start, length = rng.integers(0, len(data), 2)
        if round_ % 10 == 0:
            del data[start:]
        elif round_ % 10 == 1:
            data[start:start] = data[start : start + length]
        yield bytes(data)


@pytest.mark.parametrize("format", [json_table, audio2face])
def test_2000_mutated_files_load_or_are_refused(format, tmp_path):
    clip = Clip(("jawOpen", "eyeBlink_L"), torch.rand(6, 2, generator=torch.Generator().manual_seed(1)), 30.0)
    format.save(clip, tmp_path / "whole.json")
    refused = 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for data in mutants((tmp_path / "whole.json").read_bytes(), 2000, seed=14):
            (tmp_path / "mutant.json").write_bytes(data)
            try:
                format.load(tmp_path / "mutant.json")
            except ReenactError:
                refused += 1
    assert 1000 < refused < 2000
