"""Streaming by id: agents in any order that come and go, episodes that end env by env.

The reference never streams: it lays out the whole episode of an environment as one window in which every stay of an
agent has its own column, and encodes it in one call.
"""

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Any, Literal

import numpy as np
import pytest
import torch
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from torch import Tensor

from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.dgvae import DGVAE
from predictor.dgvae import model as dgvae
from predictor.forecaster import Futures
from predictor.online import OnlineForecaster
from predictor.scene import PADDING_ID, Forecast, Scene, SceneBatch
from predictor.support.errors import ProtocolError, UserError
from tests.predictor.helpers import ROAD, batch, model, random_states, scene, spec

ENVS, AGENTS, EGO = 3, 4, 0
OTHERS = (3, 7, 11, 20)  # more than fit in a scene beside the ego
History = list[Scene]


def assert_same(ours: Forecast, expected: Forecast, tolerance: float = 1e-5) -> None:
    assert torch.equal(ours.valid, expected.valid)
    torch.testing.assert_close(ours.edge_probs, expected.edge_probs, rtol=0, atol=tolerance)
    torch.testing.assert_close(ours.edge_features, expected.edge_features, rtol=0, atol=tolerance)
    # a free run through untrained weights amplifies what is left: 1 % of a position, where edges agree to `tolerance`
    torch.testing.assert_close(ours.xy, expected.xy, rtol=1e-5 if tolerance < 1e-4 else 1e-2, atol=10 * tolerance)
    assert (ours.mode_probs is None) == (expected.mode_probs is None)
    if ours.mode_probs is not None and expected.mode_probs is not None:
        torch.testing.assert_close(ours.mode_probs, expected.mode_probs, rtol=0, atol=tolerance)


def envs_of(forecast: Forecast, envs: Sequence[int]) -> Forecast:
    chosen = list(envs)
    return Forecast(
        forecast.xy[chosen],
        forecast.edge_probs[chosen],
        forecast.edge_features[chosen],
        forecast.valid[chosen],
        mode_probs=None if forecast.mode_probs is None else forecast.mode_probs[chosen],
    )


def reference(forecaster: DGVAE, history: History, num_samples: int = 1) -> Forecast:
    """The forecast after an episode's scenes, from one pass over all of them; several samples are modes."""
    column: dict[tuple[int, int], int] = {}  # (id, step at which this stay began) → column; the ego's is the first
    began: dict[int, int] = {}
    places: list[list[int]] = []
    for t, now in enumerate(history):
        present = now.ids[now.valid].tolist()
        began = {agent: began.get(agent, t) for agent in present}
        places.append([column.setdefault((agent, began[agent]), len(column)) for agent in present])
    states = np.zeros((1, len(history), len(column), 4))
    valid = np.zeros((1, len(history), len(column)), dtype=np.bool_)
    for t, (now, place) in enumerate(zip(history, places, strict=True)):
        states[0, t, place] = now.states[now.valid]
        valid[0, t, place] = True
    states[..., 0] -= states[:, :, :1, 0] * valid  # the road's frame
    tensor, present_ = torch.from_numpy(states.astype(np.float32)), torch.from_numpy(valid)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dgvae, "concrete_sample", lambda logits, *_: torch.softmax(logits, dim=-1))
        last_observed = torch.tensor([len(history) - 1])
        window = forecaster.window(tensor, present_, last_observed, forecaster.horizon_steps, num_modes=num_samples)
    modes = window.modes or Futures(window.rollout[:, None])
    last, place = history[-1], places[-1]
    xy = torch.zeros(1, num_samples, AGENTS, forecaster.horizon_steps, 2)
    probs = torch.zeros(1, AGENTS, AGENTS, forecaster.num_edge_types)
    probs[..., 0] = 1.0
    features = torch.zeros(1, AGENTS, AGENTS, forecaster.edge_feature_dim)
    places = np.flatnonzero(last.valid)
    xy[0, :, places] = modes.states[0][:, place, :, :2] - tensor[0, -1, 0, :2]
    shares = None
    if modes.mode_probs is not None:
        shares = torch.full((1, num_samples, AGENTS), 1 / num_samples)
        shares[0, :, places] = modes.mode_probs[0][:, place]
    probs[0, places[:, None], places] = window.prior_logits[0, -1][place][:, place].softmax(-1)
    features[0, places[:, None], places] = window.features[0, -1][place][:, place]
    return Forecast(xy, probs, features, torch.from_numpy(last.valid)[None], mode_probs=shares)


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """The ego and some others, at any places, with states that never repeat."""
    places: list[int] = draw(st.permutations([*OTHERS, PADDING_ID, PADDING_ID]))
    order = [EGO, *places[: AGENTS - 1]]
    values = random_states(draw(st.integers(0, 2**16)), AGENTS, 4).double().numpy()
    return scene({agent: values[place] for place, agent in enumerate(order) if agent != PADDING_ID}, AGENTS, order)


