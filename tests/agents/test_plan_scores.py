from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import DQN, PPO
from stable_baselines3.common.vec_env import DummyVecEnv

from agents import plan_scores
from agents.features import ForecastAttention
from agents.plan_scores import SUMMARY, PlanAttention, PlanScores, PlanValues, plan_actions
from agents.task import Task
from agents.training import TrainingPlan, make_model
from agents.vec_envs import make_venv
from predictor.support.errors import UserError

OTHERS, PLANS = 3, 4
PLAN_ACTIONS = (2, 0, 3, 1)


class OneFreePlan(gym.Env[dict[str, np.ndarray], np.int64]):
    """Environment in which one plan touches nobody; the reward is 1 for the action with which it begins."""

    observation_space = gym.spaces.Dict(
        {
            "observation": gym.spaces.Box(-1, 1, (2,), np.float32),
            "valid": gym.spaces.Box(0, 1, (OTHERS,), np.float32),
            "what_if_gap": gym.spaces.Box(-np.inf, np.inf, (OTHERS, PLANS), np.float32),
            "what_if_contact": gym.spaces.Box(0, 1, (OTHERS, PLANS), np.float32),
            "what_if_risk": gym.spaces.Box(0, 1, (OTHERS, PLANS), np.float32),
        }
    )
    action_space = gym.spaces.Discrete(PLANS)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self._look(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        reward = float(int(action) == PLAN_ACTIONS[self._free])
        return self._look(), reward, False, bool(self.np_random.random() < 0.1), {}

    def _look(self) -> dict[str, np.ndarray]:
        self._free = int(self.np_random.integers(PLANS))
        valid = np.array([1, 1, 0], np.float32)
        touched = np.zeros((OTHERS, PLANS), np.float32)
        touched[self.np_random.integers(2, size=PLANS), np.arange(PLANS)] = 1.0
        touched[:, self._free] = 0.0
        gap = np.where(touched > 0, -0.5, self.np_random.uniform(2, 30, touched.shape)).astype(np.float32)
        entries = {"what_if_gap": gap, "what_if_contact": 1 - 0.5 * touched, "what_if_risk": touched}
        own = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        shown = {k: (v * valid[:, None]).astype(np.float32) for k, v in entries.items()}
        return {"observation": own, "valid": valid, **shown}


def make_ppo(**changes: Any) -> PPO:
    kwargs = {"features_extractor_class": PlanAttention, "plan_actions": PLAN_ACTIONS, "net_arch": [32]}
    options: dict[str, Any] = {"n_steps": 256, "batch_size": 64, "learning_rate": 1e-3, "seed": 0, "gamma": 0.0}
    return PPO(PlanScores, DummyVecEnv([OneFreePlan]), policy_kwargs=kwargs, device="cpu", **(options | changes))


def make_dqn(**changes: Any) -> DQN:
    kwargs = {"plan_actions": PLAN_ACTIONS, "features_extractor_class": PlanAttention, "net_arch": [16]}
    options: dict[str, Any] = {"learning_starts": 64, "learning_rate": 3e-3, "gamma": 0.0, "train_freq": 1}
    options |= {"exploration_fraction": 0.5, "buffer_size": 2000, "seed": 0, "target_update_interval": 50}
    return DQN(PlanValues, DummyVecEnv([OneFreePlan]), policy_kwargs=kwargs, device="cpu", **(options | changes))


def values(model: DQN, shown: dict[str, torch.Tensor]) -> torch.Tensor:
    with torch.no_grad():
        return model.policy.q_net(shown)


def observed(count: int = 50, seed: int = 0) -> dict[str, torch.Tensor]:
    env = OneFreePlan()
    shown = [env.reset(seed=seed)[0], *(env.step(0)[0] for _ in range(count - 1))]
    return {key: torch.tensor(np.stack([one[key] for one in shown])) for key in shown[0]}


def logits(model: PPO, shown: dict[str, torch.Tensor]) -> torch.Tensor:
    with torch.no_grad():
        return model.policy.get_distribution(shown).distribution.logits


@pytest.mark.slow
def test_what_is_learned_of_one_plan_holds_for_all():
    model = make_ppo().learn(2048)
    shown = observed(400, seed=1)
    free = shown["what_if_risk"].amax(1).argmin(-1)
    wanted = torch.tensor(PLAN_ACTIONS)[free]
    assert (logits(model, shown).argmax(-1) == wanted).float().mean() > 0.95


@pytest.mark.slow
def test_values_of_plans_are_learned_for_all_at_once():
    model = make_dqn().learn(1500)
    shown = observed(400, seed=1)
    free = shown["what_if_risk"].amax(1).argmin(-1)
    wanted = torch.tensor(PLAN_ACTIONS)[free]
    assert (values(model, shown).argmax(-1) == wanted).float().mean() > 0.95


def test_scores_are_added_to_the_values_of_their_actions():
    model, shown = make_dqn(), observed()
    network: Any = model.policy.q_net.q_net
    torch.nn.init.normal_(network.score[-1].weight)
    with torch.no_grad():
        features = model.policy.q_net.extract_features(shown, model.policy.q_net.features_extractor)
        for parameter in network.own.parameters():
            parameter.zero_()
        context = features[:, : -PLANS * SUMMARY]
        for plan, action in enumerate(PLAN_ACTIONS):
            summary = features[:, -PLANS * SUMMARY :].unflatten(1, (PLANS, SUMMARY))[:, plan]
            score = network.score(torch.cat([context, summary], dim=-1))[:, 0]
            torch.testing.assert_close(values(model, shown)[:, action], score)


@pytest.mark.slow
def test_the_target_of_dqn_has_scores_of_its_own_and_follows():
    model = make_dqn(target_update_interval=100_000).learn(200)
    now, target = model.policy.q_net.q_net, model.policy.q_net_target.q_net
    pairs = list(zip(now.parameters(), target.parameters(), strict=True))  # type: ignore[union-attr]
    assert len(pairs) > 4 and not all(torch.equal(one, other) for one, other in pairs)
    assert all(one is not other for one, other in pairs)


@pytest.mark.slow
def test_a_policy_of_values_is_saved_with_its_plans(tmp_path: Path):
    model = make_dqn().learn(200)
    model.save(tmp_path / "policy.zip")
    loaded = DQN.load(tmp_path / "policy.zip", device="cpu")
    torch.testing.assert_close(values(loaded, observed()), values(model, observed()), rtol=0, atol=0)
    assert loaded.policy.plan_actions == PLAN_ACTIONS


def test_scores_go_to_the_actions_of_their_plans():
    model, shown = make_ppo(), observed()
    extractor: Any = model.policy.mlp_extractor
    torch.nn.init.normal_(extractor.score[-1].weight)
    before = logits(model, shown)
    with torch.no_grad():  # the scores alone: SB3's own actor says nothing
        for parameter in model.policy.action_net.own.parameters():
            parameter.zero_()
    alone = logits(model, shown)
    features = model.policy.extract_features(shown)
    scores = extractor.forward_actor(features)[:, -PLANS:]
    assert (scores.std(1) > 0.01).all() and not torch.allclose(alone, before)
    placed = torch.stack([scores[:, PLAN_ACTIONS.index(action)] for action in range(PLANS)], dim=1)
    torch.testing.assert_close(alone, placed.log_softmax(-1))


def test_plans_that_look_alike_have_equal_scores():
    model, shown = make_ppo(), observed()
    for key in ("what_if_gap", "what_if_contact", "what_if_risk"):
        shown[key] = shown[key][..., :1].expand(-1, -1, PLANS)
    torch.nn.init.normal_(model.policy.mlp_extractor.score[-1].weight)
    scores = model.policy.mlp_extractor.forward_actor(model.policy.extract_features(shown))[:, -PLANS:]
    torch.testing.assert_close(scores, scores[:, :1].expand(-1, PLANS))


def test_absent_agents_are_far_away():
    shown, extractor = observed(), PlanAttention(OneFreePlan.observation_space)
    features = extractor(shown)
    for key in ("what_if_gap", "what_if_contact", "what_if_risk"):
        assert (shown[key][:, 2] == 0).all(), "padding looks like a contact"
    summary = features[:, -PLANS * SUMMARY :].unflatten(1, (PLANS, SUMMARY))
    free = shown["what_if_risk"].amax(1) == 0
    gap, contact = shown["what_if_gap"][:, :2].amin(1), shown["what_if_contact"][:, :2].amin(1)
    torch.testing.assert_close(summary[..., 0], torch.tanh(gap / 2))
    torch.testing.assert_close(summary[..., 1], torch.tanh(gap / 10))
    torch.testing.assert_close(summary[..., 2], gap / 50)
    torch.testing.assert_close(summary[..., 3], contact)
    torch.testing.assert_close(summary[..., 5], 1.0 - free.float())
    unsure = {**shown, "what_if_risk": torch.zeros_like(shown["what_if_risk"])}
    unsure["what_if_risk"][:, 0], unsure["what_if_risk"][:, 1] = 0.3, 0.5
    likely = extractor(unsure)[:, -PLANS * SUMMARY :].unflatten(1, (PLANS, SUMMARY))
    torch.testing.assert_close(likely[..., 4], torch.full_like(likely[..., 4], 0.5), msg="the largest risk")
    torch.testing.assert_close(likely[..., 5], torch.full_like(likely[..., 5], 0.65), msg="that of any contact")
    nobody = {**shown, "valid": torch.zeros_like(shown["valid"])}
    alone = extractor(nobody)[:, -PLANS * SUMMARY :].unflatten(1, (PLANS, SUMMARY))
    assert (alone[..., :2] > 0.99).all() and (alone[..., 2] == 2).all() and (alone[..., 3] == 1).all()


@pytest.mark.slow
def test_the_policy_is_saved_with_its_plans(tmp_path: Path):
    model = make_ppo().learn(256)
    model.save(tmp_path / "policy.zip")
    loaded = PPO.load(tmp_path / "policy.zip", device="cpu")
    torch.testing.assert_close(logits(loaded, observed()), logits(model, observed()), rtol=0, atol=0)
    assert loaded.policy.plan_actions == PLAN_ACTIONS


@pytest.mark.parametrize("make", [make_ppo, make_dqn])
def test_policies_are_saved_without_their_algorithm_too(make: Any, tmp_path: Path):
    policy, shown = make().policy, observed()
    policy.save(str(tmp_path / "policy.pt"))
    loaded = type(policy).load(str(tmp_path / "policy.pt"), device="cpu")
    assert loaded.plan_actions == PLAN_ACTIONS
    assert torch.equal(loaded._predict(shown, deterministic=True), policy._predict(shown, deterministic=True))


def test_a_space_without_plans_is_refused():
    with pytest.raises(UserError, match="needs the entry 'what_if_gap'; wrap the environment with what_if=True"):
        PlanAttention(gym.spaces.Dict({"observation": gym.spaces.Box(-1, 1, (2,))}))


def test_a_space_without_another_agent_is_refused():
    alone = {
        name: gym.spaces.Box(-1, 1, (0, *space.shape[1:])) if name != "observation" else space
        for name, space in OneFreePlan.observation_space.items()
    }
    with pytest.raises(UserError, match="PlanAttention needs room for another agent; wrap the environment with m"):
        PlanAttention(gym.spaces.Dict(alone))


def test_actions_of_plans_are_those_that_the_planner_takes():
    task = Task("highway-fast-v0", "constant-velocity", what_if=True)
    env = task.make()
    env.reset(seed=0)
    names = {number: name for name, number in env.unwrapped.action_type.actions_indexes.items()}
    assert [names[action] for action in plan_actions(task) or ()] == [
        "IDLE", "SLOWER", "FASTER", "LANE_LEFT", "LANE_RIGHT"
    ]  # fmt: skip
    assert plan_actions(Task("racetrack-v1", "constant-velocity", what_if=True)) is None, "continuous controls"


def test_policies_do_not_score_plans_of_continuous_actions(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(plan_scores, "plan_model_for", lambda env: SimpleNamespace(actions=(np.zeros(2), np.ones(2))))
    assert plan_actions(Task("racetrack-v1", "constant-velocity", what_if=True)) is None


@pytest.mark.parametrize(
    ("algorithm", "what_if", "extractor"),
    [
        ("ppo", True, PlanAttention),
        ("a2c", True, PlanAttention),
        ("recurrent-ppo", True, ForecastAttention),
        ("ppo", False, ForecastAttention),
        ("dqn", True, PlanAttention),
        ("dqn", False, ForecastAttention),
    ],
)
def test_policies_with_what_if_score_plans(algorithm: Any, what_if: bool, extractor: type):
    task = Task("highway-fast-v0", "constant-velocity", what_if=what_if)
    plan = TrainingPlan(task, algorithm, 1_000, 1, 0)
    venv = make_venv(task, 1, in_process=True)
    model = make_model(plan, venv)
    policy: Any = model.policy.q_net if algorithm == "dqn" else model.policy
    assert type(policy.features_extractor) is extractor
    obs = venv.reset()
    assert model.predict(obs)[0].shape == (1,)
    venv.close()


@pytest.mark.parametrize("actions", [(0, 1, -1), (0, 1, 5)])
def test_actions_of_plans_are_actions_of_the_environment(actions: tuple[int, ...], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(plan_scores, "plan_model_for", lambda env: SimpleNamespace(actions=actions))
    with pytest.raises(UserError, match=r"actions must be actions of Discrete\(5\), got \(0, 1, "):
        plan_actions(Task("highway-fast-v0", "constant-velocity", what_if=True))


def test_the_optimizer_of_ppo_trains_the_scores_and_the_layer_of_the_logits():
    """SB3 makes its optimizer before the layer of the logits is replaced."""
    policy = make_ppo().policy
    trained = {id(p) for group in policy.optimizer.param_groups for p in group["params"]}
    assert trained == {id(p) for p in policy.parameters()}
