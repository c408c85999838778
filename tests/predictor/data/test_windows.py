from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from predictor.data.store import Episode
from predictor.data.windows import WindowBatch, Windows, concatenate, siblings, split_episodes, visible
from predictor.scene import SceneSpec
from predictor.support.errors import UserError
from predictor.training.fitted_scales import typical_neighbour
from tests.predictor.helpers import random_presence, random_states, spec


def along_x(*tracks: list[float | None]) -> Episode:
    """Agents on the x axis, one list per agent; None where it is absent. The first is the ego."""
    steps = len(tracks[0])
    states, valid = np.zeros((steps, len(tracks), 4), dtype=np.float32), np.zeros((steps, len(tracks)), dtype=np.bool_)
    for agent, track in enumerate(tracks):
        for t, x in enumerate(track):
            if x is not None:
                states[t, agent, 0], valid[t, agent] = x, True
    return Episode(states, valid, np.arange(len(tracks)))


def random_episode(seed: int, steps: int, agents: int) -> Episode:
    present = random_presence(seed, steps, agents).numpy()
    return Episode(random_states(seed, steps, agents, 4).numpy() * present[..., None], present, np.arange(agents))


def only(windows: Windows, *indices: int) -> WindowBatch:
    return windows.batch(np.array(indices))


# --- What the ego sees ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("x", "perception_m", "seen"),
    [(10.0, 10.0, True), (-10.0, 10.0, True), (10.01, 10.0, False), (-10.01, 10.0, False)],
    ids=["at_the_edge", "behind", "beyond", "beyond_behind"],
)
def test_perception_range(x: float, perception_m: float, seen: bool):
    episode = along_x([100.0], [100.0 + x])
    assert visible(episode, spec(perception_m=perception_m)).tolist() == [[True, seen]]


def test_only_the_nearest_are_seen_and_the_ego_counts():
    episode = along_x([0.0, 0.0], [3.0, 1.0], [1.0, 3.0], [2.0, 2.0], [None, 0.5])
    assert visible(episode, spec(max_agents=3)).tolist() == [
        [True, False, True, True, False],
        [True, True, False, False, True],
    ]


def test_alone_with_max_agents_1():
    assert visible(along_x([0.0], [0.0]), spec(max_agents=1)).tolist() == [[True, False]]


def test_distance_is_in_the_plane():
    episode = along_x([0.0], [3.0])
    episode.states[0, 1, 1] = 4.0
    assert visible(episode, spec(perception_m=5.0)).tolist() == [[True, True]]
    assert visible(episode, spec(perception_m=4.99)).tolist() == [[True, False]]


def test_without_an_ego_all_agents_are_seen():
    episode = along_x([0.0, None], [1000.0, 1000.0])
    assert visible(episode, spec(has_ego=False)).tolist() == [[True, True], [False, True]]


# --- What a window holds ----------------------------------------------------------------------------------------------


def test_future_is_known_even_where_it_is_not_seen():
    episode = along_x([0.0] * 5, [5.0, 8.0, 11.0, 14.0, None], [50.0, 9.0, 9.0, 9.0, 9.0], [None, None, 1.0, 1.0, 1.0])
    batch = only(Windows([episode], spec(perception_m=10.0), history_steps=2, horizon_steps=3), 1)
    assert batch.last_observed.tolist() == [1]
    # the second agent leaves the ego's view at the third step and the scene at the fifth; the third agent is only seen
    # from the second step on; the fourth, not there when the forecast is made, is not in the window
    assert batch.valid[0].T.tolist() == [[True] * 5, [True, True, True, True, False], [False, True, True, True, True]]
    assert batch.states[0, :, 1, 0].tolist() == [5.0, 8.0, 11.0, 14.0, 0.0]
    assert batch.states[0, :, 2, 0].tolist() == [0.0, 9.0, 9.0, 9.0, 9.0]


def test_agent_seen_before_but_not_now_has_a_history_and_no_future():
    episode = along_x([0.0] * 4, [5.0, 50.0, 5.0, 5.0])
    batch = only(Windows([episode], spec(perception_m=10.0), history_steps=2, horizon_steps=2), 1)
    assert batch.valid[0, :, 1].tolist() == [True, False, False, False]
    assert batch.states[0, 1:, 1].abs().max() == 0


