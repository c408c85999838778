"""The protocol "NBA Score": which windows and agents count, what is observed, and what the errors are."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.data.nba import FEATURES, episodes_of, read_score, scene_spec
from predictor.data.store import Episode, EpisodeStore, StoreInfo
from predictor.data.windows import Windows
from predictor.evaluation.nba_protocol import (
    HISTORY_STEPS,
    HORIZON_STEPS,
    PlayerErrors,
    PlayerTally,
    drawn,
    fitted_noise,
    fitted_residual,
    player_outcomes,
    protocol_windows,
)
from predictor.forecaster import Belief, Forecaster, Futures, Memory
from predictor.noise import Noise
from predictor.support.errors import UserError
from tests.predictor.data.helpers import possession
from tests.predictor.helpers import circling_episode, spec

PLAYERS = list(range(11, 21))
FOOT_M = 0.3048
Feet = Callable[[int, int], tuple[float, float]]


def straight(entity: int, t: int) -> tuple[float, float]:
    """Players on straight lines; the ball jumps."""
    return (20.0 + 50 * (t % 2), 5.0) if entity == -1 else (entity + 0.5 * t, 40.0 - 0.25 * t)


def random_walk(seed: int, frames: int) -> np.ndarray:
    """Positions [ft] of ten players with random accelerations, frame by frame."""
    steps = np.random.default_rng(seed).normal(size=(frames, 10, 2), scale=0.2)
    return np.round(20 + np.cumsum(np.cumsum(steps, axis=0), axis=0), 6)


def store_of(tmp_path: Path, frames: Sequence[int], feet: Sequence[Feet]) -> EpisodeStore:
    """A store of whole possessions, through the files that are published."""
    episodes: list[Episode] = []
    for i, (count, where) in enumerate(zip(frames, feet, strict=True)):
        path = tmp_path / f"ATL_BKN_{i}_1_60.0_50.0.txt"
        path.write_text(possession(count, PLAYERS, where))
        episodes += episodes_of(read_score(path), 0)
    return EpisodeStore(StoreInfo(scene_spec(), "nba"), episodes)


def walks(tmp_path: Path, frames: Sequence[int]) -> tuple[Windows, list[np.ndarray]]:
    """Windows of random walks, and the walks [ft]."""
    given = [random_walk(i, count) for i, count in enumerate(frames)]

    def where(walk: np.ndarray) -> Feet:
        return lambda entity, t: (7.0 * t, 3.0) if entity == -1 else tuple(walk[t, entity - 11])

    return protocol_windows(store_of(tmp_path, frames, [where(w) for w in given]), Path("here")), given


def errors(forecaster: Forecaster, windows: Windows, num_samples: int = 1, batch_size: int = 4) -> PlayerErrors:
    tally = PlayerTally(len(windows.flat.steps))
    for possession_of, outcome in player_outcomes(
        forecaster, windows, np.arange(len(windows)), num_samples, batch_size=batch_size
    ):
        tally.add(possession_of, outcome)
    return tally.errors("it")


def test_without_a_player_nothing_is_perfect(tmp_path: Path):
    windows, _ = walks(tmp_path, (25,))
    tally = PlayerTally(1)
    for possession_of, outcome in player_outcomes(ConstantVelocity(windows.spec), windows, np.arange(2), 1):
        tally.add(possession_of, replace(outcome, valid=torch.zeros_like(outcome.valid)))
    found = tally.errors("it")
    assert found.forecasts == 0 and np.isnan([found.min_ade_ft, found.fde_ft, found.energy_ft]).all()


class Offset(ConstantVelocity):
    """Constant velocity plus a given offset of each sample, agent and step [ft] along x."""

    def __init__(self, offsets: Tensor) -> None:
        super().__init__(scene_spec(), HORIZON_STEPS)
        self.offsets = offsets

    def rollout(
        self, belief: Belief, horizon_steps: int, num_samples: int = 1, generator: Noise | None = None
    ) -> Futures:
        future = super().rollout(belief, horizon_steps, num_samples).states.clone()
        future[..., 0] += self.offsets * FOOT_M
        return Futures(future)


class Watching(ConstantVelocity):
    """Constant velocity that keeps what it observed."""

    def __init__(self) -> None:
        super().__init__(scene_spec(), HORIZON_STEPS)
        self.seen: list[Tensor] = []

    def observe(self, memory: Memory, states: Tensor, valid: Tensor) -> tuple[Memory, Belief]:
        assert valid.all()
        self.seen.append(states)
        return super().observe(memory, states, valid)


def test_every_stretch_of_twenty_frames_is_a_window_of_ten_forecasts(tmp_path: Path):
    """SocialVAE's loader: 10 · Σ max(frames − 19, 0), which is 592,640 for the lengths of the published test folder."""
    frames = (19, 20, 21, 27, 5)
    windows, _ = walks(tmp_path, frames)
    assert len(windows) == sum(max(0, count - 19) for count in frames) == 11
    assert errors(ConstantVelocity(windows.spec), windows).forecasts == 110
    assert (windows.index[:, 1] >= HISTORY_STEPS - 1).all()


