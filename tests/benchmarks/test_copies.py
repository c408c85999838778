"""The benchmark of copies: what is timed, and that batching is what it compares."""

import pytest

from benchmarks.copies import CopiesConfig, cpu_block, make_copies, measure


@pytest.fixture(scope="module")
def config() -> CopiesConfig:
    return CopiesConfig("simple_spread_v3", "constant-velocity", copies=3, steps=2, blocks=3)


def test_copies_share_a_forward_and_single_ones_have_none(config: CopiesConfig):
    together, single, plain = (make_copies(config, n, forecasts) for n, forecasts in ((3, True), (1, True), (3, False)))
    forwards = [env._forward for env in together.envs]  # type: ignore[attr-defined]
    assert forwards[0] is not None and forwards == 3 * forwards[:1]
    assert single.envs[0]._forward is None  # type: ignore[attr-defined]
    assert (together.num_envs, single.num_envs, plain.num_envs) == (9, 3, 9)


def test_a_block_steps_every_vector_environment(config: CopiesConfig, monkeypatch: pytest.MonkeyPatch):
    venvs = [make_copies(config, 1, forecasts=False) for _ in range(2)]
    block, stepped = cpu_block(venvs, 4), []
    for venv in venvs:
        step = venv.step_wait
        monkeypatch.setattr(venv, "step_wait", lambda step=step, venv=venv: stepped.append(venv) or step())
    assert block() >= 0
    assert stepped == 4 * venvs


def test_costs_are_relative_to_one_copy(config: CopiesConfig):
    costs = measure(config)
    assert list(costs) == ["one", "batched", "one by one"]
    assert costs["one"].ratio == pytest.approx(1.0)
    assert all(cost.quartiles[0] <= cost.ratio <= cost.quartiles[1] for cost in costs.values())
