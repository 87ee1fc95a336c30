"""Settings: strict reading, whole writing, ranges."""

import os
from dataclasses import replace
from pathlib import Path

import pytest

from reenact.atomic import write_atomically
from reenact.config import (
    Config,
    ImageConfig,
    changed_settings,
    check_config,
    config_from_dict,
    config_to_dict,
    load_config,
    save_config,
)
from reenact.errors import ReenactError

CONFIGS = sorted((Path(__file__).parents[1] / "configs").glob("*.toml"))


def load_text(folder, text):
    path = folder / "x.toml"
    path.write_text(text)
    return load_config(path)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_every_config_of_the_project_loads_and_survives_a_round_trip(path, tmp_path):
    config = load_config(path)
    save_config(config, tmp_path / "again.toml")
    assert load_config(tmp_path / "again.toml") == config


def test_an_empty_file_gives_the_defaults(tmp_path):
    assert load_text(tmp_path, "") == Config()


def test_the_published_settings_of_kim_are_as_published():
    config = load_config(CONFIGS[0].parent / "paper-kim2021.toml")
    training, bpnet = config.training, config.bpnet
    assert (config.images.resolution, config.images.residual, config.layout.method) == (128, False, "none")
    assert (training.optimizer, training.schedule, training.learning_rate) == ("adam", "constant", 3e-4)
    assert (training.epochs, training.batch_size, training.elastic) == (16, 16, 0)
    assert (bpnet.epochs, bpnet.batch_size, bpnet.learning_rate) == (8, 5, 3e-4)
    assert (bpnet.weight_loss, bpnet.image_loss, bpnet.vertex_loss) == (1, 1, 0)


@pytest.mark.parametrize(
    "name",
    ["plain", 'quo"te', "back\\slash", "new\nline", "del\x7f", "tab\t", "nul\x00", "naïve 日本 😀", "a # b", "[x]"],
)
def test_any_text_survives_the_file(name, tmp_path):
    config = replace(Config(), source=name, run=name)
    save_config(config, tmp_path / "x.toml")
    assert load_config(tmp_path / "x.toml") == config


@pytest.mark.parametrize("rate", [1e-3, 3e-4, 1e-12, 1 / 3, 12345678.9, 2.0])
def test_numbers_survive_the_file_to_the_last_bit(rate, tmp_path):
    config = replace(Config(), training=replace(Config().training, learning_rate=rate, epochs=rate, refresh=0))
    save_config(config, tmp_path / "x.toml")
    assert load_config(tmp_path / "x.toml") == config


def test_a_saved_file_names_every_setting(tmp_path):
    save_config(Config(), tmp_path / "x.toml")
    text = (tmp_path / "x.toml").read_text()

    def names(table):
        return [name for key, value in table.items() for name in (names(value) if isinstance(value, dict) else [key])]

    for name in names(config_to_dict(Config())):
        assert f"\n{name} = " in f"\n{text}" or f"\n# {name} is not set" in text


def test_dictionaries_are_undone(tmp_path):
    config = replace(Config(), source="a.glb", images=ImageConfig(resolution=96))
    table = {key: value for key, value in config_to_dict(config).items() if value is not None}
    for section in table.values():
        if isinstance(section, dict):
            for key in [key for key, value in section.items() if value is None]:
                del section[key]
    assert config_from_dict(table) == config


