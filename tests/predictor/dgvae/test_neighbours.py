"""Neighbour lists, frozen roll-outs, and variants of a network that switch them on.

With room for all agents, a neighbour list is the dense model; with less, the dense model under the mask of near ones,
which is what the training window computes.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import initialize, invariant
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from predictor.dgvae import DGVAE
from predictor.dgvae import model as dgvae
from predictor.dgvae.config import DGVAEConfig
from predictor.dgvae.packing import Packed
from predictor.dgvae.single_step import Modules
from predictor.forecaster import Belief, Memory, WindowOutput
from predictor.graph import NO_AGENT, among_nearest, off_diagonal, others, pair_mask
from predictor.online import OnlineForecaster
from predictor.scene import PADDING_ID, Forecast, Scene
from predictor.support.errors import UserError
from tests.predictor.helpers import (
    FAST_LIKE,
    RICH,
    ROAD,
    WORLD,
    batch,
    model,
    random_presence,
    random_states,
    scene,
    spec,
)
from tests.predictor.test_online import AGENTS as AGENTS_OF_A_SCENE
from tests.predictor.test_online import ENVS, Streams, assert_same, envs_of, reference
from tests.predictor.test_online import scenes as any_scenes

BATCH, TIME, AGENTS, HORIZON = 2, 5, 5, 4
EXACT = {"rtol": 1e-9, "atol": 1e-9}  # in float64
CONFIGS = {
    "fast": FAST_LIKE,
    # Every kind of memory that a neighbour list can have.
    "rich": replace(RICH, innovation_rounds=0, num_edge_types=3),
}
every_config = pytest.mark.parametrize("name", CONFIGS)
seeds = st.integers(0, 2**16)


@cache
def precise(name: str, near: int = 0, frame: Any = WORLD, has_ego: bool = True, frozen: bool = False) -> DGVAE:
    """In float64, with weights large enough for every path to leave a trace."""
    torch.manual_seed(7)
    rollout: Any = "frozen" if frozen else "evolving"
    config = replace(CONFIGS[name], num_neighbours=near, rollout_graph=rollout)
    forecaster = DGVAE(spec(frame, has_ego), config, HORIZON)
    with torch.no_grad():
        for parameter in forecaster.parameters():
            parameter.mul_(1.7)
    return forecaster.double().eval().requires_grad_(False)


@st.composite
def presence(draw: st.DrawFn) -> Tensor:
    """Who is present at each step; every pattern of entering and leaving can occur."""
    cells = BATCH * TIME * AGENTS
    bits = draw(st.integers(0, 2**cells - 1))
    return torch.tensor([bool(bits >> i & 1) for i in range(cells)]).view(BATCH, TIME, AGENTS)


def scenes(seed: int, agents: int = AGENTS) -> Tensor:
    """Positions are drawn anew at each step, so that neighbours change all the time."""
    return random_states(seed, BATCH, TIME, agents, 4).double()


def stream(forecaster: DGVAE, states: Tensor, valid: Tensor) -> Iterator[tuple[Memory, Belief]]:
    memory = forecaster.empty_memory(states.shape[0], states.shape[2])
    for now, present in zip(states.unbind(1), valid.unbind(1), strict=True):
        memory, belief = forecaster.observe(memory, now, present)
        yield memory, belief


@torch.no_grad()
def streamed(forecaster: DGVAE, states: Tensor, valid: Tensor) -> dict[str, Tensor]:
    """Time axis second; agents (and pairs of them) follow it. States of absent agents are not compared."""
    beliefs = [belief for _, belief in stream(forecaster, states, valid)]
    dense = [belief.dense() for belief in beliefs]
    return {
        "probs": torch.stack([b.edge_probs for b in dense], dim=1),
        "features": torch.stack([b.edge_features for b in dense], dim=1),
        "rollout": torch.stack([forecaster.rollout(b, HORIZON).states[:, 0] for b in beliefs], dim=1)
        * valid[..., None, None],
    }


@torch.no_grad()
def window(forecaster: DGVAE, states: Tensor, valid: Tensor, now: int = TIME - 1) -> WindowOutput:
    """The training pass with every sampled graph replaced by the expected one; of absent agents, zeros."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dgvae, "concrete_sample", lambda logits, *_: torch.softmax(logits, dim=-1))
        whole = forecaster.window(states, valid, torch.full((len(states),), now), HORIZON)
    return whole._replace(
        one_step=whole.one_step * valid[..., None], rollout=whole.rollout * valid[:, now, :, None, None]
    )