some_envs = st.lists(st.sampled_from(range(ENVS)), unique=True, min_size=1).map(np.array)


class Streams(RuleBasedStateMachine):
    """Everything that can happen to the parallel environments, in any order."""

    size: Literal["fast", "rich", "plural"] = "fast"
    tolerance = 1e-5
    num_samples = 1

    @initialize(first=st.tuples(*[scenes()] * ENVS))
    def begin(self, first: tuple[Scene, ...]) -> None:
        self.model = model(self.size, num_edge_types=3, frame=ROAD)
        self.online = OnlineForecaster(self.model, ENVS, AGENTS)
        self.histories: list[History] = [[] for _ in range(ENVS)]
        self.judged: list[History] = []
        self.step(first)

    @rule(now=st.tuples(*[scenes()] * ENVS))
    def step(self, now: tuple[Scene, ...]) -> None:
        self.online.observe(batch(*now))
        self.histories = [[*past, each] for past, each in zip(self.histories, now, strict=True)]
        self.judged = self.histories

    @rule(envs=some_envs, now=st.tuples(*[scenes()] * ENVS))
    def step_some_envs(self, envs: np.ndarray, now: tuple[Scene, ...]) -> None:
        self.online.observe(batch(*now[: len(envs)]), envs)
        for env, each in zip(envs, now, strict=False):
            self.histories[env] = [*self.histories[env], each]
        self.judged = [self.histories[env] for env in envs]

    @rule(envs=some_envs, now=st.tuples(*[scenes()] * ENVS))
    def reset_some_envs(self, envs: np.ndarray, now: tuple[Scene, ...]) -> None:
        self.online.reset(envs)
        self.histories = [[] if env in envs else past for env, past in enumerate(self.histories)]
        self.step(now)

    @rule(ended=some_envs, now=st.tuples(*[scenes()] * ENVS), successors=st.tuples(*[scenes()] * ENVS))
    def step_over_a_boundary(self, ended: np.ndarray, now: tuple[Scene, ...], successors: tuple[Scene, ...]) -> None:
        self.online.observe_boundary(batch(*now), ended, batch(*successors[: len(ended)]))
        terminal = [[*past, each] for past, each in zip(self.histories, now, strict=True)]
        fresh = [[each] for each in successors[: len(ended)]]
        self.judged = terminal + fresh
        self.histories = list(terminal)
        for env, history in zip(ended, fresh, strict=True):
            self.histories[env] = history

    @invariant()
    def forecast_is_that_of_the_whole_history(self) -> None:
        ours = self.online.forecast(num_samples=self.num_samples)
        assert len(ours.xy) == len(self.judged)
        for env, history in enumerate(self.judged):
            assert_same(envs_of(ours, [env]), reference(self.model, history, self.num_samples), self.tolerance)


class RichStreams(Streams):
    """The same with every kind of memory: running means and their counts, latest inputs, corrected pair memories."""

    size = "rich"
    tolerance = 1e-4  # corrections amplify rounding


class PluralStreams(Streams):
    """The same with modes: each of them, and their probabilities, are those of the whole history."""

    size = "plural"
    num_samples = 3


TestStreams = Streams.TestCase
TestStreams.settings = settings(max_examples=10, stateful_step_count=8)
TestRichStreams = RichStreams.TestCase
TestRichStreams.settings = settings(max_examples=4, stateful_step_count=6)
TestPluralStreams = PluralStreams.TestCase
TestPluralStreams.settings = settings(max_examples=6, stateful_step_count=6)


# --- The same, one fact at a time -------------------------------------------------------------------------------------


@pytest.fixture
def forecaster() -> DGVAE:
    return model(num_edge_types=3, frame=ROAD)


def online(forecaster: DGVAE, envs: int = 1) -> OnlineForecaster:
    return OnlineForecaster(forecaster, envs, AGENTS)


def states_of(seed: int, *agents: int) -> dict[int, Sequence[float]]:
    values = random_states(seed, len(agents), 4).double().tolist()
    return dict(zip(agents, values, strict=True))


