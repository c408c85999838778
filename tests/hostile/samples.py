"""Good samples of every kind of file that is read, small ones, and the loader of each."""

import dataclasses
import json
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from agents.preset_settings import changed, settings_from_file
from agents.presets import PRESETS
from agents.results import read_evaluation
from agents.runs import read_config
from agents.studies.plan import read_study
from agents.studies.results import Result, read_result, write_result
from agents.task import task_of
from agents.training import read_curve
from agents.tune import TuneConfig, _check_folder, _settings_of_tuning, open_study
from envs.sb3.policy_file import algorithm_of, read_note, read_policy_note
from predictor.checkpoint import CheckpointInfo, load_checkpoint, save_checkpoint
from predictor.data.levelx_files import open_recording, read_tracks
from predictor.data.mocap_files import read_motion, read_skeleton
from predictor.data.nba import read_score, read_sportvu
from predictor.data.sdd import SddConfig, read_annotations, read_scales
from predictor.data.store import read_info_of, read_store
from predictor.data.track_points import cut_episodes
from predictor.data.tracks import TracksConfig, points_of, read_recording
from predictor.evaluation.in_env_record import read_record
from predictor.reports.run_blocks import accuracy
from predictor.support.files import write_json
from predictor.train import _check_run_folder, _comparable
from predictor.training.config import TrainConfig
from predictor.training.curve import read_curve as errors_of
from predictor.training.trainer import Trainer
from predictor.training.training_data import load_data
from tests.hostile import texts
from tests.predictor.helpers import PLURAL, model, spec, write_circles


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of file."""

    file: str
    """Path of the file, in the folder of the sample."""
    make: Callable[[Path], None]
    """Writes a good sample into an empty folder."""
    load: Callable[[Path], Any]
    """Loads the sample from the folder."""


def _checkpoint(folder: Path) -> None:
    torch.manual_seed(0)
    config = dataclasses.replace(PLURAL, delta_scales=(0.5,) * 4, input_scales=(9.0,) * 4)
    network = type(model())(spec(), config, 3)
    save_checkpoint(folder / "made", network, CheckpointInfo(spec(), config, 3, (0.1, 0.2, 0.3), ("highway-v0",)))
    for file in (folder / "made").iterdir():
        file.rename(folder / file.name)
    (folder / "made").rmdir()


def _small(folder: Path) -> TrainConfig:
    sizes = ("hidden_dim=4", "rnn_dim=3", "head_dim=4", "message_dim=4", "decoder_dim=4", "num_modes=2")
    return TrainConfig(
        (folder / "data",), folder / "run", set=sizes, steps=4, batch_size=2, history_steps=3, horizon_steps=2,
        val_windows=4, resume=True,
    )  # fmt: skip


def _trainer(folder: Path) -> Trainer:
    return Trainer(_small(folder), load_data(_small(folder)))


def _train_state(folder: Path) -> None:
    write_circles(folder / "data")
    trainer = _trainer(folder)
    (folder / "run").mkdir()
    trainer.save(folder / "run" / "train_state.pt")
    trainer.close()


def _restore(folder: Path) -> None:
    trainer = _trainer(folder)
    try:
        trainer.restore(folder / "run" / "train_state.pt")
    finally:
        trainer.close()


def _predictor_run(folder: Path) -> None:
    content = {"config": _comparable(_small(Path("zoo"))), "stores": {}, "provenance": {}}
    write_json(folder / "run" / "config.json", content)


RUN = {
    "env_id": "highway-fast-v0", "observe": "forecast", "checkpoint": None, "algorithm": "ppo", "learners": [],
    "partner": "heuristic", "num_samples": 1, "horizon_steps": None, "perception_m": None, "what_if": False,
    "env_kwargs": "", "seed": 0, "steps": 100,
}  # fmt: skip
PIN = {
    "checkpoint": "highway", "sha256": "0" * 64, "horizon_steps": 5, "num_samples": 1, "max_agents": 12,
    "perception_m": 100.0, "arm": "forecast", "num_plans": 0, "layout": None,
}  # fmt: skip
TUNING = {"config": _settings_of_tuning(TuneConfig()), "provenance": []}
POINT = {"steps": 10, "return": 1.0, "episodes": 2, "seconds": 1.0}
VALIDATED = {
    "step": 4, "energy_m": 1.0, "ade_m": 2.0, "fde_m": 3.0, "min_ade_m": 1.5, "min_joint_ade_m": 1.7,
    "constant_velocity_ade_m": 4.0,
}  # fmt: skip
EPISODE = {"seed": 1, "episode_return": 2.0, "length": 3, "crashed": None, "mean_speed_mps": None}
SUMMARY = {"env_id": "highway-v0", "first_seed": 1, "has_ego": True, "episodes": {"ppo": [EPISODE]}}
LINE = {"name": "x", "num_samples": 6, "ade_m": 0.5, "fde_m": 1.0, "min_ade_m": 0.25, "agents": 12}
ACCURACY = {"env_id": "x", "driver": "idle", "model": LINE, "model_samples": LINE, "constant_velocity": LINE}
MEASURED = {"env_id": "highway-v0", "driver": "idle", "episodes": 3, "samples": 6, "command": "c", "commit": "x"}


def _policy(folder: Path) -> None:
    note = {"policy": {"forecaster": PIN, "learners": [], "driver": "heuristic"}, "selection": 1}
    with zipfile.ZipFile(folder / "policy.zip", "w") as archive:
        archive.writestr("data", json.dumps({"clip_range": 0.2}))
        archive.writestr("note.json", json.dumps(note))


def _load_policy_notes(folder: Path) -> Any:
    path = folder / "policy.zip"
    return algorithm_of(path), read_policy_note(path), read_note(path)


def _load_preset(folder: Path) -> Any:
    return changed(PRESETS["ppo"], settings_from_file("ppo", folder / "mine.toml"), "mine.toml")


def _study(folder: Path) -> Any:
    return open_study(folder / "tuning.db")


def void(_: Any) -> None:
    """Drops a result."""


def _tracks(folder: Path) -> Any:
    config = TracksConfig(folder, folder / "out")
    counts: Counter[str] = Counter()
    points = points_of(read_recording(folder / "walk.txt", config, counts), 10, config, counts)
    return cut_episodes(points, config.episode_steps, "walk", counts)


def _annotations(folder: Path) -> Any:
    config = SddConfig(folder, folder / "out")
    points = read_annotations(folder / "annotations.txt", 0.5, config, Counter())
    return cut_episodes(points, config.episode_steps, "quad", Counter())


def _levelx(folder: Path) -> Any:
    recording = open_recording(folder / "00_tracks.csv")
    return cut_episodes(read_tracks(recording, "full", 5), 50, "00", Counter())


def _amc(folder: Path) -> Any:
    return read_motion(folder / "walk.amc", read_skeleton(folder / "man.asf"))


def _written(**files: str) -> Callable[[Path], None]:
    def make(folder: Path) -> None:
        for name, text in files.items():
            (folder / name.replace("__", ".")).write_text(text)

    return make


def _json(name: str, content: Any) -> Callable[[Path], None]:
    return lambda folder: write_json(folder / name, content)


_MOCAP = _written(man__asf=texts.ASF, walk__amc=texts.AMC)
_LEVELX = _written(**{
    "00_tracks__csv": texts.TRACKS_CSV, "00_tracksMeta__csv": texts.TRACKS_META_CSV,
    "00_recordingMeta__csv": texts.RECORDING_META_CSV,
})  # fmt: skip

KINDS: dict[str, Kind] = {
    "checkpoint": Kind("config.json", _checkpoint, load_checkpoint),
    "weights": Kind("model.safetensors", _checkpoint, load_checkpoint),
    "store": Kind("data/zarr.json", lambda f: _store(f), lambda f: read_store(f / "data")),
    "store info": Kind("data/zarr.json", lambda f: _store(f), lambda f: read_info_of(f / "data")),
    "array": Kind("data/states/zarr.json", lambda f: _store(f), lambda f: read_store(f / "data")),
    "chunk": Kind("data/states/c/0/0/0", lambda f: _store(f), lambda f: read_store(f / "data")),
    "predictor run": Kind("run/config.json", _predictor_run, lambda f: _resume(f)),
    "training state": Kind("run/train_state.pt", _train_state, _restore),
    "policy run": Kind("config.json", lambda f: _policy_run(f), lambda f: task_of(read_config(f, "algorithm"))),
    "curve": Kind("curve.json", _json("curve.json", [POINT]), lambda f: read_curve(f / "curve.json")),
    "predictor's curve": Kind("curve.json", _json("curve.json", [VALIDATED]), lambda f: errors_of(f / "curve.json")),
    "summary": Kind("summary.json", _json("summary.json", SUMMARY), lambda f: read_evaluation(f / "summary.json")),
    "accuracy": Kind("accuracy.json", _json("accuracy.json", {"results": [ACCURACY]}), lambda f: accuracy([f])),
    "result": Kind("result.json", lambda f: _result(f), lambda f: read_result(f / "result.json")),
    "study": Kind("mine.toml", _written(mine__toml=texts.STUDY), lambda f: read_study(f / "mine.toml")),
    "preset": Kind("mine.toml", _written(mine__toml="learning_rate = 3e-4\n"), _load_preset),
    "tuning": Kind("tuning.json", _json("tuning.json", TUNING), lambda f: _check_folder(f, TuneConfig())),
    "tuning study": Kind("tuning.db", lambda f: void(_study(f)), lambda f: _study(f)),
    "policy": Kind("policy.zip", _policy, _load_policy_notes),
    "record": Kind("in_env.json", _json("in_env.json", {"measurements": [MEASURED]}), read_record),
    "tracks": Kind("walk.txt", _written(walk__txt=texts.TRACKS), _tracks),
    "annotations": Kind("annotations.txt", _written(annotations__txt=texts.ANNOTATIONS), _annotations),
    "scales": Kind("scales.yaml", _written(scales__yaml=texts.SCALES), lambda f: read_scales(f / "scales.yaml")),
    "score": Kind("game.txt", _written(game__txt=texts.SCORE), lambda f: read_score(f / "game.txt")),
    "sportvu": Kind("game.json", _written(game__json=texts.SPORTVU), lambda f: read_sportvu(f / "game.json")),
    "skeleton": Kind("man.asf", _MOCAP, _amc),
    "motion": Kind("walk.amc", _MOCAP, _amc),
    "levelx tracks": Kind("00_tracks.csv", _LEVELX, _levelx),
    "levelx meta": Kind("00_tracksMeta.csv", _LEVELX, _levelx),
    "levelx recording": Kind("00_recordingMeta.csv", _LEVELX, _levelx),
}  # fmt: skip
"""Every kind of file that comes from outside."""


def _resume(folder: Path) -> None:
    _check_run_folder(_small(Path("zoo")), folder / "run" / "config.json")


def _policy_run(folder: Path) -> None:
    write_json(folder / "config.json", {"config": RUN, "provenance": []})


def _store(folder: Path) -> None:
    write_circles(folder / "data")


def _result(folder: Path) -> None:
    episode = {"seed": 1, "episode_return": 2.0}
    result = Result("road", "highway-v0", "forecast", "ppo", 0, (episode,), (POINT,), 1.0, 1.0, {"command": "c"})
    write_result(folder / "result.json", result)