def same(ours: dict[str, Tensor], expected: dict[str, Tensor]) -> None:
    for name, values in expected.items():
        torch.testing.assert_close(ours[name], values, **EXACT, msg=lambda m, n=name: f"{n}: {m}")


# --- Room for all agents ----------------------------------------------------------------------------------------------


@every_config
@pytest.mark.parametrize("near", [AGENTS - 1, AGENTS, AGENTS + 3])
@settings(max_examples=4)
@given(valid=presence(), seed=seeds)
def test_with_room_for_all_agents_it_is_the_dense_model(name: str, near: int, valid: Tensor, seed: int):
    states = scenes(seed)
    same(streamed(precise(name, near), states, valid), streamed(precise(name), states, valid))


@every_config
@pytest.mark.parametrize("near", [AGENTS - 1, AGENTS + 3])
def test_with_room_for_all_agents_training_is_that_of_the_dense_model(name: str, near: int):
    states, valid = scenes(0), random_presence(0, BATCH, TIME, AGENTS)
    ours, expected = (
        precise(name, k).window(states, valid, torch.tensor([2, 3]), HORIZON, torch.Generator().manual_seed(0))
        for k in (near, 0)
    )
    for one, other in zip(ours[:5], expected[:5], strict=True):  # then come modes, of which there are none
        assert torch.equal(one, other)
    assert expected.pairs is None and torch.equal(ours.pairs, pair_mask(valid))


# --- Streaming ≡ window -----------------------------------------------------------------------------------------------


@every_config
@pytest.mark.parametrize("near", [1, 2, 3])
@settings(max_examples=5)
@given(valid=presence(), seed=seeds)
def test_streaming_is_the_masked_window(name: str, near: int, valid: Tensor, seed: int):
    forecaster, states = precise(name, near), scenes(seed)
    ours = streamed(forecaster, states, valid)
    for now in (0, TIME - 1):
        whole = window(forecaster, states, valid, now)
        same(
            {"rollout": ours["rollout"][:, now], "probs": ours["probs"], "features": ours["features"]},
            {"rollout": whole.rollout, "probs": whole.prior_logits.softmax(-1), "features": whole.features},
        )


def test_neighbours_matter():
    """Without this, the equalities above would hold for a model in which all, or none, are neighbours."""
    states, valid = scenes(0), torch.ones(BATCH, TIME, AGENTS).bool()
    all_agents, two = (streamed(precise("fast", k), states, valid) for k in (0, 2))
    for name, values in all_agents.items():
        assert (two[name] - values).abs().max() > 1e-2, name
    assert ((two["features"] != 0).any(-1).sum(-1) == 2).all()
    lists = {tuple(m.senders[0, 0].sort().values.tolist()) for m, _ in stream(precise("fast", 2), states, valid)}
    assert len(lists) > 1


def standing(*x_m: float) -> Tensor:
    """One instant of agents on a line, at rest."""
    states = torch.zeros(1, len(x_m), 4, dtype=torch.float64)
    states[0, :, 0] = torch.tensor(x_m)
    return states


def remembered(forecaster: DGVAE, *instants: Tensor) -> Memory:
    all_agents = torch.ones(instants[0].shape[:2]).bool()
    memory = forecaster.empty_memory(*instants[0].shape[:2])
    for states in instants:
        memory, _ = forecaster.observe(memory, states, all_agents)
    return memory


def of_pair(memory: Memory, receiver: int, sender: int) -> list[Tensor]:
    slot = memory.senders[0, receiver].tolist().index(sender)
    return [m[0, receiver, slot] for m in memory.pairs]