def test_histories_are_short_at_the_start_and_futures_at_the_end():
    episode = along_x([float(t) for t in range(5)])
    windows = Windows([episode], spec(), history_steps=3, horizon_steps=2)
    assert windows.index.tolist() == [[0, 0], [0, 1], [0, 2], [0, 3]]
    batch = only(windows, 0, 1, 2, 3)
    assert batch.last_observed.tolist() == [0, 1, 2, 2]
    assert batch.states[..., 0, 0].tolist() == [[0, 1, 2, 0, 0], [0, 1, 2, 3, 0], [0, 1, 2, 3, 4], [1, 2, 3, 4, 0]]
    assert batch.valid[..., 0].tolist() == [
        [True, True, True, False, False],
        [True, True, True, True, False],
        [True, True, True, True, True],
        [True, True, True, True, False],
    ]


@pytest.mark.parametrize(("min_future_steps", "count"), [(1, 4), (2, 3), (4, 1)])
def test_windows_with_too_little_future_are_left_out(min_future_steps: int, count: int):
    windows = Windows([along_x([0.0] * 5)], spec(), 3, 4, min_future_steps)
    assert len(windows) == count
    assert windows.index[:, 1].max() == 4 - min_future_steps


def test_episodes_are_not_mixed():
    first, second = along_x([0.0, 1.0, 2.0]), along_x([10.0, 11.0, 12.0])
    batch = only(Windows([first, second], spec(), history_steps=5, horizon_steps=5), 2)
    assert batch.states[0, :3, 0, 0].tolist() == [10.0, 11.0, 12.0]
    assert batch.valid[0, :, 0].tolist() == [True, True, True, False, False, False]


@settings(max_examples=20)
@given(
    seed=st.integers(0, 2**16),
    history_steps=st.integers(1, 5),
    horizon_steps=st.integers(1, 4),
    perception_m=st.sampled_from([8.0, 15.0, 100.0]),
    max_agents=st.integers(3, 5),
)
def test_windows_against_a_loop(
    seed: int, history_steps: int, horizon_steps: int, perception_m: float, max_agents: int
):
    """Every agent that was seen in the history is there (they fit: five agents, `max_agents` + 2 columns), no other."""
    layout = spec(perception_m=perception_m, max_agents=max_agents)
    episodes = [random_episode(seed + i, steps, 5) for i, steps in enumerate((6, 3))]
    windows = Windows(episodes, layout, history_steps, horizon_steps)
    batch = windows.batch(np.arange(len(windows)))
    for window, (number, now) in enumerate(windows.index.tolist()):
        episode, begin = episodes[number], max(0, now - history_steps + 1)
        assert batch.last_observed[window] == now - begin
        expected = {}
        for agent in range(5):
            track = np.full((batch.states.shape[1], 4), np.nan)
            for t in range(begin, min(now + horizon_steps + 1, len(episode.states))):
                there = sees(episode, layout, t, agent) if t <= now else episode.valid[t, agent]
                if there and (t <= now or sees(episode, layout, now, agent)):
                    track[t - begin] = episode.states[t, agent]
            if np.isfinite(track[: now - begin + 1]).any():
                expected[track.tobytes()] = agent
        tracks = np.where(batch.valid[window, :, :, None].numpy(), batch.states[window].numpy(), np.nan).astype(
            np.float64
        )
        ours = [
            tracks[:, column].tobytes() for column in range(tracks.shape[1]) if np.isfinite(tracks[:, column]).any()
        ]
        assert sorted(ours) == sorted(expected)
        assert expected[ours[0]] == 0  # the ego is column 0
        assert not batch.states[window][~batch.valid[window]].any()


def sees(episode: Episode, layout: SceneSpec, t: int, agent: int) -> bool:
    """Whether the ego sees an agent, in words."""
    if not episode.valid[t, agent]:
        return False
    offset = episode.states[t, :, :2] - episode.states[t, 0, :2]
    distance = np.hypot(offset[:, 0], offset[:, 1])
    nearer = [other for other in range(len(distance)) if episode.valid[t, other] and distance[other] < distance[agent]]
    return agent == 0 or bool(distance[agent] <= layout.perception_m and len(nearer) < layout.max_agents)


