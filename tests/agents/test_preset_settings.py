from pathlib import Path
from typing import get_args

import pytest

from agents.preset_settings import changed, settings_from_file, settings_from_words, write_preset
from agents.presets import PRESETS, Algorithm, PPOPreset, TQCPreset
from predictor.support.errors import UserError


def test_words_are_typed_by_the_preset():
    words = ("learning_rate=3e-4", "gamma=1", "net_arch=64,32", "n_steps=16", "gamma=0.5")
    settings = settings_from_words("ppo", words)
    assert settings == {"learning_rate": 3e-4, "gamma": 0.5, "net_arch": (64, 32), "n_steps": 16}
    assert type(settings_from_words("ppo", ["gamma=1"])["gamma"]) is float
    for text in ("ent_coef=auto", 'ent_coef="auto"'):
        assert settings_from_words("sac", [text]) == {"ent_coef": "auto"}
    assert settings_from_words("sac", ["ent_coef=0.1", "net_arch=[8]"]) == {"ent_coef": 0.1, "net_arch": (8,)}
    assert settings_from_words("dqn", []) == {}


@pytest.mark.parametrize("algorithm", get_args(Algorithm))
def test_a_written_preset_is_read_back(algorithm: Algorithm, tmp_path: Path):
    preset = changed(PRESETS[algorithm], {"learning_rate": 1.5e-5, "net_arch": (8, 4)}, "here")
    write_preset(tmp_path / "best.toml", preset, ["of a test", "with two lines"])
    assert (tmp_path / "best.toml").read_text().startswith("# of a test\n# with two lines\n")
    settings = settings_from_file(algorithm, tmp_path / "best.toml")
    assert changed(PRESETS[algorithm], settings, "here") == preset


def test_values_that_fit_together_only_are_taken_together():
    settings = settings_from_words("tqc", ["top_quantiles_to_drop_per_net=30", "n_quantiles=50"])
    assert changed(PRESETS["tqc"], settings, "here") == TQCPreset(n_quantiles=50, top_quantiles_to_drop_per_net=30)
    with pytest.raises(UserError, match="^here: batch_size must be at least 2, got 1$"):
        changed(PPOPreset(), {"batch_size": 1}, "here")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("gamma = ", "is not valid TOML: "),
        (f"learning_rate = 1{'0' * 400}", "integers have at most 19 digits (64 bits), got one of 1,329 bits"),
        ("gama = 0.9", "ppo has no hyperparameter 'gama'; there are learning_rate, gamma, net_arch, n_steps, "),
        ("[ppo]\ngamma = 0.9", "ppo has no hyperparameter 'ppo'; there are "),
        ('gamma = "high"', "gamma must be a number, got 'high'"),
        ("n_steps = true", "n_steps must be a whole number, got True"),
        ("net_arch = 64", "net_arch must be an array, got 64"),
    ],
)
def test_bad_files_are_one_clear_line(text: str, message: str, tmp_path: Path):
    file = tmp_path / "mine.toml"
    file.write_text(text)
    with pytest.raises(UserError) as error:
        settings_from_file("ppo", file)
    assert str(error.value).startswith(str(file)) and message in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(UserError, match=f"^no preset at {file}x; give a TOML file"):
        settings_from_file("ppo", Path(f"{file}x"))
    with pytest.raises(UserError, match=f"^{tmp_path} cannot be read: it is a folder"):
        settings_from_file("ppo", tmp_path)


def test_an_integer_too_long_for_a_number_is_one_line():
    with pytest.raises(UserError, match="gamma must be a number of at most 308 digits, got one of 401"):
        settings_from_words("ppo", ["gamma=1" + "0" * 400])


def test_a_second_line_of_a_word_is_refused():
    with pytest.raises(UserError, match=r"--set takes NAME=VALUE .*got 'gamma=0.9\\nlearning_rate=1'$"):
        settings_from_words("ppo", ["gamma=0.9\nlearning_rate=1"])
