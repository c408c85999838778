from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from envs.evaluate import EvaluateConfig, evaluate_causes
from envs.rollouts import plan_run
from envs.rollouts.plan_moments import STRAIGHT, PlanMoment
from envs.rollouts.plan_run import PlanRun, measure_plans, right_choices, scores_of
from predictor.support.errors import UserError
from tests.envs.evaluation import TAG, forget, no_processes


@pytest.fixture(autouse=True)
def in_process(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    no_processes(monkeypatch)
    forget()
    yield
    forget()


def found(
    seed: int, crashed: list[bool], risk: list[float], with_m: float = 1.0, guarded: list[float] | None = None
) -> PlanMoment:
    """The own driver and two plans, three agents each; an error of 2 m per agent without a plan."""
    hit = np.array([False, *crashed])
    agents = np.where(hit, 0, 3)
    return PlanMoment(
        seed,
        5,
        hit,
        True,
        agents,
        {"model": 2.0 * agents},
        {"model": with_m * agents},
        {"model": np.array(risk)},
        {"model": np.array(guarded or risk)},
    )


def test_a_choice_is_right_if_the_plan_that_collides_has_the_higher_risk():
    crashed = np.array([True, False, False, True])
    assert right_choices(np.array([0.9, 0.1, 0.2, 0.3]), crashed) == (4.0, 4)
    assert right_choices(np.array([0.9, 0.1, 0.5, 0.3]), crashed) == (3.0, 4)
    assert right_choices(np.array([0.0, 0.0, 0.0, 0.0]), crashed) == (2.0, 4)
    assert right_choices(np.array([0.9, 0.1]), np.array([True, True])) == (0.0, 0)


def test_scores_of_known_moments():
    episodes = [
        [found(0, [True, False], [0.8, 0.2], guarded=[0.9, 0.9]), found(0, [False, False], [0.0, 0.0])],
        [found(1, [True, False], [0.1, 0.6])],
    ]
    scores = scores_of(episodes, "model")
    assert (scores.own.agents, scores.own.without_m, scores.own.with_m) == (9, 2.0, 1.0)
    assert scores.own.reduction is not None and scores.own.reduction.value == 0.5
    assert scores.plans.agents == 12 and scores.choices == 2
    assert scores.right is not None and scores.right.value == 0.5 and scores.right.interval == (0.0, 1.0)
    assert scores.right_of_planner is not None and scores.right_of_planner.value == 0.25, "0.5 of 2 pairs"
    assert scores.brier is not None
    assert scores.brier.value == pytest.approx((0.04 + 0.04 + 0.0 + 0.0 + 0.81 + 0.36) / 6)


def test_whoever_has_risks_of_some_moments_alone_is_scored_by_its_choices():
    moments = [found(0, [False, False], [0.0, 0.1]), found(0, [True, False], [0.8, 0.2])]
    moments[1].risk["drivers known"] = np.array([0.5, 0.0])
    scores = scores_of([moments, moments[:1]], "drivers known")
    assert (scores.own.agents, scores.own.with_m, scores.plans.reduction) == (0, None, None)
    assert scores.choices == 1 and scores.right is not None and scores.right.value == 1.0
    assert scores.right_of_planner is None and scores.brier is None
    model = scores_of([moments, moments[:1]], "model")
    assert (model.choices, model.own.agents) == (1, 9) and model.brier is not None


def test_a_plan_that_harms_lowers_the_reduction_below_zero():
    scores = scores_of([[found(i, [False, False], [0.0, 0.0], with_m=3.0)] for i in range(2)], "model")
    assert scores.own.reduction is not None and scores.own.reduction.value == -0.5
    assert scores.choices == 0 and scores.right is None


def test_nothing_to_compare_is_none_and_no_error():
    hit = PlanMoment(
        0, 5, np.array([True, True]), True, np.array([0, 0]), {"model": np.zeros(2)}, {"model": np.zeros(2)},
        {"model": np.ones(1)}, {"model": np.ones(1)},
    )  # fmt: skip
    scores = scores_of([[hit]], "model")
    assert (scores.own.agents, scores.own.reduction, scores.right) == (0, None, None)


def run(env_id: str = "highway-fast-v0", episodes: int = 2, max_steps: int = 6, workers: int = 1) -> PlanRun:
    return PlanRun(
        env_id=env_id, driver="idle", checkpoints=("constant-velocity",), episodes=episodes, seed=900_000,
        max_steps=max_steps, workers=workers, horizon_steps=2,
    )  # fmt: skip


@pytest.mark.slow
def test_an_environment_is_measured_whatever_the_number_of_workers():
    one, two = (measure_plans(run(max_steps=14, workers=workers)) for workers in (1, 2))
    assert one == two
    assert list(one.scores) == [STRAIGHT] and one.moments >= 2
    assert one.plan_names[0] == "IDLE" and len(one.crashed) == len(one.plan_names) == 5
    assert one.scores[STRAIGHT].own.agents > 3
    reduction = one.scores[STRAIGHT].own.reduction
    assert reduction is not None and reduction.value == 0.0


def test_episodes_without_a_moment_are_an_error():
    with pytest.raises(
        UserError, match="highway-fast-v0: none of 2 episodes has a step to measure, every 5th .*raise --max-steps"
    ):
        measure_plans(run(max_steps=2))


@pytest.mark.parametrize(("driver", "opened"), [("varied", "varied"), ("policy.zip", "idle")])
def test_plans_are_looked_for_with_the_driver_that_was_asked_for(
    driver: str, opened: str, monkeypatch: pytest.MonkeyPatch
):
    """An environment whose action space has no idle action is driven by what the user wrote for it."""

    def refuse(env_id: str, driver: str, env_kwargs: str) -> None:
        raise UserError(f"opened with {driver}")

    monkeypatch.setattr("envs.rollouts.world.open_world", refuse)
    with pytest.raises(UserError, match=f"opened with {opened}"):
        measure_plans(replace(run(), driver=driver))
    config = EvaluateConfig(("highway-fast-v0",), checkpoint=("constant-velocity",), driver=driver, plans=True)
    with pytest.raises(UserError, match=f"opened with {opened}"):
        evaluate_causes(config, Console(quiet=True))


OWN = "tests.envs.own_plans:Planned-v0"


def test_plans_of_an_environment_of_ones_own_are_played():
    """Its reader knows no bodies and its simulator no interventions: copies and the infos' crashes are enough."""
    config = EvaluateConfig(
        (OWN,), checkpoint=("constant-velocity",), episodes=1, driver="idle", max_steps=9, workers=1, horizon_steps=2,
        plans=True,
    )  # fmt: skip
    evaluate_causes(config, Console(quiet=True))
    measured = measure_plans(replace(run(OWN), max_steps=9))
    assert measured.plan_names == ("up", "down") and measured.moments > 0
    assert measured.crashed == [0.0, 1.0]
    own = measured.scores[STRAIGHT].own
    assert own.agents > 0 and own.without_m == own.with_m


def test_only_episodes_with_a_moment_are_counted():
    """Of seeds 8 to 11 the egos, driven at random, first collide after 12, 5, 3 and 2 steps: one has a moment."""
    found = measure_plans(replace(run(OWN, episodes=4, max_steps=30), driver="random", seed=8))
    assert found.episodes == 1 and found.moments >= 1


@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
        ("Mute", "Mute-v0 does not report crashes, .*; name the key of its infos: register_reader"),
        ("Uncopied", r"copy.deepcopy of .*Uncopied-v0 failed \(TypeError: cannot pickle 'Socket' object\); make its"),
    ],
)
def test_own_environments_whose_plans_cannot_be_judged_are_refused_in_a_line(kind: str, sentence: str):
    with pytest.raises(UserError, match=sentence):
        measure_plans(run(OWN.replace("Planned", kind)))


def test_what_has_no_plans_is_said(monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(UserError, match="plans are those of one ego, and simple_tag_v3 has several"):
        measure_plans(run(TAG))
    monkeypatch.setattr(plan_run, "play_plans", lambda task: [])
    with pytest.raises(UserError, match="add --episodes"):
        measure_plans(run())


def test_whoever_is_asked_of_a_later_moment_alone_is_scored(monkeypatch: pytest.MonkeyPatch):
    later = found(1, [True, False, False, False, False], [0.8, 0.2, 0.2, 0.2, 0.2])
    later.risk["drivers known"] = np.array([1.0, 0.0, 0.0, 0.0, 0.0])
    first = found(0, [False] * 5, [0.0] * 5)
    monkeypatch.setattr(plan_run, "track", lambda *_, **__: [[first], [later]])
    assert list(measure_plans(run()).scores) == ["model", "drivers known"]