def after(forecaster: DGVAE, *history: Scene) -> Forecast:
    """A fresh stream's forecast after these scenes."""
    stream = online(forecaster)
    for now in history:
        stream.observe(batch(now))
    return stream.forecast()


def differ(one: Forecast, other: Forecast, env: int = 0) -> float:
    return (one.edge_features[env] - other.edge_features[env]).abs().max().item()


def test_forecast_before_any_observation_is_refused(forecaster: DGVAE):
    with pytest.raises(ProtocolError, match=r"forecast\(\) needs an observation; call observe\(\) first"):
        online(forecaster).forecast()


@pytest.mark.parametrize("num_samples", [1, 3])
def test_a_network_that_is_trained_may_read_forecasts(forecaster: DGVAE, num_samples: int):
    stream = online(forecaster)
    stream.observe(batch(scene(states_of(0, 0, 3), AGENTS)))
    forecast = stream.forecast(num_samples=num_samples)
    network = torch.nn.Linear(2, 1)
    network(forecast.xy).sum().backward()
    assert network.weight.grad is not None and network.weight.grad.abs().sum() > 0
    for field in fields(Forecast):
        if (value := getattr(forecast, field.name)) is not None:
            value.zero_()  # in place, which tensors of inference mode refuse
    again = stream.forecast(num_samples=num_samples)
    assert again.xy.abs().sum() > 0 and not again.xy.requires_grad


@pytest.mark.parametrize("kind", [np.uint8, np.uint32, np.uint64, np.int32])
def test_ids_of_any_width_follow_agents(forecaster: DGVAE, kind: Any):
    """One observation of one environment has ids beyond the width of the first."""
    plain, narrow = online(forecaster, 2), online(forecaster, 2)
    for seed in range(2):
        now = batch(scene(states_of(seed, 0, 3), AGENTS), scene(states_of(seed + 5, 0, 7), AGENTS))
        plain.observe(now)
        narrow.observe(replace(now, ids=np.where(now.valid, now.ids, 0).astype(kind)))
    far = batch(scene({**states_of(3, 0), 2**32 + 7: states_of(4, 0)[0]}, AGENTS))
    for stream in (plain, narrow):
        stream.observe(far, np.array([1]))
        assert stream._ids[1].max() == 2**32 + 7
    assert_same(narrow.forecast(), plain.forecast())


def test_unsigned_ids_stand_behind_absent_agents():
    here = scene(states_of(0, 0, 3), AGENTS - 1)
    narrow = replace(here, ids=np.where(here.valid, here.ids, 0).astype(np.uint8)).behind_absent(1)
    assert narrow.ids.tolist()[0] == PADDING_ID and narrow.ids[narrow.valid].tolist() == here.ids[here.valid].tolist()


def test_what_is_written_into_a_scene_later_reaches_nothing(forecaster: DGVAE):
    now, stream = batch(scene(states_of(0, *range(AGENTS)), AGENTS)), online(forecaster)
    stream.observe(now)
    before = stream.forecast()
    for array in (now.states, now.ids, now.valid):
        array[:] = 0
    assert_same(stream.forecast(), before)


def test_arrays_may_be_mirrored_or_read_only(forecaster: DGVAE):
    now, stream, other = batch(scene(states_of(0, *range(AGENTS)), AGENTS)), online(forecaster), online(forecaster)
    other.observe(now)
    mirrored = {f.name: np.ascontiguousarray(getattr(now, f.name)[::-1])[::-1] for f in fields(now)}
    for array in mirrored.values():
        array.flags.writeable = False
    stream.observe(SceneBatch(**mirrored))
    assert_same(stream.forecast(), other.forecast())


@pytest.mark.parametrize(
    ("heading_rad", "message"),
    [
        (np.array([np.nan]), r"heading_rad of scenes must be finite, got nan \(scene 0\)"),
        (np.zeros((1, 1)), r"heading_rad of 1 scenes must have the shape \(1,\), got \(1, 1\)"),
        (np.array(["north"]), "heading_rad of scenes must be a NumPy array of numbers, got <U5"),
        (None, "heading_rad of scenes must be a NumPy array of numbers, got NoneType"),
    ],
)
def test_headings_that_are_none_are_refused(forecaster: DGVAE, heading_rad: Any, message: str):
    now = replace(batch(scene(states_of(0, 0, 3), AGENTS)), heading_rad=heading_rad)
    with pytest.raises(UserError, match=message):
        online(forecaster).observe(now)


