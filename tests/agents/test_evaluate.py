import json
import math
from pathlib import Path

import pytest

from agents.episodes import EpisodeResult
from agents.evaluate import Evaluation, mean_and_standard_error, summarize, wilson_interval
from predictor.errors import UserError

EPISODES = [
    EpisodeResult(seed=10, episode_return=20.0, length=30, crashed=False, mean_speed_mps=22.0),
    EpisodeResult(seed=11, episode_return=10.0, length=12, crashed=True, mean_speed_mps=28.0),
    EpisodeResult(seed=12, episode_return=21.0, length=30, crashed=False, mean_speed_mps=25.0),
]


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
    row = summarize("ppo", EPISODES)
    assert (row.policy, row.episodes) == ("ppo", 3)
    assert row.return_mean == pytest.approx(17.0)
    assert row.length_mean == pytest.approx(24.0)
    assert row.crash_rate == pytest.approx(1 / 3)
    assert row.mean_speed_mps == pytest.approx(25.0)
    assert row.crash_low < row.crash_rate < row.crash_high


def test_written_summary_is_valid_json_and_a_table(tmp_path: Path):
    silent = [EpisodeResult(seed=10, episode_return=1.0, length=2, crashed=False, mean_speed_mps=math.nan)]
    evaluation = Evaluation("toy-v0", 10, {"ppo": EPISODES, "silent": silent})
    evaluation.write(tmp_path, algorithm="ppo")

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    content = json.loads((tmp_path / "summary.json").read_text(), parse_constant=refuse)
    assert content["algorithm"] == "ppo"
    assert [row["policy"] for row in content["policies"]] == ["ppo", "silent"]
    assert content["policies"][1]["mean_speed_mps"] is None
    assert [e["seed"] for e in content["episodes"]["ppo"]] == [10, 11, 12]
    lines = (tmp_path / "summary.md").read_text().splitlines()
    assert lines[2].startswith("| ppo | 17.00 ± 3.51 | 24.0 ± 6.0 | 33 % (")
    assert lines[3].endswith("| – |")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["summary.json", "summary.md"]
