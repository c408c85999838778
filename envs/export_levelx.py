"""Writes rollouts in levelXData's CSV layout: `python -m envs.export_levelx --env-id roundabout-v1 --out exported`.

One episode becomes one recording XX of inD's layout (`XX_tracks.csv`, `XX_tracksMeta.csv`, `XX_recordingMeta.csv`), at
25 frames per second: the simulation runs at that rate and every simulated frame is written, however long a policy step
is. `python -m predictor.data.levelx` reads it like the licensed datasets. Coordinates, headings and axes are the
simulator's own. Accelerations are backward differences of the velocity, zero in a vehicle's first frame.
"""

import csv
from collections.abc import Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from jaxtyping import Float

from envs.drivers.ego import EGO_DRIVER_NAMES, make_ego_driver
from envs.drivers.planner import PLANNER
from envs.readers.highway import HighwayReader, is_highway_env, vehicles_of
from envs.registry import make_env
from envs.seeding import driver_rng
from predictor.data.store import Episode
from predictor.support.command_line import parse
from predictor.support.config_checks import check_at_least, check_choice
from predictor.support.errors import UserError, run_entry_point
from predictor.support.files import check_out, new_folder, write_json
from predictor.support.progress import track
from predictor.support.provenance import provenance

FRAMES_PER_S = 25
"""Frame rate of the datasets [Hz]."""
TRACKS = (
    "recordingId,trackId,frame,trackLifetime,xCenter,yCenter,heading,width,length,xVelocity,yVelocity,"
    "xAcceleration,yAcceleration,lonVelocity,latVelocity,lonAcceleration,latAcceleration"
).split(",")
TRACKS_META = "recordingId,trackId,initialFrame,finalFrame,numFrames,width,length,class".split(",")
RECORDING_META = (
    "recordingId,locationId,frameRate,speedLimit,weekday,startTime,duration,numTracks,numVehicles,numVRUs,"
    "latLocation,lonLocation,xUtmOrigin,yUtmOrigin,orthoPxToMeter"
).split(",")