def test_a_state_that_is_infinite_in_half_precision_is_refused(forecaster: DGVAE):
    now = batch(scene(states_of(0, 0, 3), AGENTS))
    now = replace(now, states=now.states.astype(np.float16))
    now.states[0, 1, 0] = np.inf
    with pytest.raises(UserError, match="states must be finite"):
        online(forecaster).observe(now)


def test_a_forecaster_that_gives_something_else_is_named_in_a_line():
    class Odd(ConstantVelocity):
        change: Callable[[Futures], Any]

        def rollout(self, *arguments: Any, **named: Any) -> Any:
            return self.change(super().rollout(*arguments, **named))

    for change, message in (
        (lambda futures: Futures(futures.states[..., :2, :]), "was asked for 1 samples of 5 steps and gave 1 of 2"),
        (lambda futures: Futures(futures.states[:, :0]), "was asked for 1 samples of 5 steps and gave 0 of 5"),
        (lambda futures: futures.states, "rollout of a forecaster must return Futures, got Tensor"),
        (lambda futures: Futures(futures.states.numpy()), "Futures must hold tensors, got ndarray"),  # type: ignore[arg-type]
        (lambda futures: Futures(futures.states * torch.nan), "forecasts numbers that are not finite; its weights are"),
        (
            lambda futures: Futures(futures.states, torch.full(futures.states.shape[:3], torch.nan)),
            "forecasts numbers that are not finite; its weights are",
        ),
    ):
        forecaster = Odd(spec())
        forecaster.change = change
        stream = online(forecaster)
        stream.observe(batch(scene(states_of(0, 0, 1), AGENTS)))
        with pytest.raises(UserError, match=message):
            stream.forecast(5)


def test_what_is_said_of_absent_agents_may_be_anything():
    class Odd(ConstantVelocity):
        def rollout(self, belief: Any, *arguments: Any, **named: Any) -> Futures:
            states = super().rollout(belief, *arguments, **named).states
            probs = torch.where(belief.valid[:, None], 1.0, torch.nan).expand(states.shape[:3])
            return Futures(states, probs)

    stream = online(Odd(spec()))
    stream.observe(batch(scene(states_of(0, 0, 3, 7), AGENTS, [0, PADDING_ID, 7, 3])))
    assert not stream.forecast(5).valid[0, 1]


def test_history_follows_the_id_when_places_are_sorted_anew(forecaster: DGVAE):
    first, second = states_of(0, 0, 3, 7), states_of(1, 0, 3, 7)
    kept = after(forecaster, scene(first, AGENTS), scene(second, AGENTS))
    moved = after(forecaster, scene(first, AGENTS), scene(second, AGENTS, [0, PADDING_ID, 7, 3]))
    places = torch.tensor([0, 3, 2])
    torch.testing.assert_close(moved.xy[:, :, places], kept.xy[:, :, :3])
    torch.testing.assert_close(moved.edge_features[:, places][:, :, places], kept.edge_features[:, :3, :3])
    torch.testing.assert_close(moved.edge_probs[:, places][:, :, places], kept.edge_probs[:, :3, :3])


def test_nothing_of_an_agent_that_left_reaches_a_new_agent_at_its_place(forecaster: DGVAE):
    first, second = states_of(0, 0, 3), states_of(1, 0, 7)
    heir = after(forecaster, scene(first, AGENTS), scene(second, AGENTS))
    newcomer = after(forecaster, scene({0: first[0]}, AGENTS), scene(second, AGENTS))
    torch.testing.assert_close(heir.edge_features[:, 1], newcomer.edge_features[:, 1])
    torch.testing.assert_close(heir.edge_probs[:, :2, :2], newcomer.edge_probs[:, :2, :2])
    torch.testing.assert_close(heir.xy[:, :, 1, 0], newcomer.xy[:, :, 1, 0])  # later steps depend on where the ego goes
    same_id = after(forecaster, scene(first, AGENTS), scene({0: second[0], 3: second[7]}, AGENTS))
    assert differ(same_id, heir) > 1e-2  # an id that stayed would have been another matter


