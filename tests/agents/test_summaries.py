import math
from dataclasses import replace

import pytest

from agents.results import Evaluation
from agents.summaries import mean_and_standard_error, percent_digits, summarize, wilson_interval
from agents.vec_envs import EpisodeResult
from envs.rollouts.driving_measures import DrivingMeasures
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


def test_success_is_a_rate_over_the_episodes_that_report_it():
    assert summarize("ppo", EPISODES).success_rate is None
    reported = [replace(EPISODES[0], success=True), replace(EPISODES[1], success=False), EPISODES[2]]
    line = summarize("ppo", reported)
    assert line.success_rate == 0.5
    assert (line.success_low, line.success_high) == wilson_interval(1, 2)
    assert line.crash_rate == pytest.approx(1 / 3)


def test_a_crash_is_no_success_where_success_is_reported():
    safe, crashed = (replace(EPISODES[0], crashed=hit) for hit in (False, True))
    reported = [replace(safe, success=True), replace(safe, success=False), crashed, crashed]
    assert summarize("ppo", reported).success_rate == 0.25
    assert summarize("ppo", [safe, crashed]).success_rate is None


@pytest.mark.parametrize(("rate", "digits"), [(0.0, 0), (0.005, 1), (0.05, 0), (0.95, 0), (0.995, 1), (1.0, 0)])
def test_one_episode_of_200_is_seen_in_percent(rate: float, digits: int):
    assert percent_digits(rate) == digits


def test_success_that_is_reported_only_when_it_happens_is_a_share_of_all_episodes():
    reached, silent = replace(EPISODES[0], success=True), replace(EPISODES[1], success=None)
    evaluation = Evaluation("toy-v0", 10, {"good": [reached, silent], "lost": [silent, silent]})
    assert [line.success_rate for line in evaluation.summaries] == [0.5, 0.0]
    assert Evaluation("toy-v0", 10, {"lost": [silent]}).summaries[0].success_rate is None
    told = replace(EPISODES[0], success=False)
    unknown, crashed = (replace(silent, crashed=hit) for hit in (False, True))
    assert Evaluation("toy-v0", 10, {"good": [reached, told, unknown]}).summaries[0].success_rate == 0.5
    found = Evaluation("toy-v0", 10, {"good": [reached, told], "lost": [crashed], "vague": [unknown]}).summaries
    assert [line.success_rate for line in found] == [0.5, 0.0, None]


def test_measures_of_driving_are_means_over_the_episodes_that_have_them():
    assert summarize("ppo", EPISODES).driving == {}
    first = DrivingMeasures(30.0, 0.1, 4, 1.25, 2.5, None, None)
    second = DrivingMeasures(20.0, 0.3, 2, 0.75, 1.5, 0.5, None)
    driven = [replace(EPISODES[0], driving=first), replace(EPISODES[1], driving=second), EPISODES[2]]
    driving = summarize("ppo", driven).driving
    assert list(driving) == list(DrivingMeasures.__dataclass_fields__)
    assert driving["time_s"] == pytest.approx((25.0, 5.0))
    assert driving["off_road_share"] == pytest.approx((0.2, 0.1))
    assert driving["lane_changes"] == pytest.approx((3.0, 1.0))
    assert driving["min_time_to_contact_s"] == pytest.approx((1.0, 0.25))
    assert driving["low_time_to_contact_s"] == pytest.approx((2.0, 0.5))
    assert driving["hard_brake_share"][0] == 0.5 and math.isnan(driving["hard_brake_share"][1])
    assert all(math.isnan(value) for value in driving["jerk_rms_mps3"])


def test_a_policy_without_a_crash_has_none_where_only_crashes_are_reported():
    crash, silent = replace(EPISODES[0], crashed=True), replace(EPISODES[1], crashed=None)
    evaluation = Evaluation("toy-v0", 10, {"bold": [crash, silent], "careful": [silent, silent]})
    assert [line.crash_rate for line in evaluation.summaries] == [0.5, 0.0]
    assert Evaluation("toy-v0", 10, {"careful": [silent]}).summaries[0].crash_rate is None
    safe = replace(EPISODES[0], crashed=False)
    told = Evaluation("toy-v0", 10, {"bold": [crash, safe], "unknown": [silent]})
    assert [line.crash_rate for line in told.summaries] == [0.5, None]


def test_an_episode_without_a_speed_leaves_the_others():
    fast, unknown = replace(EPISODES[0], mean_speed_mps=20.0), replace(EPISODES[1], mean_speed_mps=math.nan)
    assert summarize("ppo", [fast, unknown]).mean_speed_mps == 20.0
    assert math.isnan(summarize("ppo", [unknown]).mean_speed_mps)