def test_padding_to_the_widest_window():
    alone, crowd = along_x([0.0] * 3), along_x([0.0] * 3, [1.0] * 3, [2.0] * 3)
    batch = only(Windows([alone, crowd], spec(), 2, 1), 0, 2)
    assert batch.states.shape == (2, 2, 3, 4)
    assert batch.valid[0, :, 1:].any().item() is False


def test_leaving_ego_is_refused():
    windows = Windows([along_x([0.0, None, 0.0])], spec(), 2, 1)
    with pytest.raises(UserError, match=r"episode 0: the ego \(column 0\) must be present at every step up to 1"):
        only(windows, 1)


@pytest.mark.parametrize(
    ("episodes", "message"),
    [
        ([along_x([0.0])], "no window fits: episodes have at most 1 steps, a window needs 2"),
        ([], "no window fits: episodes have at most 0 steps, a window needs 2"),
    ],
    ids=["too_short", "none"],
)
def test_episodes_without_a_window_are_refused(episodes: list[Episode], message: str):
    with pytest.raises(UserError, match=message):
        Windows(episodes, spec(), 3, 2)


def test_windows_that_no_intervention_leaves_are_told_from_short_episodes():
    steps = along_x([0.0] * 5)
    kicked = replace(steps, perturbed=np.array([[0], [1], [0], [1], [0]], dtype=np.int8))
    with pytest.raises(UserError, match="no window fits: in each of the 3 that are long enough an intervention begins"):
        Windows([kicked], spec(), 1, 2, min_future_steps=2)


@pytest.mark.parametrize(("history", "horizon", "told"), [(0, 5, "0 and 5"), (-3, 5, "-3 and 5"), (2, -1, "1 and -1")])
def test_windows_have_steps(history: int, horizon: int, told: str):
    with pytest.raises(UserError, match=f"windows need at least 1 step of history and 1 of horizon, got {told}"):
        Windows([along_x([0.0, 1.0, 2.0])], spec(), history, horizon, min_history_steps=min(1, max(history, 1)))


def test_episodes_without_agents_have_windows_without_agents():
    nobody = Episode(np.zeros((3, 0, 4), np.float32), np.zeros((3, 0), np.bool_), np.zeros(0, np.int64))
    for has_ego in (True, False):
        windows = Windows([nobody, along_x([0.0, 1.0, 2.0])], spec(has_ego=has_ego), 1, 1)
        assert windows.index[:, 0].tolist() == [0, 0, 1, 1]
        assert typical_neighbour([nobody], windows.spec) == ()


# --- Length of the history --------------------------------------------------------------------------------------------


def test_a_batch_may_have_a_shorter_history():
    """As if the windows had been made with it: what was before is not there, nor is any agent seen only then."""
    episode = along_x([float(t) for t in range(6)], [3.0, 50.0, 50.0, 50.0, 50.0, 50.0])
    windows = Windows([episode], spec(perception_m=10.0), history_steps=4, horizon_steps=1)
    long, short = windows.batch(np.array([0, 3])), windows.batch(np.array([0, 3]), history_steps=2)
    assert long.last_observed.tolist() == [0, 3] and long.states.shape == (2, 5, 2, 4)
    assert short.last_observed.tolist() == [0, 1] and short.states.shape == (2, 3, 2, 4)
    assert short.states[1, :, 0, 0].tolist() == [2.0, 3.0, 4.0]
    assert long.valid[1, :, 1].any() and not short.valid[1, :, 1].any()
    expected = Windows([episode], spec(perception_m=10.0), history_steps=2, horizon_steps=1).batch(np.array([0, 3]))
    assert torch.equal(short.states, expected.states) and torch.equal(short.valid, expected.valid)
    assert windows.batch(np.array([3])).last_observed.tolist() == [3]  # nothing was changed for good


@pytest.mark.parametrize(
    ("min_history_steps", "min_future_steps", "steps"),
    [(1, 1, [0, 1, 2, 3]), (3, 1, [2, 3]), (3, 2, [2]), (4, 1, [3])],
)
def test_windows_with_too_little_history_are_left_out(min_history_steps: int, min_future_steps: int, steps: list[int]):
    windows = Windows([along_x([0.0] * 5), along_x([0.0] * 2)], spec(), 3, 4, min_future_steps, min_history_steps)
    assert windows.index[windows.index[:, 0] == 0, 1].tolist() == steps
    assert windows.index[windows.index[:, 0] == 1, 1].tolist() == ([0] if min_history_steps == 1 else [])