@pytest.mark.parametrize("away", [1, 3])
def test_agent_that_comes_back_starts_fresh(forecaster: DGVAE, away: int):
    first, last = states_of(0, 0, 3), states_of(9, 0, 3)
    gone = [scene(states_of(t, 0), AGENTS) for t in range(1, 1 + away)]
    returned = after(forecaster, scene(first, AGENTS), *gone, scene(last, AGENTS))
    newcomer = after(forecaster, scene({0: first[0]}, AGENTS), *gone, scene(last, AGENTS))
    torch.testing.assert_close(returned.edge_features, newcomer.edge_features)
    torch.testing.assert_close(returned.edge_probs, newcomer.edge_probs)
    torch.testing.assert_close(returned.xy[:, :, 1, 0], newcomer.xy[:, :, 1, 0])


def test_agent_that_is_not_valid_is_forgotten_even_if_its_id_stays(forecaster: DGVAE):
    first, last = states_of(0, 0, 3), states_of(9, 0, 3)
    hidden = scene(states_of(1, 0, 3), AGENTS)
    hidden.valid[1] = False
    returned = after(forecaster, scene(first, AGENTS), hidden, scene(last, AGENTS))
    alone = scene({0: tuple(hidden.states[0])}, AGENTS)
    torch.testing.assert_close(
        returned.edge_features,
        after(forecaster, scene({0: first[0]}, AGENTS), alone, scene(last, AGENTS)).edge_features,
    )


def test_reset_of_one_env_changes_that_env_only(forecaster: DGVAE):
    now, then = [scene(states_of(env, 0, 3, 7), AGENTS) for env in range(3)], scene(states_of(9, 0, 3, 7), AGENTS)
    stream, untouched = online(forecaster, 3), online(forecaster, 3)
    for each in (stream, untouched):
        each.observe(batch(*now))
    stream.reset(np.array([1]))
    for each in (stream, untouched):
        each.observe(batch(then, then, then))
    ours, expected = stream.forecast(), untouched.forecast()
    assert_same(envs_of(ours, [0, 2]), envs_of(expected, [0, 2]), tolerance=1e-6)
    assert_same(envs_of(ours, [1]), after(forecaster, then))
    assert differ(ours, expected, env=1) > 1e-2


def test_a_mask_chooses_the_environments_that_it_marks(forecaster: DGVAE):
    scenes = batch(*(scene(states_of(seed, 0, 1), AGENTS) for seed in range(ENVS)))
    mask = np.arange(ENVS) == ENVS - 1
    shown = []
    for chosen in (mask, np.flatnonzero(mask)):
        stream = online(forecaster, ENVS)
        stream.observe(scenes)
        stream.reset(chosen)
        stream.observe(scenes[np.flatnonzero(mask)], chosen)
        stream.observe(scenes)
        shown.append(stream.forecast().xy)
    assert torch.equal(*shown)


@pytest.mark.unchecked
@pytest.mark.parametrize(
    ("envs", "message"),
    [
        (np.array([True]), rf"a mask of environments needs the shape \({ENVS},\), got \(1,\)"),
        (np.array([ENVS]), rf"envs must be different numbers from 0 to {ENVS - 1}, got \[{ENVS}\]"),
        (np.array([-1]), r"envs must be different numbers from 0 to .*, got \[-1\]"),
        (np.array([0, 0]), r"envs must be different numbers from 0 to .*, got \[0, 0\]"),
        (0, "envs must be a list of whole numbers, or a mask, got 0"),
        (np.array([0.7]), "envs must be a list of whole numbers, or a mask, got "),
        (["a"], r"envs must be a list of whole numbers, or a mask, got \['a'\]"),
        ([[0]], r"envs must be a list of whole numbers, or a mask, got \[\[0\]\]"),
    ],
)
def test_environments_that_are_not_there_are_refused(forecaster: DGVAE, envs: Any, message: str):
    stream = online(forecaster, ENVS)
    with pytest.raises(UserError, match=message):
        stream.reset(envs)


@pytest.mark.parametrize("wrong", [{"envs": -1}, {"agents": 0}, {"max_rows": 0}])
def test_numbers_of_scenes_and_agents_are_whole(wrong: dict[str, Any]):
    (name, number), *_ = wrong.items()
    with pytest.raises(UserError, match=f"{name} must be a whole number of at least 1, got {number}"):
        OnlineForecaster(ConstantVelocity(spec()), **{"envs": 1, "agents": 3} | wrong)


def test_an_agent_without_an_id_is_refused_from_the_first_scene_on(forecaster: DGVAE):
    nameless = scene(states_of(0, 0, 3), AGENTS)
    nameless = Scene(
        nameless.states, np.full(AGENTS, PADDING_ID), nameless.valid
    )  # as none were before the first scene
    with pytest.raises(UserError, match="ids of valid agents must be non-negative, got -1"):
        online(forecaster).observe(batch(nameless))