def test_errors_equal_those_of_a_plain_loop_over_the_files(tmp_path: Path):
    windows, given = walks(tmp_path, (20, 31, 24))
    ade, fde = [], []
    for walk in given:
        for begin in range(len(walk) - 19):
            for player in range(10):
                window = walk[begin : begin + 20, player]
                predicted = window[7] + (window[7] - window[6]) * np.arange(1, 13)[:, None]
                distance = np.linalg.norm(predicted - window[8:], axis=-1)
                ade.append(distance.mean())
                fde.append(distance[-1])
    found = errors(ConstantVelocity(windows.spec), windows)
    assert found.forecasts == len(ade)
    assert (found.min_ade_ft, found.min_fde_ft) == pytest.approx((np.mean(ade), np.mean(fde)), rel=1e-4)
    assert (found.ade_ft, found.fde_ft) == (found.min_ade_ft, found.min_fde_ft)
    assert found.energy_ft == pytest.approx(found.ade_ft)
    assert found.coverage is None  # of one sample
    low, high = found.intervals["min_ade_ft"]
    assert low < found.min_ade_ft < high


def test_a_model_observes_the_eight_frames_of_the_window_and_no_others(tmp_path: Path):
    windows, given = walks(tmp_path, (23,))
    for i in range(4):
        watching = Watching()
        list(player_outcomes(watching, windows, np.array([i]), 1))
        assert len(watching.seen) == HISTORY_STEPS == 7
        states = torch.stack(watching.seen)[:, 0, 1:].double().numpy()  # the ball is agent 0
        feet = states / FOOT_M + np.array([47.0, 25.0, 0, 0, 0])
        np.testing.assert_allclose(feet[..., :2], given[0][i + 1 : i + 8], atol=1e-4)
        # the first frame is what the first velocity looks back to
        np.testing.assert_allclose(feet[0, :, :2] - 0.12 * feet[0, :, 2:4], given[0][i], atol=1e-4)
        np.testing.assert_allclose(0.12 * feet[:, :, 2:4], np.diff(given[0][i : i + 8], axis=0), atol=1e-4)


def test_the_ball_is_no_forecast(tmp_path: Path):
    windows = protocol_windows(store_of(tmp_path, (22,), (straight,)), Path("here"))
    found = errors(ConstantVelocity(windows.spec), windows)
    assert found.forecasts == 3 * 10
    assert found.min_ade_ft < 1e-4 and found.min_joint_fde_ft < 1e-4  # with the ball, tens of feet


def test_the_ball_is_found_by_its_mark_and_not_by_its_place(tmp_path: Path):
    store = store_of(tmp_path, (22,), (straight,))
    (episode,) = store.episodes
    turned = replace(episode, states=episode.states[:, ::-1].copy(), ids=episode.ids[::-1].copy())
    windows = protocol_windows(EpisodeStore(store.info, [turned]), Path("here"))
    assert errors(ConstantVelocity(windows.spec), windows).min_ade_ft < 1e-4


def test_best_mean_and_best_end_may_be_of_different_samples(tmp_path: Path):
    windows = protocol_windows(store_of(tmp_path, (22,), (straight,)), Path("here"))
    offsets = torch.zeros(3, 1, HORIZON_STEPS)
    offsets[0] = 8.0
    offsets[1] = 1.0
    offsets[2] = 6.0
    offsets[2, :, -1] = 0.0
    found = errors(Offset(offsets), windows, 3)
    assert found.num_samples == 3
    assert found.min_ade_ft == pytest.approx(1.0, abs=1e-4)
    assert found.min_fde_ft == pytest.approx(0.0, abs=1e-4)
    assert (found.ade_ft, found.fde_ft) == pytest.approx((8.0, 8.0), abs=1e-4)
    pairs = (7.0 * 12 + (11 * 2.0 + 8.0) + (11 * 5.0 + 1.0)) / 12
    assert found.energy_ft == pytest.approx((8.0 + 1.0 + 66 / 12) / 3 - pairs / 9, abs=1e-4)


def test_a_joint_sample_is_the_same_for_all_players(tmp_path: Path):
    windows = protocol_windows(store_of(tmp_path, (22,), (straight,)), Path("here"))
    offsets = torch.zeros(2, 11, HORIZON_STEPS)
    offsets[0, 1:5] = 2.0  # four players are wrong in one sample, six in the other
    offsets[1, 5:] = 2.0
    offsets[..., -1] *= 3
    found = errors(Offset(offsets), windows, 2)
    assert (found.min_ade_ft, found.min_fde_ft) == pytest.approx((0.0, 0.0), abs=1e-4)
    mean = 0.4 * 2.0 * (11 + 3) / 12
    assert (found.min_joint_ade_ft, found.min_joint_fde_ft) == pytest.approx((mean, 0.4 * 6.0), abs=1e-4)
    assert (found.ade_ft, found.fde_ft) == pytest.approx((mean, 0.4 * 6.0), abs=1e-4)


