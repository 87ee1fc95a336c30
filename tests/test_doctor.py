"""reenact doctor says what is there, what is not, and what to do."""

import json
import tempfile
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from reenact import doctor as module
from reenact.cli import main
from reenact.doctor import Finding, examine, healthy


@pytest.fixture
def quick(monkeypatch):
    """Without what takes seconds."""
    for name in ("_compiler", "_renderer", "_gpu"):
        monkeypatch.setattr(module, name, lambda name=name: Finding(name, "ok", "not looked at"))


def finding(folder, name):
    (found,) = [each for each in examine(folder) if each.name == name]
    return found


def test_this_installation_is_healthy_and_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["doctor"]) == 0
    out = capsys.readouterr().out
    for words in ("ok       torch ", "ok       compiler ", "ok       renderer ", "All that is needed is there"):
        assert words in out
    assert "wrong" not in out
    assert list(tmp_path.iterdir()) == []


def test_findings_are_json_on_request(quick, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(module.shutil, "disk_usage", lambda _: SimpleNamespace(free=1e6))
    assert main(["doctor", "--json"]) == 1
    lines = json.loads(capsys.readouterr().out)
    assert all(line.keys() == {"name", "state", "found", "remedy", "needed"} for line in lines)
    assert {line["name"]: line["state"] for line in lines}["disk"] == "wrong"
    assert all(line["remedy"] for line in lines if line["state"] != "ok")


@pytest.mark.parametrize(("free", "state", "sound"), [(5e9, "ok", True), (1e9, "wrong", True), (1e8, "wrong", False)])
def test_little_space_is_a_warning_and_hardly_any_an_error(free, state, sound, quick, tmp_path, monkeypatch):
    monkeypatch.setattr(module.shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    found = finding(tmp_path, "disk")
    assert (found.state, healthy([found])) == (state, sound)


def test_packages_that_are_missing_or_too_old_are_named_with_what_to_do(quick, tmp_path, monkeypatch):
    asked = ["no-such-package>=1", "numpy>=99", "pillow>=11", "nobody-asks; extra == 'other'"]
    monkeypatch.setattr(module.importlib.metadata, "requires", lambda _: asked)
    found = {each.name: each for each in examine(tmp_path)}
    assert (found["no-such-package"].state, found["no-such-package"].remedy) == (
        "missing",
        "pip install 'no-such-package>=1'",
    )
    assert found["numpy"].found == f"{np.__version__}, but Reenact needs >=99"
    assert found["pillow"].state == "ok"
    assert "nobody-asks" not in found
    assert not healthy(list(found.values()))


def test_code_that_is_not_installed_works_but_cannot_be_checked(quick, tmp_path, monkeypatch):
    def missing(_):
        raise module.importlib.metadata.PackageNotFoundError("reenact")

    monkeypatch.setattr(module.importlib.metadata, "requires", missing)
    found = finding(tmp_path, "packages")
    assert (found.state, found.needed) == ("missing", False)


def test_a_renderer_that_draws_something_else_is_wrong(tmp_path, monkeypatch):
    assert module._renderer().state == "ok"
    pixels = np.asarray(Image.open(module.PICTURE)).copy()
    pixels[20, 20] += 9
    Image.fromarray(pixels).save(tmp_path / "x.png")
    monkeypatch.setattr(module, "PICTURE", tmp_path / "x.png")
    found = module._renderer()
    assert found.state == "wrong"
    assert not healthy([found])


def test_the_stored_picture_is_the_one_that_is_drawn(tmp_path):
    """It protects users, not us: the renderer has tests of its own. Made again by `reenact.doctor.save_picture()`."""
    module.save_picture(tmp_path / "again.png")
    again, stored = (np.asarray(Image.open(path), dtype=int) for path in (tmp_path / "again.png", module.PICTURE))
    assert np.abs(again - stored).max() <= 1  # of 255: other processors round otherwise
    assert len(np.unique(stored)) > 100  # no empty picture


def test_a_check_that_fails_in_a_way_nobody_thought_of_is_a_finding(quick, tmp_path, monkeypatch):
    def broken():
        raise ImportError("libgomp.so.1:\ncannot open")

    monkeypatch.setattr(module, "_threads", broken)
    found = finding(tmp_path, "threads")
    assert (found.state, found.found) == ("wrong", "ImportError: libgomp.so.1: cannot open")
    assert not healthy([found])


def test_more_threads_than_cores_are_named(monkeypatch):
    import torch

    monkeypatch.setattr(torch, "get_num_threads", lambda: 4096)
    assert module._threads().state == "wrong"


def test_folders_that_cannot_be_written_are_named(quick, tmp_path, monkeypatch):
    def forbidden(**_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(tempfile, "TemporaryFile", forbidden)
    found = {each.name: each for each in examine(tmp_path)}
    assert found["files here"].found == f"{tmp_path}: Permission denied"
    assert {name for name, each in found.items() if each.found.endswith("Permission denied")} == {
        "files here",
        "cache",
        "compiled code",
        "locks",
    }
    assert [each.name for each in found.values() if each.needed and each.state != "ok"] == ["files here"]


def test_extras_that_are_missing_or_broken_are_told_with_what_for(quick, tmp_path, monkeypatch):
    real = module.importlib.import_module

    def some(name):
        if name in ("ufbx", "pyrender"):
            raise OSError("libGL.so.1: cannot open shared object file")
        return real(name)

    monkeypatch.setattr(module.importlib, "import_module", some)
    found = {each.name: each for each in examine(tmp_path)}
    assert found["extra fbx"].remedy == "for FBX files: pip install 'reenact[fbx]'"
    assert "pip install --no-deps pyrender" in found["extra opengl"].remedy
    assert healthy(list(found.values()))


def test_every_extra_is_looked_at_also_one_that_this_file_does_not_know(quick, tmp_path, monkeypatch):
    offered = SimpleNamespace(get_all=lambda _: ["fbx", "formats", "news"])
    monkeypatch.setattr(module.importlib.metadata, "metadata", lambda _: offered)
    asked = ["numpy", "no-such-package>=1; extra == 'news'"]
    monkeypatch.setattr(module.importlib.metadata, "requires", lambda _: asked)
    found = {each.name: each for each in examine(tmp_path)}
    assert {f"extra {name}" for name in (*module.EXTRAS, "news")} <= found.keys()
    assert "extra formats" not in found
    assert (found["extra news"].state, found["extra news"].found) == ("missing", "no no-such-package")