@pytest.mark.parametrize("context", [torch.enable_grad, torch.no_grad])
def test_a_pair_that_drops_out_and_comes_back_starts_fresh(context: Any):
    """Receiver 0 has one slot: agent 1 holds it, loses it to agent 2, and has it again."""
    forecaster = precise("fast", 1)
    near, away = standing(0.0, 3.0, -8.0, 60.0), standing(0.0, 20.0, -8.0, 60.0)
    with context():
        returned, fresh, stayed = (remembered(forecaster, *i) for i in ((near, away, near), (near,), (near,) * 3))
        meanwhile = remembered(forecaster, near, away)
    assert returned.senders[0, 0].tolist() == [1] and meanwhile.senders[0, 0].tolist() == [2]
    torch.testing.assert_close(of_pair(returned, 0, 1), of_pair(fresh, 0, 1), **EXACT)
    assert (of_pair(stayed, 0, 1)[0] - of_pair(fresh, 0, 1)[0]).abs().max() > 1e-2


@pytest.mark.parametrize("context", [torch.enable_grad, torch.no_grad])
def test_a_pair_that_stays_keeps_its_memory_in_another_slot(context: Any):
    """Receiver 0 has two slots; agent 1 moves from the first into the second, as agent 3 takes agent 2's place."""
    forecaster = precise("fast", 2)
    first, second = standing(0.0, 3.0, -8.0, 60.0), standing(0.0, 3.0, -80.0, 2.0)
    with context():
        before, after, fresh = (remembered(forecaster, *i) for i in ((first,), (first, second), (second,)))
    assert before.senders[0, 0].tolist() == [1, 2] and after.senders[0, 0].tolist() == [3, 1]
    torch.testing.assert_close(of_pair(after, 0, 3), of_pair(fresh, 0, 3), **EXACT)
    assert (of_pair(after, 0, 1)[0] - of_pair(fresh, 0, 1)[0]).abs().max() > 1e-2
    states, all_agents = torch.stack([first, second], dim=1), torch.ones(1, 2, 4).bool()
    dense = forecaster.encoder(
        forecaster.codec.inputs(states, all_agents),
        off_diagonal(pair_mask(all_agents) & among_nearest(states[..., :2], all_agents, 2)),
        *(torch.zeros(1, 4, 3, 5, dtype=torch.float64),) * 2,
        others(4),
    )
    torch.testing.assert_close(of_pair(after, 0, 1)[:2], [dense.hidden[0, 1, 0, 0], dense.cell[0, 1, 0, 0]], **EXACT)


# --- Symmetry, padding, frame -----------------------------------------------------------------------------------------


def everything(forecaster: DGVAE, states: Tensor, valid: Tensor) -> dict[str, Tensor]:
    whole = window(forecaster, states, valid, TIME - 2)
    parts = {"prior": whole.prior_logits, "posterior": whole.posterior_logits, "shown": whole.features}
    return streamed(forecaster, states, valid) | parts | {"one_step": whole.one_step, "free": whole.rollout[:, None]}


OF_AGENTS = {"rollout": slice(None), "one_step": slice(None), "free": slice(TIME - 2, TIME - 1)}
"""The outputs that are not of pairs, and the steps at which they are."""


@every_config
@settings(max_examples=5)
@given(valid=presence(), seed=seeds, order=st.permutations(range(AGENTS)))
def test_permuting_agents_permutes_outputs(name: str, valid: Tensor, seed: int, order: list[int]):
    forecaster, states = precise(name, 2, has_ego=False), scenes(seed)
    plain = everything(forecaster, states, valid)
    permuted = everything(forecaster, states[:, :, order], valid[:, :, order])
    for kind, values in plain.items():
        plain[kind] = values[:, :, order] if kind in OF_AGENTS else values[:, :, order][:, :, :, order]
    same(permuted, plain)