def test_whole_numbers_may_stand_for_fractions(tmp_path):
    rate = load_text(tmp_path, "[training]\nlearning_rate = 1").training.learning_rate
    assert rate == 1.0
    assert type(rate) is float


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[training]\nstesp = 5", "unknown key training.stesp; did you mean training.steps?"),
        ("[trainig]\nsteps = 5", "unknown key trainig; did you mean training?"),
        ("sorce = 'x'", "unknown key sorce; did you mean source?"),
        ("batch_size = 5", "unknown key batch_size; did you mean bpnet.batch_size or training.batch_size?"),
        ("[images]\nlayers = 5", "unknown key images.layers; "),
        ("qqqqqq = 5", "unknown key qqqqqq; see `reenact train --help` for all keys"),
        ("training = 5", "training: expected a section [training], got the whole number 5"),
        ("[training]\nsteps = 2.0", "training.steps: expected a whole number, got the number 2.0"),
        ("[training]\nsteps = true", "training.steps: expected a whole number, got true"),
        ("[training]\nsteps = '7'", 'training.steps: expected a whole number, got the text "7"'),
        ("[training]\nsteps = [7]", "training.steps: expected a whole number, got the list [7]"),
        ("[training.steps]\na = 1", "training.steps: expected a whole number, got the section"),
        ("[images]\nresidual = 1", "images.residual: expected true or false, got the whole number 1"),
        ("source = 1979-05-27", "source: expected text, got the date"),
        ("run = 3", "run: expected text, got the whole number 3"),
        ("[training]\nepochs = 'two'", 'training.epochs: expected a number, got the text "two"'),
        ("[training]\nlearning_rate = " + "9" * 400, "training.learning_rate: expected a number, got the whole"),
        ("[training]\nschedule = 'cosine'", 'training.schedule: expected "one-cycle" or "constant", got the text "cos'),
        ("[training]\nschedule = [1]", "training.schedule: expected"),
        ("[images]\nresolution = 72", "images.resolution: expected a multiple of 16, from 16 to 1024, got 72"),
        ("[training]\nsteps = 0", "training.steps: expected a whole number of at least 1, got 0"),
        ("[training]\nlearning_rate = 0.0", "training.learning_rate: expected a number above 0, got 0.0"),
        ("[training]\nlearning_rate = nan", "training.learning_rate: expected a finite number, got nan"),
        ("[training]\nseed = -1", "training.seed: expected a whole number from 0 to 2^63 - 1, got -1"),
        ("[bpnet]\ndecoded_fraction = 1.5", "bpnet.decoded_fraction: expected a number from 0 to 1, got 1.5"),
        ("[bpnet]\nchannels = 12", "bpnet.channels: expected a multiple of 8, got 12"),
        ("[reenactnet]\nkernel = 4", "reenactnet.kernel: expected an odd number from 3 to 15, got 4"),
        ("[training]\nepochs = 3", "training.epochs: expected training.refresh = 0 beside it, got 2500"),
        ("[bpnet]\nepochs = 3", "bpnet.epochs: expected training.refresh = 0 beside it, got 2500"),
        (
            '[images]\nmotion = false\n[pairs]\nmethod = "pictures"',
            'pairs.method: expected images.motion beside "pictures", got none',
        ),
        ("[images]\nresidual = false", "images.motion: expected images.residual beside it, got none"),
        ("[training]\nframes = 7", "training.frames: expected a whole number from 8 to 1,000,000, got 7"),
        ("[bpnet]\nweight_loss = 0\nimage_loss = 0\nvertex_loss = 0", "bpnet: expected a loss above 0"),
        ("source = ''", "source: expected a name or path in Unicode, got ''"),
        ("x =", "expected TOML, got something else"),
        ("x = " + "1" * 5000, "expected TOML, got something else"),
        ("x = " + "[" * 5000, "expected TOML, got something else"),
    ],
)
def test_a_mistake_is_named_with_its_file_and_key(text, sentence, tmp_path):
    with pytest.raises(ReenactError) as caught:
        load_text(tmp_path, text)
    assert str(caught.value).startswith(f"{tmp_path / 'x.toml'}: {sentence}")


def test_bytes_that_are_not_text_are_refused(tmp_path):
    (tmp_path / "x.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ReenactError, match=r"x\.toml: expected TOML"):
        load_config(tmp_path / "x.toml")


def test_a_path_that_is_not_unicode_is_refused_before_it_is_written():
    with pytest.raises(ReenactError, match="run: expected a name or path in Unicode"):
        check_config(replace(Config(), run=os.fsdecode(b"\xff")))


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.toml: there is no such settings file"):
        load_config(tmp_path / "none.toml")


def test_changed_settings_are_named_with_their_section():
    new = replace(Config(), run="r", training=replace(Config().training, steps=1))
    assert list(changed_settings(Config(), new)) == ["run", "training.steps"]


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(call, tmp_path, monkeypatch):
    path = tmp_path / "x"
    path.write_bytes(b"old")

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, call, fail)
    with pytest.raises(OSError, match="No space left"):
        write_atomically(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_may_have_the_longest_name_that_a_disk_takes(tmp_path):
    path = tmp_path / ("x" * 251 + ".csv")
    write_atomically(path, b"new")
    assert path.read_bytes() == b"new"
