import math

import pytest

from agents.summaries import mean_and_standard_error, summarize, wilson_interval
from agents.vec_envs import EpisodeResult
from predictor.support.errors import UserError
from tests.agents.helpers import EPISODES


@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        (0, 10, 0.0, 0.27753),  # z²/(n + z²)
        (10, 10, 0.72247, 1.0),
        (5, 10, 0.23659, 0.76341),
        (1, 50, 0.00354, 0.10496),
        (0, 1, 0.0, 0.79346),
    ],
    ids=["none", "all", "half", "rare", "single"],
)
def test_wilson_interval_closed_form(successes: int, trials: int, low: float, high: float):
    assert wilson_interval(successes, trials) == pytest.approx((low, high), abs=1e-5)


@pytest.mark.parametrize(("successes", "trials"), [(-1, 5), (6, 5), (0, 0)])
def test_wilson_interval_refuses_nonsense(successes: int, trials: int):
    with pytest.raises(UserError, match="successes"):
        wilson_interval(successes, trials)


def test_standard_error_closed_form():
    mean, error = mean_and_standard_error([1.0, 3.0])
    assert (mean, error) == pytest.approx((2.0, 1.0))  # sd √2, n 2


def test_standard_error_of_one_value_is_unknown():
    assert math.isnan(mean_and_standard_error([4.0])[1])


def test_summary_of_episodes():
    line = summarize("ppo", EPISODES)
    assert (line.policy, line.episodes) == ("ppo", 3)
    assert line.return_mean == pytest.approx(17.0)
    assert line.length_mean == pytest.approx(24.0)
    assert line.crash_rate == pytest.approx(1 / 3)
    assert line.mean_speed_mps == pytest.approx(25.0)
    assert line.crash_low < line.crash_rate < line.crash_high


def test_shares_are_of_all_steps_not_of_episodes():
    long = EpisodeResult(1, 0.0, 30, False, 20.0, {}, {"slower": 29, "idle": 1})
    short = EpisodeResult(2, 0.0, 2, True, 20.0, {}, {"faster": 2})
    assert summarize("ppo", [short, long]).action_shares == {"slower": 29 / 32, "faster": 2 / 32, "idle": 1 / 32}
    assert summarize("ppo", EPISODES).action_shares == {}
