import csv
import json
from pathlib import Path

import numpy as np
import pytest

from envs import export_levelx
from envs.drivers.ego import idle_action
from envs.export_levelx import RECORDING_META, TRACKS, TRACKS_META, ExportConfig, export, export_env
from envs.readers.highway import HighwayReader
from envs.registry import make_env
from predictor.data.levelx import LevelxConfig, load
from tests.envs.helpers import run_command

SEED = 5
STEPS = 4


@pytest.mark.slow
@pytest.mark.parametrize("env_id", ["roundabout-v1", "intersection-v2"])
def test_what_the_loader_reads_is_what_the_simulator_did(env_id: str, tmp_path: Path):
    """At every policy step (1 s, five steps of the store) against a second simulation that is read directly."""
    frames = export(ExportConfig(env_id, tmp_path / "export", 1, "idle", SEED, STEPS))
    assert frames == 25 * STEPS + 1
    _, (episode,), _, files = load(LevelxConfig(tmp_path / "export", tmp_path / "store"))
    assert len(files) == 3
    assert (episode.label, len(episode.states)) == ("0/00", 5 * STEPS + 1)
    env = export_env(env_id)
    env.reset(seed=SEED)
    reader = HighwayReader(env)
    compared = 0
    for t in range(STEPS + 1):
        truth = reader.read_all(env)
        column = {int(agent): i for i, agent in enumerate(episode.ids)}
        # Vehicles that the environment adds or removes at the end of a policy step are a frame early or late.
        for agent, state in zip(truth.ids.tolist(), truth.states, strict=True):
            if agent in column and episode.valid[5 * t, column[agent]]:
                np.testing.assert_allclose(episode.states[5 * t, column[agent], :4], state, rtol=1e-5, atol=1e-4)
                compared += 1
        assert episode.valid[5 * t, column[0]]  # the ego
        heading = episode.states[5 * t, column[0], 4:6]
        np.testing.assert_allclose(heading, [np.cos(truth.heading_rad), np.sin(truth.heading_rad)], atol=1e-5)
        env.step(idle_action(env))
    assert compared >= 4 * (STEPS + 1)


def read(path: Path) -> list[dict[str, str]]:
    with path.open() as file:
        return list(csv.DictReader(file))