def test_history_that_no_episode_has_is_named():
    with pytest.raises(UserError, match="no window fits: episodes have at most 5 steps, a window needs 7"):
        Windows([along_x([0.0] * 5)], spec(), 3, 4, min_future_steps=3, min_history_steps=4)


# --- Edge labels ------------------------------------------------------------------------------------------------------


def with_labels(episode: Episode, label_steps: int) -> Episode:
    """The type of a pair tells who it is (receiver · 10 + sender, plus 100 a step); so does the attribute."""
    agents = episode.states.shape[1]
    codes = 10 * np.arange(agents)[:, None] + np.arange(agents) + 100 * np.arange(label_steps)[:, None, None]
    return replace(
        episode, edge_types=codes.astype(np.int16), edge_attributes=np.stack([codes / 2, -codes], -1).astype(np.float32)
    )


@settings(max_examples=10)
@given(
    seed=st.integers(0, 2**16),
    per_step=st.booleans(),
    history_steps=st.integers(1, 4),
    shorter=st.sampled_from([None, 1, 2]),
    has_ego=st.booleans(),
)
def test_labels_follow_their_agents(seed: int, per_step: bool, history_steps: int, shorter: int | None, has_ego: bool):
    """Whatever column an agent is moved to; unknown for who is not there, for oneself, and after the end."""
    layout = spec(perception_m=15.0, max_agents=3, has_ego=has_ego)
    episodes = [
        with_labels(random_episode(seed + i, steps, 5), steps if per_step else 1) for i, steps in enumerate((6, 3))
    ]
    windows = Windows(episodes, layout, history_steps, horizon_steps=2)
    batch = windows.batch(np.arange(len(windows)), shorter)
    assert batch.edge_types is not None and batch.edge_attributes is not None
    for window, (number, now) in enumerate(windows.index.tolist()):
        episode, begin = episodes[number], max(0, now - (shorter or history_steps) + 1)
        who = {}  # agents by their column, recognised by their states
        for column, agent in product(range(batch.valid.shape[2]), range(5)):
            steps = batch.valid[window, :, column].nonzero()[:, 0]
            if len(steps) and all(
                np.array_equal(batch.states[window, t, column].numpy(), episode.states[begin + t, agent])
                for t in steps.tolist()
            ):
                who[column] = agent
        for t, i, j in product(range(batch.valid.shape[1]), *(range(batch.valid.shape[2]),) * 2):
            known = bool(batch.valid[window, t, i] and batch.valid[window, t, j]) and i != j
            code = 10 * who[i] + who[j] + 100 * (begin + t) * per_step if known else -1
            assert batch.edge_types[window, t, i, j] == code
            expected = [code / 2, -code] if known else [0.0, 0.0]
            assert batch.edge_attributes[window, t, i, j].tolist() == expected


def test_windows_without_labels_have_none():
    batch = only(Windows([along_x([0.0] * 3)], spec(), 2, 1), 0, 1)
    assert (batch.edge_types, batch.edge_attributes) == (None, None)


def test_attributes_of_stores_that_mean_something_else_are_dropped():
    wide = with_labels(random_episode(0, 6, 3), 1)
    assert wide.edge_attributes is not None
    narrow = replace(wide, edge_attributes=np.concatenate([wide.edge_attributes] * 2, axis=-1))
    found = Windows([wide, narrow], spec(), 3, 2).batch(np.arange(2))
    assert found.edge_attributes is None and found.edge_types is not None


def test_labels_move_with_the_batch():
    batch = only(Windows([with_labels(along_x([0.0] * 3, [1.0] * 3), 1)], spec(), 2, 1), 1).to(torch.device("cpu"))
    assert batch.edge_types is not None and batch.edge_types.shape == (1, 3, 2, 2)
    assert batch.edge_attributes is not None and batch.edge_attributes.shape == (1, 3, 2, 2, 2)


# --- Joining and splitting --------------------------------------------------------------------------------------------