def test_a_state_beyond_float32_is_refused_and_the_history_stays(forecaster: DGVAE):
    good = scene(states_of(0, 0, 3), AGENTS)
    far = Scene(good.states.copy(), good.ids, good.valid)
    far.states[1, 0] = 1e39
    one, other = online(forecaster), online(forecaster)
    for stream in (one, other):
        stream.observe(batch(good))
    with pytest.raises(UserError, match=r"states must be at most 1e\+30 in size, got .*agent 1"):
        one.observe(batch(far))
    for stream in (one, other):
        stream.observe(batch(scene(states_of(1, 0, 3), AGENTS)))
    assert_same(one.forecast(), other.forecast())


@pytest.mark.unchecked
@pytest.mark.parametrize("wrong", [0, np.random.default_rng(0), [torch.Generator()], "seed"])
def test_another_kind_of_generator_is_refused(forecaster: DGVAE, wrong: Any):
    stream = online(forecaster)
    stream.observe(batch(scene(states_of(0, 0, 3), AGENTS)))
    needed = "generator must be one torch.Generator, or a list of numpy.random.Generator"
    with pytest.raises(UserError, match=needed):
        stream.forecast(num_samples=3, generator=wrong)


def test_reset_of_all_envs(forecaster: DGVAE):
    now, then = scene(states_of(0, 0, 3), AGENTS), scene(states_of(9, 0, 3), AGENTS)
    stream = online(forecaster, 2)
    stream.observe(batch(now, now))
    stream.reset()
    stream.observe(batch(then, then))
    assert_same(stream.forecast(), envs_of(after(forecaster, then), [0, 0]))


def test_reset_of_no_env_changes_nothing(forecaster: DGVAE):
    now, then = scene(states_of(0, 0, 3), AGENTS), scene(states_of(9, 0, 3), AGENTS)
    stream = online(forecaster)
    stream.observe(batch(now))
    stream.reset(np.array([], dtype=np.int64))
    stream.observe(batch(then))
    assert_same(stream.forecast(), after(forecaster, now, then))


def test_boundary_is_the_last_scene_then_reset_then_the_first_scene(forecaster: DGVAE):
    past, last, following = ([scene(states_of(9 * k + r, 0, 3, 7), AGENTS) for r in range(3)] for k in range(3))
    first = scene(states_of(77, 0, 3), AGENTS)
    at_once, step_by_step = online(forecaster, 3), online(forecaster, 3)
    for each in (at_once, step_by_step):
        each.observe(batch(*past))
    at_once.observe_boundary(batch(*last), np.array([2]), batch(first))
    ours = at_once.forecast()
    assert ours.valid.tolist()[3] == [True, True, False, False]
    step_by_step.observe(batch(*last))
    assert_same(envs_of(ours, [0, 1, 2]), step_by_step.forecast())
    step_by_step.reset(np.array([2]))
    step_by_step.observe(batch(first), np.array([2]))
    assert_same(envs_of(ours, [3]), step_by_step.forecast())
    assert_same(envs_of(ours, [3]), after(forecaster, first))
    for each in (at_once, step_by_step):
        each.observe(batch(*following))
    assert_same(at_once.forecast(), step_by_step.forecast())


def test_batch_is_one_by_one(forecaster: DGVAE):
    histories = [
        [scene(states_of(10 * env + t, 0, 3, *OTHERS[1 : 1 + env]), AGENTS) for t in range(4)] for env in range(3)
    ]
    stream = online(forecaster, 3)
    for now in zip(*histories, strict=True):
        stream.observe(batch(*now))
    together = stream.forecast(horizon_steps=5)
    assert together.xy.shape == (3, 1, AGENTS, 5, 2)
    for env, history in enumerate(histories):
        alone = online(forecaster)
        for each in history:
            alone.observe(batch(each))
        assert_same(envs_of(together, [env]), alone.forecast(horizon_steps=5))


def test_observing_some_envs_leaves_the_others_alone(forecaster: DGVAE):
    past, last = ([scene(states_of(9 * k + r, 0, 3, 7), AGENTS) for r in range(3)] for k in range(2))
    extra = scene(states_of(50, 0, 7, 3), AGENTS)
    stream = online(forecaster, 3)
    stream.observe(batch(*past))
    stream.observe(batch(extra), np.array([1]))
    assert_same(stream.forecast(), after(forecaster, past[1], extra))
    stream.observe(batch(*last))
    assert_same(envs_of(stream.forecast(), [0]), after(forecaster, past[0], last[0]))
    assert_same(envs_of(stream.forecast(), [1]), after(forecaster, past[1], extra, last[1]))
    assert_same(envs_of(stream.forecast(), [2]), after(forecaster, past[2], last[2]))