@pytest.mark.slow
def test_the_three_files_agree(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    out = tmp_path / "export"
    arguments = ["--env-id", "intersection-v2", "--out", str(out), "--episodes", "2", "--max-steps", "3"]
    code, errors, output = run_command(export_levelx.main, arguments, monkeypatch, capsys)
    assert (code, errors) == (0, [])
    assert "2 recordings, 152 frames at 25 Hz" in output
    assert [p.name for p in tmp_path.iterdir()] == ["export"]
    files = [f"{name}_{kind}.csv" for name in ("00", "01") for kind in ("recordingMeta", "tracks", "tracksMeta")]
    assert sorted(p.name for p in out.iterdir()) == [*files, "export.json"]
    assert json.loads((out / "export.json").read_text())["env_id"] == "intersection-v2"
    tracks, meta = read(out / "01_tracks.csv"), read(out / "01_tracksMeta.csv")
    (recording,) = read(out / "01_recordingMeta.csv")
    assert (list(tracks[0]), list(meta[0]), list(recording)) == (TRACKS, TRACKS_META, RECORDING_META)
    assert (recording["recordingId"], recording["frameRate"], recording["duration"]) == ("1", "25", "3.04")
    assert int(recording["numTracks"]) == len(meta)
    assert "-0.00000" not in (out / "01_tracks.csv").read_text()
    for line in meta:
        own = [t for t in tracks if t["trackId"] == line["trackId"]]
        numbers = [int(t["frame"]) for t in own]
        assert (numbers[0], numbers[-1], len(own)) == tuple(int(line[k]) for k in TRACKS_META[2:5])
        assert [int(t["trackLifetime"]) for t in own] == list(range(len(own)))
        assert line["class"] == "car"
    for line in tracks:
        values = {name: float(line[name]) for name in TRACKS}
        heading = np.radians(values["heading"])
        along, across = np.array([np.cos(heading), np.sin(heading)]), np.array([-np.sin(heading), np.cos(heading)])
        for kind in ("Velocity", "Acceleration"):
            vector = np.array([values[f"x{kind}"], values[f"y{kind}"]])
            np.testing.assert_allclose(vector @ along, values[f"lon{kind}"], atol=1e-3)
            np.testing.assert_allclose(vector @ across, values[f"lat{kind}"], atol=1e-3)
        assert 0 <= values["heading"] <= 360


def test_accelerations_are_backward_differences(tmp_path: Path):
    export(ExportConfig("intersection-v2", tmp_path / "export", 1, "idle", SEED, 2))
    lines = [r for r in read(tmp_path / "export" / "00_tracks.csv") if r["trackId"] == "0"]
    for axis in "xy":
        velocity = np.array([float(r[f"{axis}Velocity"]) for r in lines])
        acceleration = np.array([float(r[f"{axis}Acceleration"]) for r in lines])
        assert acceleration[0] == 0.0
        np.testing.assert_allclose(acceleration[1:], np.diff(velocity) * 25, atol=1e-3)


def test_an_export_depends_on_its_seed_alone(tmp_path: Path):
    export(ExportConfig("roundabout-v1", tmp_path / "two", 2, "varied", 7, 2))
    export(ExportConfig("roundabout-v1", tmp_path / "one", 1, "varied", 8, 2))
    second, alone = (read(tmp_path / name) for name in ("two/01_tracks.csv", "one/00_tracks.csv"))
    assert [{**line, "recordingId": ""} for line in second] == [{**line, "recordingId": ""} for line in alone]


def test_policy_steps_stay_as_long_as_they_are():
    for env_id in ("roundabout-v1", "racetrack-v1"):
        config = export_env(env_id).unwrapped.config
        assert config["simulation_frequency"] == 25
        assert config["policy_frequency"] == make_env(env_id).unwrapped.config["policy_frequency"]


ERRORS = {
    "unknown-id": (["--env-id", "nope-v0"], "cannot make env 'nope-v0'"),
    "another-family": (["--env-id", "CartPole-v1"], "exports need a highway-env environment, got CartPoleEnv"),
    "zero-episodes": (["--episodes", "0"], "episodes must be at least 1, got 0"),
    "zero-steps": (["--max-steps", "0"], "max_steps must be at least 1, got 0"),
    "negative-seed": (["--seed", "-1"], "seed must not be negative, got -1"),
    "unknown-ego": (["--driver", "reckless"], "driver must be one of random, idle,"),
}


@pytest.mark.parametrize("case", ERRORS)
def test_bad_input_is_one_line_and_leaves_nothing(
    case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
):
    arguments, message = ERRORS[case]
    base = ["--env-id", "roundabout-v1", "--out", str(tmp_path / "export")]
    code, errors, output = run_command(export_levelx.main, [*base, *arguments], monkeypatch, capsys)
    assert (code, len(errors), output) == (2, 1, "")
    assert errors[0].startswith(f"error: {message}")
    assert list(tmp_path.iterdir()) == []


def test_a_crash_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def broken(*arguments: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(export_levelx, "write_json", broken)
    with pytest.raises(OSError, match="disk full"):
        export(ExportConfig("roundabout-v1", tmp_path / "export", 1, "idle", 0, 1))
    assert list(tmp_path.iterdir()) == []


def test_what_is_in_the_way_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture):
    out = tmp_path / "export"
    out.mkdir()
    (out / "mine.txt").write_text("keep")
    arguments = ["--env-id", "roundabout-v1", "--out", str(out), "--episodes", "1", "--max-steps", "1"]
    for extra, message in (
        ([], f"{out} exists; choose another path or pass --overwrite"),
        (["--overwrite"], f"{out} is not an export and will not be replaced; choose another path"),
    ):
        assert run_command(export_levelx.main, arguments + extra, monkeypatch, capsys)[:2] == (2, [f"error: {message}"])
    assert [p.name for p in out.iterdir()] == ["mine.txt"]
    (out / "mine.txt").rename(out / "export.json")
    assert run_command(export_levelx.main, [*arguments, "--overwrite"], monkeypatch, capsys)[0] == 0
    assert (out / "00_tracks.csv").exists()
