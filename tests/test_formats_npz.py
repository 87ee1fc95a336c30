"""Rigs in .npz."""

import io
import struct
import warnings
import zipfile

import numpy as np
import pytest
import torch
from conftest import make_random_rig

from reenact.errors import ReenactError
from reenact.rigs.formats import disk, npz


@pytest.mark.parametrize("seed", range(20))
def test_a_rig_comes_back_exactly_and_writes_the_same_bytes(seed, tmp_path):
    rig = make_random_rig(seed)
    npz.save(rig, tmp_path / "one.npz")
    again = npz.load(tmp_path / "one.npz")
    assert (again.name, again.names) == (rig.name, rig.names)
    for field, value in vars(rig).items():
        assert not isinstance(value, torch.Tensor) or torch.equal(getattr(again, field), value)
    npz.save(again, tmp_path / "two.npz")
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()


def arrays() -> dict[str, np.ndarray]:
    rig = make_random_rig(0)
    return {
        "names": np.array(rig.names),
        "neutral": rig.neutral.numpy(),
        "deltas": rig.deltas.numpy(),
        "faces": rig.faces.numpy(),
    }


def test_the_four_plain_arrays_are_a_rig_named_after_its_file(tmp_path):
    np.savez_compressed(tmp_path / "plain.npz", **(arrays() | {"faces": arrays()["faces"].astype(np.uint16)}))
    assert npz.load(tmp_path / "plain.npz").name == "plain"


def test_byte_strings_fortran_order_and_big_endian_load(tmp_path):
    odd = {
        "names": np.array([b"a", b"b", b"c"]),
        "neutral": np.asfortranarray(arrays()["neutral"].astype(">f8")),
    }
    np.savez(tmp_path / "odd.npz", **(arrays() | odd))
    rig = npz.load(tmp_path / "odd.npz")
    assert rig.names == ("a", "b", "c")
    assert torch.equal(rig.neutral, make_random_rig(0).neutral)


BAD = {
    "no names": ({"names": None}, "expected an array names"),
    "objects": ({"names": np.array(["a", 1, None], dtype=object)}, "names: expected numbers or strings, got object"),
    "numbers as names": ({"names": np.zeros(3)}, "names as a list of strings"),
    "doubled": ({"names": np.array(["a", "a", "b"])}, "doubled: a"),
    "flat neutral": ({"neutral": np.zeros(75, np.float32)}, r"neutral of shape \(any, 3\)"),
    "few deltas": ({"deltas": np.zeros((2, 25, 3), np.float32)}, r"deltas of shape \(3, 25, 3\), got \(2, 25, 3\)"),
    "text": ({"neutral": np.array([["a", "b", "c"]])}, "numbers in neutral"),
    "NaN": ({"neutral": np.full((25, 3), np.nan)}, "neutral holds NaN"),
    "too large": ({"neutral": np.full((25, 3), 1e300)}, "neutral holds NaN or infinity"),
    "faces real": ({"faces": np.zeros((2, 3))}, "whole numbers in faces"),
    "faces far": ({"faces": np.full((2, 3), 99)}, "a face names a vertex outside"),
    "parts far": ({"parts": np.full(25, 99)}, "expected parts among skin"),
    "part names": ({"parts": np.zeros(25, int), "part_names": np.array(["hat"])}, "expected parts among skin"),
    "texture alone": ({"texture": np.zeros((2, 2, 3))}, "no uv"),
    "complex": ({"colors": np.zeros((25, 3), complex)}, "got complex128"),
}


@pytest.mark.parametrize(("change", "message"), BAD.values(), ids=BAD)
def test_arrays_that_are_no_rig_are_refused_by_file_and_field(change, message, tmp_path):
    np.savez(tmp_path / "bad.npz", **{key: value for key, value in (arrays() | change).items() if value is not None})
    with pytest.raises(ReenactError, match=message) as caught:
        npz.load(tmp_path / "bad.npz")
    assert str(caught.value).startswith(str(tmp_path / "bad.npz"))


def header(shape: str, dtype: str = "<f4") -> bytes:
    text = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text) + 1) + text + b"\n"


HEADERS = {
    "lying shape": header("(1000000000000, 3)") + b"\0" * 12,
    "negative shape": header("(-1, -3)") + b"\0" * 12,
    "text shape": header("'abc'"),
    "code": header("__import__('os').system('false')"),
    "bad type": header("(1,)", "<q9"),
    "empty type": header("(1,)", "<U0"),
    "no magic": b"abc",
    "version 9": b"\x93NUMPY\x09\x00" + header("(1,)")[8:],
    "wild character": header("(1,)", "<U1") + b"\xff\xff\xff\xff",
}


@pytest.mark.parametrize("data", HEADERS.values(), ids=HEADERS)
def test_an_array_that_lies_about_itself_is_refused(data, tmp_path):
    with zipfile.ZipFile(tmp_path / "lies.npz", "w") as archive:
        archive.writestr("names.npy", data)
    with pytest.raises(ReenactError, match=r"lies\.npz: names: expected"):
        npz.load(tmp_path / "lies.npz")


def test_a_zip_bomb_is_refused_unopened(tmp_path, monkeypatch):
    monkeypatch.setattr(disk, "LIMIT", 1 << 20)
    with zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("neutral.npy", b"\0" * (1 << 21))
    with pytest.raises(ReenactError, match="expected at most 1,048,576 bytes unpacked, got 2,097,152"):
        npz.load(tmp_path / "bomb.npz")


def test_what_is_no_zip_file_is_refused(tmp_path):
    (tmp_path / "text.npz").write_text("hello")
    for read in (npz.load, npz.contents):
        with pytest.raises(ReenactError, match=r"expected a \.npz archive"):
            read(tmp_path / "text.npz")


def test_200_mutated_files_load_or_are_refused(tmp_path):
    packed = io.BytesIO()
    np.savez_compressed(packed, **arrays())
    npz.save(make_random_rig(7), tmp_path / "whole.npz")
    samples = [packed.getvalue(), (tmp_path / "whole.npz").read_bytes()]
    rng = np.random.default_rng(12)
    refused = 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for round_ in range(200):
            data = bytearray(samples[round_ % 2])
            for place in rng.integers(0, len(data), rng.integers(1, 6)):
                data[place] = rng.integers(256)
            path = tmp_path / "mutant.npz"
            path.write_bytes(bytes(data[: rng.integers(1, len(data))] if round_ % 10 == 0 else data))
            for read in (npz.load, npz.contents):
                try:
                    read(path)
                except ReenactError:
                    refused += 1
    assert refused > 100  # every entry has a checksum
