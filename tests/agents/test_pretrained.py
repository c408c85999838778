"""Policies that ship: each loads by its name, drives its environment, and is small."""

from pathlib import Path

import pytest

from agents.policy import load_policy
from agents.runs import SHIPPED, policy_zip, shipped_policies
from agents.watch import WatchConfig, write_film
from envs.sb3.policy_file import read_policy_note
from predictor.checkpoint import shipped
from predictor.support.errors import UserError

ENVS = {
    "highway-fast": "highway-fast-v0",
    "intersection": "intersection-v2",
    "roundabout": "roundabout-v1",
    "simple-tag": "simple_tag_v3",
}


def test_policies_of_four_environments_ship():
    assert shipped_policies() == sorted(ENVS)
    card = (SHIPPED / "README.md").read_text()
    for name in ENVS:
        assert (SHIPPED / f"{name}.zip").stat().st_size < 2_000_000
        assert f"| `{name}` |" in card


@pytest.mark.parametrize("name", sorted(ENVS))
def test_a_shipped_policy_drives(name: str):
    note = read_policy_note(policy_zip(name))
    assert note is not None and note.env_id == ENVS[name]
    assert note.forecaster is not None and note.forecaster.checkpoint in shipped(), "nobody else has other forecasters"
    policy, env = load_policy(name)  # refuses other weights of the forecaster
    observation, _ = env.reset(seed=0)
    for _ in range(2):
        observation, *_ = env.step(policy(observation))
    env.close()


def test_a_run_folder_of_that_name_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "highway-fast").mkdir()
    with pytest.raises(UserError, match="highway-fast holds no training run"):
        load_policy("highway-fast")


@pytest.mark.slow
def test_its_film_is_no_part_of_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    assert write_film(WatchConfig(Path("simple-tag"), seed=1, max_steps=2)) == Path("watch-1.mp4")
    assert (tmp_path / "watch-1.mp4").stat().st_size