@every_config
@pytest.mark.parametrize("frame", [WORLD, ("centroid", "centroid")], ids=["world", "centroid"])
@settings(max_examples=3)
@given(valid=presence(), seed=seeds, padding=st.integers(1, 3))
def test_padding_is_invisible(name: str, frame: Any, valid: Tensor, seed: int, padding: int):
    forecaster, states = precise(name, 2, frame), scenes(seed)
    padded_valid = torch.cat([valid, torch.zeros(BATCH, TIME, padding).bool()], dim=2)
    padded_states = 100 * scenes(seed + 1, AGENTS + padding)
    padded_states[:, :, :AGENTS][valid] = states[valid]
    plain, padded = everything(forecaster, states, valid), everything(forecaster, padded_states, padded_valid)
    for kind, values in padded.items():
        padded[kind] = values[:, :, :AGENTS] if kind in OF_AGENTS else values[:, :, :AGENTS, :AGENTS]
    same(padded, plain)


@every_config
@pytest.mark.parametrize("agents", [1, 2])
def test_fewer_agents_than_slots(name: str, agents: int):
    states, valid = scenes(0, agents), random_presence(0, BATCH, TIME, agents)
    same(everything(precise(name, 4), states, valid), everything(precise(name), states, valid))


@pytest.mark.parametrize("present", [0, 1], ids=["no agent", "ego alone"])
def test_without_others_there_are_no_edges(present: int):
    forecaster, states = precise("rich", 2), scenes(0)
    valid = torch.zeros(BATCH, TIME, AGENTS).bool()
    valid[..., :present] = True
    memory, belief = list(stream(forecaster, states, valid))[-1]
    assert (memory.senders == NO_AGENT).all() and torch.equal(belief.senders, memory.senders)
    assert torch.equal(belief.edge_probs[..., 0], torch.ones(BATCH, AGENTS, 2).double())
    assert not belief.edge_features.any() and not any(m.any() for m in memory.pairs)
    assert not memory.nodes[0][:, present:].any()
    assert torch.isfinite(forecaster.rollout(belief, HORIZON, 3, torch.Generator().manual_seed(0)).states).all()


@every_config
def test_ten_kilometres_down_the_road_nothing_changes(name: str):
    forecaster, states = precise(name, 2, ROAD), scenes(0)
    valid, moved = random_presence(0, BATCH, TIME, AGENTS), states.clone()
    moved[..., 0] += 10_000.0
    here, there = everything(forecaster, states, valid), everything(forecaster, moved, valid)
    for kind, steps in OF_AGENTS.items():
        present = valid[:, steps].view(*there[kind].shape[:3], *[1] * (there[kind].ndim - 4))
        there[kind][..., 0] -= 10_000.0 * present
    same(there, here)


# --- Cost -------------------------------------------------------------------------------------------------------------


class Sizes(TorchDispatchMode):
    """Elements of the largest tensor that an operation gives; the distances by which neighbours are found apart."""

    def __init__(self, agents: int) -> None:
        super().__init__()
        self.largest = 0
        self.distances = (1, agents, agents)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = func(*args, **(kwargs or {}))
        for t in out if isinstance(out, tuple | list) else (out,):
            if isinstance(t, Tensor) and tuple(t.shape) not in (self.distances, self.distances[1:]):
                self.largest = max(self.largest, t.numel())
        return out


@every_config
@torch.no_grad()
def test_cost_grows_with_agents_and_not_with_pairs(name: str):
    forecaster, held, largest = precise(name, 3), [], []
    for agents in (32, 64, 128):
        states, valid = random_states(0, 1, 2, agents, 4).double(), torch.ones(1, 2, agents).bool()
        forecaster.rollout(list(stream(forecaster, states, valid))[-1][1], 2)  # the weights are folded by now
        with Sizes(agents) as sizes:
            memory, belief = list(stream(forecaster, states, valid))[-1]
            forecaster.rollout(belief, 2, 2, torch.Generator().manual_seed(0))
        held.append(sum(t.numel() for t in tensors([memory, belief])))
        largest.append(sizes.largest)
    for sizes_of in (held, largest):
        assert sizes_of[0] < sizes_of[1] <= 2 * sizes_of[0] and sizes_of[1] < sizes_of[2] <= 4 * sizes_of[0]