def test_scenes_are_not_changed(forecaster: DGVAE):
    now = batch(scene(states_of(0, 0, 3), AGENTS))
    before = SceneBatch(now.states.copy(), now.ids.copy(), now.valid.copy(), now.heading_rad.copy())
    stream = online(forecaster)
    stream.observe(now)
    stream.forecast()
    np.testing.assert_array_equal(now.states, before.states)
    np.testing.assert_array_equal(now.ids, before.ids)


# --- Frame ------------------------------------------------------------------------------------------------------------


def shifted(now: Scene, *, x_m: float = 0.0, y_m: float = 0.0) -> Scene:
    states = now.states.copy()
    states[now.valid, :2] += [x_m, y_m]
    return Scene(states, now.ids, now.valid)


def drive(steps: int = 4) -> list[Scene]:
    """A few scenes in which the ego moves on by 20 m in each step."""
    return [shifted(scene(states_of(t, 0, 3, 7), AGENTS), x_m=20.0 * t) for t in range(steps)]


def test_ten_kilometres_down_the_road_nothing_changes(forecaster: DGVAE):
    here, there = after(forecaster, *drive()), after(forecaster, *(shifted(s, x_m=10_000.0) for s in drive()))
    assert_same(there, here, tolerance=1e-6)


def test_positions_that_single_precision_cannot_tell_apart_are_refused(forecaster: DGVAE):
    """On a map whose origin is thousands of kilometres away; along the road the ego's position is subtracted before."""
    after(forecaster, *(shifted(s, x_m=5_400_000.0) for s in drive()))
    far = batch(shifted(drive()[0], y_m=-5_400_000.0))
    with pytest.raises(UserError, match=r"states of scenes: y_m lies up to 54000[.\d]* .* steps of 0.5; subtract"):
        online(forecaster).observe(far)


def test_across_the_road_it_matters(forecaster: DGVAE):
    here, aside = after(forecaster, *drive()), after(forecaster, *(shifted(s, y_m=10.0) for s in drive()))
    assert differ(here, aside) > 1e-2


def test_on_a_fixed_map_it_matters_where_the_scene_is():
    on_map = model(num_edge_types=3)
    here, there = after(on_map, *drive()), after(on_map, *(shifted(s, x_m=10.0) for s in drive()))
    assert differ(here, there) > 1e-2


def test_frame_follows_the_ego_at_each_step(forecaster: DGVAE):
    """Moving a past scene as a whole along the road changes nothing: each step is seen from where the ego then was."""
    history = drive()
    jumped = [shifted(history[0], x_m=-500.0), *history[1:]]
    assert_same(after(forecaster, *jumped), after(forecaster, *history))


@pytest.mark.parametrize("frame", [("world", "world"), ROAD], ids=["world", "road"])
def test_positions_are_relative_to_the_ego_in_world_axes(frame: tuple[str, str]):
    standing = {0: (1000.0, 50.0, 1.0, 0.0), 5: (1010.0, 40.0, 0.0, 2.0)}
    stream = OnlineForecaster(ConstantVelocity(spec(frame, dt_s=0.5)), 1, AGENTS)
    stream.observe(batch(scene(standing, AGENTS)))
    xy = stream.forecast(horizon_steps=2).xy
    assert xy[0, 0, 0].tolist() == [[0.5, 0.0], [1.0, 0.0]]
    assert xy[0, 0, 1].tolist() == [[10.0, -9.0], [10.0, -8.0]]
    assert not xy[0, 0, 2:].any()


def test_forecast_of_the_model_is_relative_to_the_ego_too():
    on_map, history = model(num_edge_types=3), drive()
    tensor = torch.from_numpy(np.stack([s.states for s in history])).float()[None]
    valid = torch.from_numpy(np.stack([s.valid for s in history]))[None]
    memory = on_map.empty_memory(1, AGENTS)
    for now, present in zip(tensor.unbind(1), valid.unbind(1), strict=True):
        memory, belief = on_map.observe(memory, now, present)
    expected = (on_map.rollout(belief, 3).states[..., :2] - tensor[0, -1, 0, :2]) * valid[0, -1, :, None, None]
    torch.testing.assert_close(after(on_map, *history).xy, expected, rtol=1e-5, atol=1e-4)


