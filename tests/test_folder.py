"""Run folders of older formats open or name the version that opens them; so do newer ones."""

import json
import shutil
import tomllib
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import pytest
import torch

from reenact import folder as module
from reenact.checkpoint import load_checkpoint
from reenact.cli import main
from reenact.config import Config
from reenact.errors import MissingError, ReenactError
from reenact.folder import FORMAT, load_run_config, migrate, run_format
from reenact.inference import ImageRetargeter
from reenact.rigs.files import read_clip
from reenact.run import Run
from reenact.training import train

FIXTURES = Path(__file__).parent / "fixtures"
STORED = sorted(FIXTURES.glob("run-*"))
"""By format; made by tests/make_fixture_run.py when the format was new."""


@pytest.fixture(params=STORED, ids=lambda path: path.name)
def stored(request, tmp_path):
    shutil.copytree(request.param, tmp_path / "stored")
    return tmp_path / "stored"


def test_every_format_has_a_stored_run():
    assert [path.name for path in STORED] == [f"run-{number}" for number in range(FORMAT + 1)]
    assert [run_format(path / "run") for path in STORED] == list(range(FORMAT + 1))


def test_a_stored_run_opens_as_it_lies_and_answers_as_it_did(stored):
    before = {path: path.read_bytes() for path in stored.rglob("*") if path.is_file()}
    retargeter = ImageRetargeter.load(stored / "run")
    moved = retargeter(read_clip(str(stored / "clip.npz")))
    expected = read_clip(str(stored / "moved.npz"))
    assert moved.names == expected.names
    torch.testing.assert_close(moved.weights, expected.weights, rtol=0, atol=1e-4)  # other processors round otherwise
    assert {path: path.read_bytes() for path in stored.rglob("*") if path.is_file()} == before


def test_a_stored_run_is_trained_to_its_end_and_is_one_of_today_then(stored):
    run = stored / "run"
    config = load_run_config(run)
    train(config, resume=True)
    assert load_checkpoint(run).step == 12
    assert run_format(run) == FORMAT
    assert load_run_config(run) == config


def test_a_stored_run_of_today_names_every_setting():
    """When this fails, a setting is new or gone: raise `FORMAT` as `reenact.folder` tells, or make the stored run again
    while no released version has written that format."""
    table = tomllib.loads((STORED[-1] / "run" / "config.toml").read_text())

    def named(section, values, prefix=""):
        for setting in fields(section):
            value, key = getattr(section, setting.name), f"{prefix}{setting.name}"
            if is_dataclass(value):
                yield from named(value, values.get(setting.name, {}), f"{key}.")
            elif value is not None and setting.name not in values:
                yield key

    assert list(named(Config(), table)) == []


def test_what_shortly_preceded_formats_is_read_as_it_was_meant(stored):
    path = stored / "run" / "config.toml"
    path.write_text(path.read_text().replace("together = true\n", ""))
    (stored / "run" / "format.json").unlink(missing_ok=True)
    assert load_run_config(stored / "run").training.together is False  # there was no other way, and the default changed


def test_what_was_trained_without_bounds_is_read_without():
    for number in (0, 1):
        assert load_run_config(FIXTURES / f"run-{number}" / "run").bpnet.bounded is False


@pytest.fixture
def run(tmp_path):
    shutil.copytree(STORED[-1] / "run", tmp_path / "run")
    return tmp_path / "run"


def test_a_run_of_0_1_0_is_refused_with_the_version_that_opens_it(run):
    (run / "format.json").unlink()
    (run / "config.toml").write_text("[training]\necho = 2\n")
    sentence = rf"run: expected a run of format {FORMAT} .*; open it with Reenact 0\.1\.0, or"
    for call in (Run.open, load_run_config):
        with pytest.raises(ReenactError, match=sentence):
            call(run)


def test_a_newer_run_is_refused_with_the_version_that_wrote_it_by_every_command(run, tmp_path, capsys):
    (run / "format.json").write_text(json.dumps({"format": FORMAT + 1, "reenact": "9.1.0"}))
    before = sorted(path.name for path in run.rglob("*"))
    for command in (
        ["train", "--run", f"{run}", "--resume"],
        ["infer", f"{run}", "synthetic:1", "--out", f"{tmp_path / 'x.csv'}"],
        ["evaluate", f"{run}"],
        ["render", f"{run}", "synthetic:1", "--out", f"{tmp_path / 'x.gif'}"],
    ):
        assert main(command) == 2
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        assert f"or older, got format {FORMAT + 1}, which Reenact 9.1.0 wrote; open it with that version" in err
    assert sorted(path.name for path in run.rglob("*")) == before


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": "1"}', '{"format": true}', '{"format": -1}', "\xff"])
def test_a_damaged_format_is_named(text, run):
    (run / "format.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(ReenactError, match=r"format\.json: expected .*restore the file"):
        load_run_config(run)


def test_no_run_is_a_missing_file_and_a_mistake_of_the_user(tmp_path):
    with pytest.raises(MissingError, match="expected a run folder") as caught:
        load_run_config(tmp_path / "none")
    assert isinstance(caught.value, FileNotFoundError)
    assert isinstance(caught.value, ReenactError)


def test_a_migration_that_is_cut_short_is_done_again(tmp_path, monkeypatch):
    shutil.copytree(STORED[0] / "run", tmp_path / "run")
    config = load_run_config(tmp_path / "run")
    with monkeypatch.context() as patch:
        patch.setattr(module, "write_format", lambda _: (_ for _ in ()).throw(OSError(28, "No space left on device")))
        with pytest.raises(OSError, match="No space"):
            migrate(tmp_path / "run", config)
    assert load_run_config(tmp_path / "run") == config
    migrate(tmp_path / "run", config)
    assert run_format(tmp_path / "run") == FORMAT
    assert load_run_config(tmp_path / "run") == replace(config, run=str(tmp_path / "run"))


def test_code_that_is_not_installed_has_no_version(monkeypatch):
    def missing(_):
        raise module.importlib.metadata.PackageNotFoundError("reenact")

    monkeypatch.setattr(module.importlib.metadata, "version", missing)
    assert module.reenact_version() == "unknown"