@pytest.mark.parametrize("samples", [1, 3])
def test_batches_make_no_difference(tmp_path: Path, samples: int):
    windows, _ = walks(tmp_path, (20, 31, 24))
    forecaster = fitted_noise(windows, np.arange(len(windows)))
    one, many = (errors(forecaster, windows, samples, batch_size=size) for size in (1, 64))
    assert one.min_ade_ft == pytest.approx(many.min_ade_ft)
    for name, limits in many.intervals.items():
        assert one.intervals[name] == pytest.approx(limits)


def test_noise_is_fitted_to_players(tmp_path: Path):
    windows, given = walks(tmp_path, (40, 60))
    noise = fitted_noise(windows, np.arange(len(windows)))
    squared = np.zeros(12)
    count = 0
    for walk in given:
        for begin in range(len(walk) - 19):
            window = walk[begin : begin + 20]
            predicted = window[7] + (window[7] - window[6]) * np.arange(1, 13)[:, None, None]
            squared += np.square(predicted - window[8:]).sum(axis=(1, 2))
            count += 20
    time_s = 0.12 * np.arange(1, 13)
    growth, offset = np.polyfit(np.log(time_s), 0.5 * np.log(squared / count), 1)
    assert noise.growth == pytest.approx(growth, rel=1e-4)
    assert noise.noise_m == pytest.approx(np.exp(offset) * FOOT_M, rel=1e-4)
    found = errors(noise, windows, 20)
    single = errors(ConstantVelocity(windows.spec), windows)
    assert found.min_ade_ft < 0.7 * single.min_ade_ft and found.ade_ft == pytest.approx(single.ade_ft)
    assert found.coverage is not None and 0.7 < found.coverage < 1.0


def test_windows_are_drawn_evenly_and_once(tmp_path: Path):
    windows, _ = walks(tmp_path, (40, 60))
    assert drawn(windows, 0, 3).tolist() == drawn(windows, 1000, 3).tolist() == list(range(62))
    some = drawn(windows, 20, 3)
    assert len(set(some.tolist())) == 20 and (np.diff(some) > 0).all()
    assert (windows.index[some, 0] == 0).any() and (windows.index[some, 0] == 1).any()
    assert some.tolist() == drawn(windows, 20, 3).tolist() != drawn(windows, 20, 4).tolist()


def test_what_is_no_store_of_possessions_is_refused(tmp_path: Path):
    circles = EpisodeStore(StoreInfo(spec(has_ego=False), "circles"), [circling_episode(0, steps=30)])
    with pytest.raises(UserError, match="here holds no basketball; make a store with python -m predictor.data.nba"):
        protocol_windows(circles, Path("here"))
    short = store_of(tmp_path, (19,), (straight,))
    assert short.info.spec.feature_names == FEATURES
    message = "here: no window fits: episodes have at most 18 steps, a window needs 19; make it with --episode-steps 0"
    with pytest.raises(UserError, match=message):
        protocol_windows(short, Path("here"))


def test_the_covariance_is_that_of_the_players_errors(tmp_path: Path):
    """The ball jumps, and would add a hundred times as much."""

    def parabola(entity: int, t: int) -> tuple[float, float]:
        return (20.0 + 50 * (t % 2), 5.0) if entity == -1 else (float(entity), 0.01 * t**2)

    store = store_of(tmp_path, (26,), (parabola,))
    windows = protocol_windows(store, tmp_path)
    noisy = fitted_residual(ConstantVelocity(windows.spec, HORIZON_STEPS), windows)
    off_m = [0.01 * (h * h + h) * FOOT_M for h in range(1, HORIZON_STEPS + 1)]
    std_m = noisy.std_m(HORIZON_STEPS).numpy()
    np.testing.assert_allclose(std_m[:, 1], off_m, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(std_m[:, 0], 0.0, atol=1e-4)


def test_a_player_who_leaves_before_the_last_frame_does_not_count(tmp_path: Path):
    windows, _ = walks(tmp_path, (25,))
    tally = PlayerTally(1)
    for possession_of, outcome in player_outcomes(ConstantVelocity(windows.spec), windows, np.arange(2), 1):
        valid, players = outcome.valid.clone(), outcome.valid[0].all(-1).nonzero()[:, 0]
        valid[:, players[:4], HORIZON_STEPS // 2 :] = False
        tally.add(possession_of, replace(outcome, valid=valid))
    assert tally.errors("it").forecasts == 2 * (10 - 4)
