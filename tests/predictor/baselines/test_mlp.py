"""The two-layer baseline against a plain loop."""

from itertools import product

import torch

from predictor.baselines.mlp import MLP, MLPConfig
from predictor.scene import SceneSpec
from tests.predictor.baselines.helpers import AGENTS, BATCH, HORIZON, TIME, TOLERANCE, fresh, last, tiny
from tests.predictor.helpers import random_presence, random_states


def test_against_a_loop():
    forecaster = tiny("mlp")
    states, valid = random_states(0, BATCH, TIME, AGENTS, 4), random_presence(0, BATCH, TIME, AGENTS)
    window = forecaster.window(states, valid, torch.tensor([1, 4]), HORIZON)
    first, second = forecaster.hidden, forecaster.readout
    for b, t, i in product(range(BATCH), range(TIME), range(AGENTS)):
        if not valid[b, t, i]:
            continue
        ego = torch.tensor([float(i == 0)])
        state = states[b, t, i]
        for step in range(HORIZON):
            x = torch.cat([state / torch.tensor([10.0, 10.0, 5.0, 5.0]), ego])
            hidden = (first.weight @ x + first.bias).clamp(min=0)
            state = state + (second.weight @ hidden + second.bias) * torch.tensor([10.0, 10.0, 5.0, 5.0])
            if step == 0:
                torch.testing.assert_close(window.one_step[b, t, i], state, rtol=1e-5, atol=1e-4)
            if t == (1, 4)[b]:
                torch.testing.assert_close(window.rollout[b, i, step], state, rtol=1e-5, atol=1e-4)


def test_hand_computed():
    """One hidden unit that sees vx (scaled: 6/3 = 2), minus 1, doubled onto y in steps of 0.5 m: y moves by 1 m."""
    spec = SceneSpec(1.0, feature_scales=(1.0, 1.0, 3.0, 3.0), has_ego=False)
    forecaster = MLP(spec, MLPConfig(1, delta_scales=(1.0, 0.5, 1.0, 1.0))).requires_grad_(False)
    forecaster.hidden.weight.copy_(torch.tensor([[0.0, 0.0, 1.0, 0.0]]))
    forecaster.hidden.bias.fill_(-1.0)
    forecaster.readout.weight.copy_(torch.tensor([[0.0], [2.0], [0.0], [0.0]]))
    forecaster.readout.bias.zero_()
    states = torch.tensor([[[7.0, 3.0, 6.0, 0.0], [7.0, 3.0, 2.0, 0.0]]])  # the second is below the unit's threshold
    belief = last(forecaster, states[:, None], torch.ones(1, 1, 2).bool())
    future = forecaster.rollout(belief, 2).states[0, 0]
    assert future[0].tolist() == [[7.0, 4.0, 6.0, 0.0], [7.0, 5.0, 6.0, 0.0]]
    assert future[1].tolist() == [[7.0, 3.0, 2.0, 0.0]] * 2


def test_others_are_not_seen():
    forecaster, states = tiny("mlp"), random_states(0, 1, 1, 3, 4)
    valid = torch.ones(1, 1, 3).bool()
    moved = states.clone()
    moved[..., 1:, :] += 3.0
    one, other = (forecaster.rollout(last(forecaster, s, valid), 2).states[0, 0] for s in (states, moved))
    torch.testing.assert_close(one[0], other[0], **TOLERANCE)
    assert not torch.allclose(one[1:], other[1:], atol=1e-2)


def test_default_size_is_the_papers():
    forecaster = MLP(SceneSpec(1.0, has_ego=False))
    assert forecaster.config.hidden_dim == 256
    assert sum(p.numel() for p in forecaster.parameters()) == 4 * 256 + 256 + 256 * 4 + 4


def test_overfits_one_batch():
    """Turning by a fixed angle is a linear map of the velocity: what this model can learn, it does."""
    forecaster = fresh("mlp")
    states = random_states(0, 4, 2, 3, 4)
    turn = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    states[:, 1, :, 2:] = states[:, 0, :, 2:] @ turn.T
    states[:, 1, :, :2] = states[:, 0, :, :2] + states[:, 0, :, 2:]
    valid, now = torch.ones(4, 2, 3).bool(), torch.zeros(4, dtype=torch.long)
    optimizer = torch.optim.Adam(forecaster.parameters(), lr=2e-2)
    losses = []
    for _ in range(80):
        loss = forecaster.window(states, valid, now, 1).rollout[:, :, 0].sub(states[:, 1]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < losses[0] / 20