def tensors(value: Any) -> list[Tensor]:
    if isinstance(value, Tensor):
        return [value]
    if isinstance(value, Memory | Belief | Packed):
        value = tuple(vars(value).values())
    return [t for part in value for t in tensors(part)] if isinstance(value, tuple | list) else []


# --- Samples ----------------------------------------------------------------------------------------------------------


@pytest.fixture(params=[torch.enable_grad, torch.no_grad])
def gradients(request: pytest.FixtureRequest) -> Iterator[None]:
    """With the modules, and with the stepper."""
    with request.param():
        yield


@pytest.mark.usefixtures("gradients")
@pytest.mark.parametrize("frozen", [False, True], ids=["evolving", "frozen"])
def test_samples_belong_to_their_scene(frozen: bool):
    """Without noise every sample of a scene is that scene's own expected forecast, along its own neighbours."""
    forecaster, states = precise("rich", 2, frozen=frozen), scenes(0)
    _, belief = list(stream(forecaster, states, random_presence(0, BATCH, TIME, AGENTS)))[-1]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dgvae, "concrete_sample", lambda logits, *_: torch.softmax(logits, dim=-1))
        drawn = forecaster.rollout(belief, HORIZON, 3).states
    torch.testing.assert_close(drawn, drawn[:, :1].expand_as(drawn), **EXACT)
    assert not torch.allclose(drawn[0], drawn[1], atol=1.0)


@pytest.mark.parametrize(
    ("frozen", "samples"), [(False, 1), (False, 2), (True, 1)], ids=["expected", "samples", "frozen"]
)
@pytest.mark.parametrize("near", [2, AGENTS], ids=["some", "as many as agents"])
def test_a_dense_belief_rolls_out_as_the_original(near: int, frozen: bool, samples: int):
    forecaster = precise("fast", near, frozen=frozen)
    _, belief = list(stream(forecaster, scenes(0), torch.ones(BATCH, TIME, AGENTS).bool()))[-1]
    ours, expected = (
        forecaster.rollout(b, HORIZON, samples, torch.Generator().manual_seed(0)).states
        for b in (belief.dense(), belief)
    )
    torch.testing.assert_close(ours, expected, **EXACT)


# --- Streaming by id --------------------------------------------------------------------------------------------------


@cache
def near_road(near: int) -> DGVAE:
    return model(num_edge_types=3, frame=ROAD).variant(num_neighbours=near)


class NearStreams(Streams):
    """Agents sorted anew, that come and go, single resets, terminal scenes: as the masked window has it."""

    @initialize(near=st.integers(1, 3), first=st.tuples(*[any_scenes()] * ENVS))
    def begin(self, near: int, first: tuple[Scene, ...]) -> None:
        self.model = near_road(near)
        self.online = OnlineForecaster(self.model, ENVS, AGENTS_OF_A_SCENE)
        self.histories, self.judged = [[] for _ in range(ENVS)], []
        self.step(first)

    @invariant()
    def forecast_is_that_of_the_whole_history(self) -> None:
        ours = self.online.forecast()
        near = self.model.config.num_neighbours
        assert ours.senders is not None and ours.senders.shape[1:] == (AGENTS_OF_A_SCENE, near)
        assert len(ours.xy) == len(self.judged)
        for env, history in enumerate(self.judged):
            assert_same(envs_of(ours.dense(), [env]), reference(self.model, history), self.tolerance)


TestNearStreams = NearStreams.TestCase
TestNearStreams.settings = settings(max_examples=6, stateful_step_count=5)


def online(near: int, *history: Scene, agents: int = 4) -> Forecast:
    forecaster = OnlineForecaster(near_road(near), 1, agents)
    for now in history:
        forecaster.observe(batch(now))
    return forecaster.forecast()


def states_of(seed: int, *ids: int) -> dict[int, Any]:
    return dict(zip(ids, random_states(seed, len(ids), 4).double().tolist(), strict=True))