# --- Padding and samples ----------------------------------------------------------------------------------------------


def test_padded_agents_do_not_matter_whatever_they_hold(forecaster: DGVAE):
    history = [scene(states_of(t, 0, 3, 7), AGENTS, [0, PADDING_ID, 3, 7]) for t in range(4)]
    littered = []
    for t, now in enumerate(history):
        states, ids = now.states.copy(), now.ids.copy()
        states[1], ids[1] = 1e3 * (t + 1), 3 + t  # even the id of someone who is present
        littered.append(Scene(states, ids, now.valid))
    ours = after(forecaster, *littered)
    assert_same(ours, after(forecaster, *history))
    assert not ours.xy[:, :, 1].any()
    assert ours.valid.tolist() == [[True, False, True, True]]


def test_more_padding_changes_nothing(forecaster: DGVAE):
    narrow, wide = OnlineForecaster(forecaster, 1, 3), OnlineForecaster(forecaster, 1, 6)
    for t in range(3):
        agents = states_of(t, 0, 3, 7)
        narrow.observe(batch(scene(agents, 3)))
        wide.observe(batch(scene(agents, 6, [0, PADDING_ID, 7, PADDING_ID, PADDING_ID, 3])))
    ours, expected, places = wide.forecast(), narrow.forecast(), torch.tensor([0, 5, 2])
    torch.testing.assert_close(ours.xy[:, :, places], expected.xy)
    torch.testing.assert_close(ours.edge_features[:, places][:, :, places], expected.edge_features)


def test_ego_alone(forecaster: DGVAE):
    stream = OnlineForecaster(forecaster, 2, 1)
    for t in range(3):
        stream.observe(batch(*(scene(states_of(t, 0), 1) for _ in range(2))))
    forecast = stream.forecast(num_samples=3, generator=torch.Generator().manual_seed(0))
    assert forecast.xy.shape == (2, 3, 1, 3, 2) and torch.isfinite(forecast.xy).all()
    assert torch.equal(forecast.edge_probs, torch.tensor([1.0, 0.0, 0.0]).expand(2, 1, 1, 3))


def test_samples_come_from_the_generator_and_leave_the_memory_alone(forecaster: DGVAE):
    stream = online(forecaster)
    for now in drive():
        stream.observe(batch(now))

    def draw(seed: int) -> Tensor:
        return stream.forecast(num_samples=3, generator=torch.Generator().manual_seed(seed)).xy

    assert torch.equal(draw(0), draw(0))
    assert not torch.allclose(draw(0)[:, 1:], draw(1)[:, 1:], atol=1e-4)
    assert_same(stream.forecast(), after(forecaster, *drive()), tolerance=0)


def test_an_absent_ego_is_refused_where_positions_are_relative_to_it():
    """Else positions would be those of the world, and a forecast would depend on the place."""
    forecaster = OnlineForecaster(model(frame=ROAD), 1, AGENTS)
    here = scene(states_of(0, 0, 3, 7), AGENTS - 1)
    with pytest.raises(UserError, match="with the frame 'ego' needs the ego, agent 0, in every scene that has agents"):
        forecaster.observe(SceneBatch.stack([here.behind_absent(1)]))
    forecaster.observe(SceneBatch.stack([scene(states_of(0, 0, 3, 7), AGENTS)]))
    OnlineForecaster(model(), 1, AGENTS).observe(SceneBatch.stack([here.behind_absent(1)]))


@pytest.mark.parametrize("everywhere", [True, False])
def test_a_spread_that_is_no_number_is_refused_but_of_absent_agents(everywhere: bool):
    class Odd(ConstantVelocity):
        has_scale = True

        def rollout(self, belief: Any, *arguments: Any, **named: Any) -> Futures:
            states = super().rollout(belief, *arguments, **named).states
            wrong = ~belief.valid[:, None, :, None, None] | everywhere
            return Futures(states, None, torch.ones_like(states[..., :2]).masked_fill(wrong, torch.nan))

    stream = online(Odd(spec()))
    stream.observe(batch(scene(states_of(0, 0, 3, 7), AGENTS, [0, PADDING_ID, 7, 3])))
    if not everywhere:
        assert not stream.forecast(5).valid[0, 1]
        return
    with pytest.raises(UserError, match="forecasts numbers that are not finite; its weights are damaged or diverged"):
        stream.forecast(5)