def test_concatenation_pads_and_keeps_every_window():
    small = only(Windows([along_x([0.0, 1.0, 2.0])], spec(), 1, 1), 0, 1)
    wide = only(Windows([along_x([5.0] * 6, [6.0] * 6)], spec(), 3, 2), 2)
    joined = concatenate([small, wide])
    assert joined.states.shape == (3, 5, 2, 4)
    assert torch.equal(joined.states[:2, :2, :1], small.states) and torch.equal(joined.valid[:2, :2, :1], small.valid)
    assert torch.equal(joined.states[2:], wide.states) and torch.equal(joined.valid[2:], wide.valid)
    assert not joined.valid[:2, 2:].any() and not joined.valid[:2, :, 1:].any()
    assert joined.last_observed.tolist() == [0, 0, 2]


def test_concatenation_pads_labels_with_unknown():
    small = only(Windows([with_labels(along_x([0.0] * 3, [1.0] * 3), 1)], spec(), 1, 1), 0)
    wide = only(Windows([with_labels(along_x([5.0] * 6, [6.0] * 6, [7.0] * 6), 6)], spec(), 3, 2), 2)
    joined = concatenate([small, wide])
    types, attributes = joined.edge_types, joined.edge_attributes
    assert types is not None and attributes is not None
    assert types.shape == (2, 5, 3, 3) and attributes.shape == (2, 5, 3, 3, 2)
    assert torch.equal(types[0, :2, :2, :2], small.edge_types[0]) and torch.equal(types[1:], wide.edge_types)
    assert torch.equal(attributes[0, :2, :2, :2], small.edge_attributes[0])
    assert torch.equal(attributes[1:], wide.edge_attributes)
    assert (types[0, 2:] == -1).all() and (types[0, :, 2] == -1).all() and (types[0, :, :, 2] == -1).all()
    assert not attributes[0, 2:].any() and not attributes[0, :, 2].any() and not attributes[0, :, :, 2].any()


@pytest.mark.parametrize("labelled_first", [True, False])
def test_labels_of_some_stores_only_are_dropped(labelled_first: bool):
    plain = along_x([0.0] * 3, [1.0] * 3)
    batches = [only(Windows([e], spec(), 1, 1), 0) for e in (with_labels(plain, 1), plain)]
    joined = concatenate(batches if labelled_first else batches[::-1])
    assert (joined.edge_types, joined.edge_attributes) == (None, None)
    assert len(joined.states) == 2


@pytest.mark.parametrize(("count", "fraction"), list(product((2, 7, 20), (0.1, 0.5))))
def test_split_is_a_partition_of_whole_episodes(count: int, fraction: float):
    train, held_out = split_episodes(count, fraction, seed=3)
    assert sorted(train + held_out) == list(range(count))
    assert len(held_out) == round(count * fraction)


def test_split_depends_on_the_seed_alone():
    assert split_episodes(30, 0.3, seed=1) == split_episodes(30, 0.3, seed=1)
    assert split_episodes(30, 0.3, seed=1) != split_episodes(30, 0.3, seed=2)


def test_an_intervention_may_begin_before_the_forecast_and_not_within():
    """One begins at step 3 and is in force for two steps, another follows it at once."""
    episode = along_x([0.0] * 9, [1.0] * 9)
    perturbed = np.zeros((9, 2), dtype=np.int8)
    perturbed[3:5, 1], perturbed[5, 0] = 1, 1
    disturbed = replace(episode, perturbed=perturbed)
    found = Windows([episode, disturbed], spec(), 1, 2).index.tolist()
    assert [now for number, now in found if number == 0] == list(range(8))
    assert [now for number, now in found if number == 1] == [0, 1, 6, 7]


def test_branches_of_one_episode_are_siblings():
    marks = np.zeros((3, 1), dtype=np.int8)
    branch = replace(along_x([0.0] * 3), perturbed=marks, seed=4)
    found = [branch, branch, replace(branch, seed=5), replace(branch, seed=5, label="idle"), along_x([0.0] * 3)]
    assert siblings(found).tolist() == [0, 0, 1, 2, 3]
    assert siblings([along_x([0.0] * 3)] * 3).tolist() == [0, 1, 2]
