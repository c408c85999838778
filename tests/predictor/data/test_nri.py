"""NRI's simulators against their equations, against an integrator of another kind, and against a published constant."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from predictor.data.nri import NRIConfig, make_nri, make_nri_episodes, nri_physics
from predictor.data.springs import charge_force, draw_charges, draw_start, simulate
from predictor.data.store import read_store
from tests.predictor.data.helpers import energy

Array = np.ndarray[Any, np.dtype[np.float64]]


def placed(*xy: tuple[float, float]) -> Tensor:
    return torch.tensor([xy], dtype=torch.float64)


def drawn(law: Any, count: int, frames: int) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    if law == "charged":
        couplings = draw_charges(count, 5, 1.0, generator)
    else:
        upper = torch.triu((torch.rand(count, 5, 5, generator=generator) < 0.5).float(), 1)
        couplings = 0.1 * (upper + upper.transpose(1, 2))
    return (couplings, *draw_start(count, nri_physics(law, frames=frames), generator))


# --- Motion -----------------------------------------------------------------------------------------------------------


def accelerations(law: str, couplings: Array, positions: Array) -> Array:
    """The paper's forces, pair by pair, at unit mass."""
    found = np.zeros_like(positions)
    for i in range(len(positions)):
        for j in range(len(positions)):
            if i != j:
                apart = positions[i] - positions[j]
                if law == "springs":
                    found[i] -= couplings[i, j] * apart
                else:
                    found[i] += couplings[i, j] * apart / np.linalg.norm(apart) ** 3
    return found


def runge_kutta(law: str, couplings: Array, start: Array, seconds: float, steps: int) -> Array:
    """States after `seconds`, without walls, by the classical method of fourth order."""

    def rate(states: Array) -> Array:
        return np.concatenate([states[:, 2:], accelerations(law, couplings, states[:, :2])], axis=1)

    dt, states = seconds / steps, start
    for _ in range(steps):
        first = rate(states)
        second = rate(states + dt / 2 * first)
        third = rate(states + dt / 2 * second)
        states = states + dt / 6 * (first + 2 * second + 2 * third + rate(states + dt * third))
    return states


def test_springs_move_by_the_papers_equation():
    couplings, where, velocity = drawn("springs", 2, 21)
    states = simulate(nri_physics("springs", frames=21), couplings, where, velocity)
    for scene in range(2):
        start = torch.cat([where, velocity], dim=-1)[scene].numpy()
        exact = runge_kutta("springs", couplings[scene].double().numpy(), start, 2.0, 40)
        np.testing.assert_allclose(states[scene, 20].numpy(), exact, rtol=0, atol=1e-6)


def test_charges_move_by_the_papers_equation():
    """Far enough apart for the cap not to act, near enough for the forces to bend every path."""
    couplings = drawn("charged", 1, 11)[0]
    where = placed((0.0, 0.0), (1.5, 0.2), (-0.4, 1.6), (-1.4, -0.5), (0.6, -1.5))
    velocity = 0.5 * placed((1.0, 0.0), (0.0, 1.0), (-0.6, 0.8), (0.8, -0.6), (0.0, -1.0))
    states = simulate(nri_physics("charged", frames=11), couplings, where, velocity)[0, 10].numpy()
    start = torch.cat([where, velocity], dim=-1)[0].numpy()
    exact = runge_kutta("charged", couplings[0].double().numpy(), start, 1.0, 1000)
    np.testing.assert_allclose(states, exact, rtol=0, atol=2e-5)
    assert np.abs(exact[:, 2:] - start[:, 2:]).max() > 0.3


@pytest.mark.parametrize(
    ("x", "y", "force"),
    [(2.0, 0.0, [-0.25, 0.0]), (0.6, 0.8, [-0.6, -0.8]), (0.05, 0.0, [-100.0, 0.0]), (0.0, -0.01, [0.0, 100.0])],
    ids=["two metres", "one metre", "capped", "capped on the other axis"],
)
def test_force_of_two_charges_closed_form(x: float, y: float, force: list[float]):
    physics = nri_physics("charged", num_agents=2)
    couplings = torch.tensor([[[0.0, 1.0], [1.0, 0.0]]], dtype=torch.float64)
    found = charge_force(physics, couplings, placed((0.0, 0.0), (x, y)))
    torch.testing.assert_close(found[0, 0], torch.tensor(force, dtype=torch.float64))
    assert torch.equal(found[0, 0], -found[0, 1])
    assert torch.equal(charge_force(physics, -couplings, placed((0.0, 0.0), (x, y))), -found)


def test_energy_of_springs_stays_within_the_box():
    """Longer than a test rollout, so that particles meet the walls."""
    couplings, where, velocity = drawn("springs", 40, 120)
    states = simulate(nri_physics("springs", frames=120), couplings, where, velocity)
    assert states[..., :2].abs().max() > 4.9
    total = energy(couplings, states)
    torch.testing.assert_close(total, total[:, :1].expand_as(total), rtol=2e-3, atol=0)


def test_energy_of_charges_stays():
    """Kinetic plus Σ q_i q_j / r over pairs, where no two come so near that the cap acts."""
    couplings, where, velocity = drawn("charged", 100, 16)
    states = simulate(nri_physics("charged", frames=16), couplings, where, velocity)
    apart = torch.cdist(states[..., :2], states[..., :2]) + torch.diag(torch.full((5,), torch.inf)).double()
    potential = 0.5 * (couplings.double()[:, None] / apart).sum((-1, -2))
    total = 0.5 * states[..., 2:].square().sum((-1, -2)) + potential
    calm = apart.amin((1, 2, 3)) > 0.4
    assert calm.sum() > 10
    torch.testing.assert_close(total[calm], total[calm][:, :1].expand(-1, 16), rtol=0, atol=2e-3)