def test_memory_and_neighbours_follow_the_id_when_agents_are_sorted_anew():
    first, second = states_of(0, 0, 3, 7, 11), states_of(1, 0, 3, 7, 11)
    kept = online(1, scene(first, 4), scene(second, 4))
    moved = online(1, scene(first, 4), scene(second, 4, [0, 11, 7, 3]))
    new = torch.tensor([0, 3, 2, 1])
    assert torch.equal(moved.senders[0, new], new[kept.senders[0]])
    torch.testing.assert_close(moved.edge_features[:, new], kept.edge_features)
    torch.testing.assert_close(moved.edge_probs[:, new], kept.edge_probs)
    torch.testing.assert_close(moved.xy[:, :, new], kept.xy)
    assert (kept.edge_features - online(1, scene(second, 4)).edge_features).abs().max() > 1e-2  # there is a memory


def test_empty_places_receive_no_messages():
    """Columns behind the last agent are left out on the way in, and are back on the way out."""
    history = [scene(states_of(t, 0, 3, 7), 3) for t in range(3)]
    wide = [scene(states_of(t, 0, 3, 7), 6, [0, PADDING_ID, 7, 3, PADDING_ID, PADDING_ID]) for t in range(3)]
    ours, expected, at = online(2, *wide, agents=6), online(2, *history, agents=3), torch.tensor([0, 3, 2])
    assert ours.senders.shape == (1, 6, 2) and ours.edge_probs.shape == (1, 6, 2, 3)
    dense = ours.dense()
    pairs = (t[:, at][:, :, at] for t in (dense.edge_probs, dense.edge_features))
    assert_same(Forecast(ours.xy[:, :, at], *pairs, ours.valid[:, at]), expected.dense())
    for empty in (1, 4, 5):
        assert (ours.senders[:, empty] == NO_AGENT).all() and not ours.edge_features[:, empty].any()
        assert torch.equal(ours.edge_probs[:, empty, :, 0], torch.ones(1, 2))


def test_a_stream_ten_kilometres_down_the_road():
    """In float32, with more agents than torch.cdist compares one by one."""
    crowd = [scene(states_of(t, *range(30)), 30) for t in range(3)]
    moved = [Scene(s.states + [1e4, 0.0, 0.0, 0.0], s.ids, s.valid) for s in crowd]
    here, there = online(3, *crowd, agents=30), online(3, *moved, agents=30)
    assert torch.equal(here.senders, there.senders)
    assert_same(there.dense(), here.dense(), tolerance=1e-5)


def test_ego_alone_and_then_not():
    """Memory with no agents but the ego takes in others, and they leave again."""
    alone, crowd = scene(states_of(0, 0), 4), scene(states_of(1, 0, 3, 7, 11), 4)
    forecast = online(2, alone, crowd, alone)
    assert (forecast.senders == NO_AGENT).all() and torch.isfinite(forecast.xy).all()
    assert_same(online(2, alone, crowd, crowd).dense(), reference(near_road(2), [alone, crowd, crowd]))


# --- Frozen roll-outs -------------------------------------------------------------------------------------------------


def last(forecaster: DGVAE, seed: int = 0) -> Belief:
    return list(stream(forecaster, scenes(seed), random_presence(seed, BATCH, TIME, AGENTS)))[-1][1]


every_near = pytest.mark.parametrize("near", [0, 2], ids=["dense", "neighbours"])


@pytest.mark.usefixtures("gradients")
@every_config
@every_near
def test_frozen_begins_as_evolving_does(name: str, near: int):
    frozen, evolving = (
        forecaster.rollout(last(forecaster), HORIZON, 3, torch.Generator().manual_seed(0)).states
        for forecaster in (precise(name, near, frozen=f) for f in (True, False))
    )
    torch.testing.assert_close(frozen[..., 0, :], evolving[..., 0, :], **EXACT)
    assert (frozen - evolving)[..., 1:, :].abs().amax((0, 2, 3, 4)).min() > 1e-2  # each sample goes on otherwise