@dataclass(frozen=True)
class ExportConfig:
    """Writes highway-env rollouts in levelXData's CSV layout."""

    env_id: str
    """Environment to record: gymnasium id of a highway-env environment, for example roundabout-v1."""
    out: Path
    """Folder of the new recordings."""
    episodes: int = 10
    """Number of episodes; each becomes a recording."""
    driver: str = "varied"
    """Driver of the ego: random, idle, varied, keep-lane."""
    seed: int = 0
    """Random seed: episode i is reset with seed + i."""
    max_steps: int = 200
    """Largest length of an episode; longer ones are cut there [policy steps]."""
    overwrite: bool = False
    """Whether to replace an existing export."""

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value out of range, or another driver.
        """
        check_at_least(self, 1, "episodes", "max_steps")
        check_at_least(self, 0, "seed")
        # a policy's wrapper would not see every frame, and the planner not every step
        check_choice("driver", self.driver, tuple(name for name in EGO_DRIVER_NAMES if name != PLANNER))

    def check_out(self) -> None:
        """Checks that `out` is free, or an export that may be replaced.

        Raises:
            UserError: it is neither.
        """
        check_out(self.out)
        if self.out.exists() and not self.overwrite:
            raise UserError(f"{self.out} exists; choose another path or pass --overwrite")
        if self.out.exists() and not (self.out / "export.json").exists():
            raise UserError(f"{self.out} is not an export and will not be replaced; choose another path")


def export_env(env_id: str) -> gym.Env:
    """Makes the environment, simulated at the datasets' frame rate; the length of a policy step does not change.

    Raises:
        UserError: not a highway-env environment, or policy steps that are not whole frames.
    """
    with closing(make_env(env_id, disable_env_checker=True)) as env:
        if not is_highway_env(env):
            raise UserError(f"exports need a highway-env environment, got {env.unwrapped.__class__.__name__}")
        policy_hz = env.unwrapped.config["policy_frequency"]  # type: ignore[attr-defined]
    if FRAMES_PER_S % policy_hz:
        raise UserError(
            f"policy steps must be whole frames of 1/{FRAMES_PER_S} s, but '{env_id}' has {policy_hz} per s"
        )
    return make_env(env_id, disable_env_checker=True, config={"simulation_frequency": FRAMES_PER_S})


def roll_out(
    env: gym.Env, ego_name: str, seed: int, max_steps: int
) -> tuple[Episode, Float[np.ndarray, "time agents"]]:
    """Plays one episode; returns all simulated frames and all headings [rad], zeros where an agent is absent."""
    reader = HighwayReader(env)
    obs: Any
    obs, _ = env.reset(seed=seed)
    ego = make_ego_driver(ego_name, env, driver_rng(seed))
    road: Any = env.unwrapped.road  # type: ignore[attr-defined]
    scenes, headings = [reader.read_all(env)], [_headings_rad(env)]
    advance = road.step

    def advance_and_record(dt: float) -> None:
        advance(dt)
        scenes.append(reader.read_all(env))
        headings.append(_headings_rad(env))

    road.step = advance_and_record
    for _ in range(max_steps):
        obs, _, terminated, truncated, _ = env.step(ego(obs))
        if terminated or truncated:
            break
    episode = Episode.from_scenes(scenes, label=ego_name, seed=seed)
    heading_rad = np.zeros(episode.valid.shape)
    column = {int(agent): i for i, agent in enumerate(episode.ids)}
    for t, (scene, values) in enumerate(zip(scenes, headings, strict=True)):
        heading_rad[t, [column[int(agent)] for agent in scene.ids]] = values
    return episode, heading_rad


def _headings_rad(env: gym.Env) -> list[float]:
    """Returns headings in the order of `HighwayReader.read_all`."""
    return [float(vehicle.heading) for vehicle in vehicles_of(env)]


def write_recording(
    folder: Path,
    number: int,
    episode: Episode,
    heading_rad: Float[np.ndarray, "time agents"],
    size_m: tuple[float, float],
) -> None:
    """Writes the three files of one recording.

    Args:
        folder: folder of the files.
        number: recording id.
        episode: all simulated frames.
        heading_rad: headings, zeros where absent.
        size_m: length and width of every vehicle.
    """
    length_m, width_m = (f"{size:.3f}" for size in size_m)
    tracks, meta = [], []
    for column, agent in enumerate(episode.ids.tolist()):
        frames = np.flatnonzero(episode.valid[:, column])
        states = episode.states[frames, column].astype(np.float64)
        motion = _motion(states, heading_rad[frames, column], frames)
        for frame, state, values in zip(frames.tolist(), states, motion, strict=True):
            numbers = [f"{v:z.5f}" for v in (*state[:2], values[0])]
            rest = [f"{v:z.5f}" for v in (*state[2:], *values[1:])]
            tracks.append([number, agent, frame, frame - int(frames[0]), *numbers, width_m, length_m, *rest])
        meta.append([number, agent, frames[0], frames[-1], len(frames), width_m, length_m, "car"])
    seconds = f"{len(episode.states) / FRAMES_PER_S:.2f}"
    recording = [number, 0, FRAMES_PER_S, -1, "monday", 0, seconds, len(meta), len(meta), 0, 0, 0, 0, 0, 1]
    _write_csv(folder / f"{number:02d}_tracks.csv", TRACKS, tracks)
    _write_csv(folder / f"{number:02d}_tracksMeta.csv", TRACKS_META, meta)
    _write_csv(folder / f"{number:02d}_recordingMeta.csv", RECORDING_META, [recording])


def _motion(
    states: Float[np.ndarray, "frames 4"], heading_rad: Float[np.ndarray, " frames"], frames: np.ndarray
) -> Float[np.ndarray, "frames 7"]:
    """Returns heading [deg], acceleration on both axes, velocity and acceleration along and across the heading."""
    velocity = states[:, 2:]
    acceleration = np.zeros_like(velocity)
    acceleration[1:] = np.diff(velocity, axis=0) / (np.diff(frames) / FRAMES_PER_S)[:, None]
    along = np.stack([np.cos(heading_rad), np.sin(heading_rad)], axis=-1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    projected = [(vector * axis).sum(axis=-1) for vector in (velocity, acceleration) for axis in (along, across)]
    return np.stack([np.degrees(heading_rad) % 360, *acceleration.T, *projected], axis=-1)


def _write_csv(path: Path, header: Sequence[str], lines: Iterable[Sequence[Any]]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(lines)


def export(config: ExportConfig) -> int:
    """Writes all recordings; nothing appears under `out` until they are complete.

    Returns:
        Number of frames.

    Raises:
        UserError: the environment or the driver does not fit, or `out` exists.
    """
    config.check_out()
    frames = 0
    with closing(export_env(config.env_id)) as env, new_folder(config.out) as partial:
        make_ego_driver(config.driver, env, np.random.default_rng(0))
        for i in track(range(config.episodes), f"export {config.env_id}"):
            episode, heading_rad = roll_out(env, config.driver, config.seed + i, config.max_steps)
            ego: Any = env.unwrapped.vehicle  # type: ignore[attr-defined]
            write_recording(partial, i, episode, heading_rad, (ego.LENGTH, ego.WIDTH))
            frames += len(episode.states)
        made = provenance(("highway-env", "gymnasium", "numpy"))
        write_json(partial / "export.json", {"env_id": config.env_id, "seed": config.seed, "provenance": made})
    return frames


def main() -> None:
    """Entry point."""
    config = parse(ExportConfig, __doc__)
    frames = export(config)
    print(f"{config.out}: {config.episodes} recordings, {frames} frames at {FRAMES_PER_S} Hz")


if __name__ == "__main__":
    run_entry_point(main)