def test_walls_are_elastic():
    """At the wall, 5 m from the origin, after 0.2 s; the speed along it stays."""
    physics = nri_physics("springs", num_agents=2, frames=5)
    start = (placed((4.9, 0.0), (-2.0, -4.95)), placed((0.5, 0.1), (0.0, -0.5)))
    states = simulate(physics, torch.zeros(1, 2, 2), *start)[0]
    expected = torch.tensor([4.9, 4.95, 5.0, 4.95, 4.9], dtype=torch.float64)
    torch.testing.assert_close(states[:, 0, 0], expected, rtol=0, atol=1e-9)
    torch.testing.assert_close(states[-1, 0], torch.tensor([4.9, 0.04, -0.5, 0.1], dtype=torch.float64))
    torch.testing.assert_close(states[-1, 1], torch.tensor([-2.0, -4.85, 0.0, 0.5], dtype=torch.float64))


# --- Draws ------------------------------------------------------------------------------------------------------------

PUBLISHED_STATIC_MSE = {1: 7.93e-5, 10: 7.59e-3, 20: 2.82e-2}
"""Mean squared error of "nothing moves" by steps ahead: row Static, 5 springs, of NRI's table of future states."""
RANGES = np.array([8.416, 8.416, 2.941, 2.941])
"""Largest minus smallest position [m] and velocity [m/s] of the 50,000 training rollouts of seed 0. NRI maps its own to
[−1, 1]; fewer rollouts have smaller extremes."""


def test_springs_move_as_far_as_nris():
    """It depends on speeds, forces and the time between frames alike; no force at all is 25 % off after one step."""
    states = np.stack([e.states for e in make_nri_episodes(NRIConfig(Path("unused")), "train", 1000)])
    scaled = 2 * states / RANGES
    for steps, published in PUBLISHED_STATIC_MSE.items():
        assert np.square(scaled[:, steps:] - scaled[:, :-steps]).mean() == pytest.approx(published, rel=0.06)


def test_half_of_the_pairs_have_a_spring():
    """10,000 pairs: four standard errors are 0.02."""
    episodes = make_nri_episodes(NRIConfig(Path("unused"), frames=2), "train", 1000)
    types = np.stack([e.edge_types[0] for e in episodes if e.edge_types is not None])
    assert set(np.unique(types)) == {0, 1}
    assert (types == types.transpose(0, 2, 1)).all() and not types[:, np.arange(5), np.arange(5)].any()
    assert types[:, *np.triu_indices(5, 1)].mean() == pytest.approx(0.5, abs=0.02)
    assert all(e.edge_attributes is None for e in episodes)


def test_types_of_charges_are_signs_of_products():
    """Charges of opposite sign attract (type 1): the product of the three signs of any triangle is +1."""
    episodes = make_nri_episodes(NRIConfig(Path("unused"), "charged", frames=2), "train", 300)
    types = np.stack([e.edge_types[0] for e in episodes if e.edge_types is not None])
    assert set(np.unique(types[:, *np.triu_indices(5, 1)])) == {1, 2}
    sign = np.where(types == 2, 1, -1)
    assert (sign[:, 0, 1] * sign[:, 1, 2] * sign[:, 0, 2] == 1).all()
    assert (types[:, *np.triu_indices(5, 1)] == 2).mean() == pytest.approx(0.5, abs=0.05)


def test_starts_are_nris():
    """Springs begin within 0.5 m, charges within 1 m; all at 0.5 m/s. A frame later they have hardly moved."""
    for law, spread in (("springs", 0.5), ("charged", 1.0)):
        states = np.stack(
            [e.states[0] for e in make_nri_episodes(NRIConfig(Path("unused"), law, frames=2), "val", 500)]
        )
        assert states[..., :2].std() == pytest.approx(spread, rel=0.05)
        assert np.median(np.linalg.norm(states[..., 2:], axis=-1)) == pytest.approx(0.5, rel=0.1)


# --- Stores -----------------------------------------------------------------------------------------------------------


def test_stores_have_nris_splits_and_lengths(tmp_path: Path):
    took = make_nri(NRIConfig(tmp_path / "data", train=3, val=2, test=2))
    assert list(took) == ["train", "val", "test"]
    for split, count, frames in (("train", 3, 49), ("val", 2, 49), ("test", 2, 99)):
        store = read_store(tmp_path / "data" / split)
        assert store.info.source == "NRI 5-springs" and store.info.provenance["split"] == split
        assert store.info.spec.dt_s == 0.1 and store.info.edge_attribute_names == ()
        assert [e.states.shape for e in store.episodes] == [(frames, 5, 4)] * count


def test_the_first_frame_is_one_frame_after_the_start():
    config = NRIConfig(Path("unused"), frames=3)
    first = make_nri_episodes(config, "val", 1)[0].states
    longer = make_nri_episodes(NRIConfig(Path("unused"), frames=5), "val", 1)[0].states
    np.testing.assert_array_equal(longer[:3], first)
    # back in time by one frame: all speeds are the initial ones, up to what a force of 0.1 N does in 0.1 s
    speeds = np.linalg.norm(first[0, :, 2:], axis=-1)
    assert (np.abs(speeds - 0.5) > 1e-6).any() and (np.abs(speeds - 0.5) < 0.1).all()


def test_splits_draw_from_streams_of_their_own():
    config = NRIConfig(Path("unused"), frames=2)
    splits = [make_nri_episodes(config, split, 1)[0].states for split in ("train", "val")]
    assert not np.array_equal(*splits)
    again = make_nri_episodes(config, "train", 1)[0].states
    assert np.array_equal(splits[0], again)