@pytest.mark.usefixtures("gradients")
@pytest.mark.parametrize("frozen", [False, True], ids=["evolving", "frozen"])
def test_frozen_graphs_are_drawn_once(frozen: bool, monkeypatch: pytest.MonkeyPatch):
    drawn: list[Tensor] = []

    def sample(logits: Tensor, *_: Any) -> Tensor:
        drawn.append(logits)
        return torch.softmax(logits, dim=-1)

    monkeypatch.setattr(dgvae, "concrete_sample", sample)
    forecaster = precise("rich", 2, frozen=frozen)
    times = 1 if frozen else HORIZON
    forecaster.rollout(last(forecaster), HORIZON, 1)
    assert not drawn
    forecaster.rollout(last(forecaster), HORIZON, 4)
    assert len(drawn) == times
    drawn.clear()
    forecaster.window(scenes(0), random_presence(0, BATCH, TIME, AGENTS), torch.tensor([1, 3]), HORIZON)
    pair = (AGENTS, AGENTS - 1, 3)  # once under the posterior, for the whole window; then for the free run
    assert [t.shape for t in drawn] == [(BATCH, TIME, *pair)] + [(BATCH, *pair)] * times


@pytest.mark.parametrize("samples", [1, 3])
def test_frozen_steps_have_the_same_graph_and_features(samples: int, monkeypatch: pytest.MonkeyPatch):
    shown: list[tuple[Tensor, Tensor]] = []
    messages = Modules.messages

    def watched(self: Modules, inputs: Tensor, graph: Any, weights: Tensor, share: Tensor, own: Any) -> Tensor:
        shown.append((weights, share))
        return messages(self, inputs, graph, weights, share, own)

    forecaster = precise("fast", 2, frozen=True)
    belief = last(forecaster)
    share = forecaster.decoder.feature_share(belief.edge_features)
    monkeypatch.setattr(Modules, "messages", watched)
    forecaster.rollout(belief, HORIZON, samples, torch.Generator().manual_seed(0))
    expected, drawn = shown[: HORIZON - 1], shown[HORIZON - 1 :]  # the expected run's first step was taken before
    for graph, shared in expected:
        assert torch.equal(graph, belief.edge_probs) and torch.equal(shared, share)
    assert len(drawn) == (HORIZON if samples > 1 else 0)
    for graph, shared in drawn:
        assert torch.equal(graph, drawn[0][0])
        assert torch.equal(shared, share.repeat_interleave(samples - 1, dim=0))


@pytest.mark.usefixtures("gradients")
@every_near
def test_frozen_roll_out_against_a_loop(near: int):
    forecaster, states = precise("fast", near, frozen=True), scenes(0)
    valid = random_presence(0, BATCH, TIME, AGENTS)
    memory, belief = list(stream(forecaster, states, valid))[-1]
    dense, decoder, node = belief.dense(), forecaster.decoder, memory.nodes[0]
    expected = [forecaster.rollout(belief, 1).states[:, 0, :, 0]]
    for _ in range(HORIZON - 1):
        inputs = forecaster.codec.inputs(expected[-1], belief.valid)
        messages = decoder.messages(inputs, pair_mask(belief.valid), dense.edge_probs, dense.edge_features)
        node = decoder.gru(messages.flatten(0, 1), node.flatten(0, 1)).view(node.shape)
        expected.append(forecaster.codec.advance(expected[-1], decoder.change(node)))
    ours, there = forecaster.rollout(belief, HORIZON).states[:, 0], belief.valid
    torch.testing.assert_close(ours[there], torch.stack(expected, dim=2)[there], **EXACT)


@every_config
@every_near
@settings(max_examples=4)
@given(valid=presence(), seed=seeds)
def test_frozen_streaming_is_the_frozen_window(name: str, near: int, valid: Tensor, seed: int):
    forecaster, states = precise(name, near, frozen=True), scenes(seed)
    ours = streamed(forecaster, states, valid)["rollout"]
    for now in (0, TIME - 1):
        torch.testing.assert_close(ours[:, now], window(forecaster, states, valid, now).rollout, **EXACT)


# --- Variants ---------------------------------------------------------------------------------------------------------


def test_a_variant_has_the_same_weights_and_only_what_was_changed_is_different():
    original = precise("rich")
    before = {k: v.clone() for k, v in original.state_dict().items()}
    other = original.variant(num_neighbours=2, rollout_graph="frozen")
    assert other.config == replace(original.config, num_neighbours=2, rollout_graph="frozen")
    assert original.config == replace(CONFIGS["rich"], num_neighbours=0)
    assert (other.spec, other.horizon_steps) == (original.spec, original.horizon_steps)
    for name, value in other.state_dict().items():
        assert torch.equal(value, before[name])
    states, valid = scenes(0), random_presence(0, BATCH, TIME, AGENTS)
    same(streamed(other, states, valid), streamed(precise("rich", 2, frozen=True), states, valid))
    with torch.no_grad():
        for parameter in other.parameters():
            parameter.mul_(2.0)
    assert all(torch.equal(value, before[name]) for name, value in original.state_dict().items())


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("trainable", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_variant_is_in_the_state_of_the_original(training: bool, trainable: bool, dtype: torch.dtype):
    original = DGVAE(spec(), FAST_LIKE).to(dtype).train(training).requires_grad_(trainable)
    other = original.variant(num_neighbours=1)
    assert other.training is training and other.encoder.training is training
    assert {(p.dtype, p.requires_grad) for p in other.parameters()} == {(dtype, trainable)}
    assert {b.dtype for b in other.buffers()} == {dtype}


def test_a_variant_may_change_how_graphs_are_drawn():
    original = precise("fast")
    for change in ({"temperature": 5.0}, {"hard_samples": True}):
        forecasts = [
            forecaster.rollout(last(forecaster), HORIZON, 2, torch.Generator().manual_seed(0)).states
            for forecaster in (original, original.variant(**change))
        ]
        assert torch.equal(forecasts[0][:, 0], forecasts[1][:, 0])
        assert (forecasts[0][:, 1] - forecasts[1][:, 1]).abs().max() > 1e-2


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rnn_dim": 6}, r"a network with \{'rnn_dim': 6\} has other weights; train one instead"),
        ({"edge_feature_dim": 0}, "has other weights; train one instead"),
        ({"substeps": 2}, "has other weights; train one instead"),
        ({"num_neighbours": -1}, "num_neighbours must not be negative, got -1"),
        ({"num_neighbors": 2}, "DGVAEConfig has no field 'num_neighbors'"),
    ],
)
def test_a_variant_that_is_another_network_is_refused(changes: dict[str, Any], message: str):
    with pytest.raises(UserError, match=message):
        precise("fast").variant(**changes)


def test_a_variant_draws_nothing():
    before = torch.get_rng_state()
    precise("fast").variant(num_neighbours=2)
    assert torch.equal(torch.get_rng_state(), before)


# --- Config -----------------------------------------------------------------------------------------------------------


def test_config_refuses():
    with pytest.raises(UserError, match="num_neighbours must not be negative, got -1"):
        DGVAEConfig(num_neighbours=-1)
    with pytest.raises(UserError, match="innovation_rounds needs every pair and its reverse; set num_neighbours to 0"):
        DGVAEConfig(num_neighbours=1, innovation_rounds=1)
    assert DGVAEConfig(num_neighbours=0, innovation_rounds=1).num_neighbours == 0


def test_config_refuses_an_unknown_graph():
    """As when a checkpoint is read where types are not checked; here it would be refused earlier."""
    config = DGVAEConfig()
    object.__setattr__(config, "rollout_graph", "froze")
    with pytest.raises(UserError, match="rollout_graph must be one of evolving, frozen, got 'froze'"):
        config.__post_init__()


def test_neither_is_on_by_default():
    assert (DGVAEConfig().num_neighbours, DGVAEConfig().rollout_graph) == (0, "evolving")
