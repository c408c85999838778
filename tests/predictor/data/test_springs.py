"""The simulator against analytic motion and conservation laws, its draws against their distributions, its stores."""

import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from predictor.data import springs
from predictor.data.springs import (
    Physics,
    SpringsConfig,
    draw_charges,
    draw_springs,
    draw_start,
    make,
    make_episodes,
    simulate,
    spring_spec,
)
from predictor.data.store import PERTURBATIONS, read_store
from predictor.support.errors import UserError, run_entry_point
from predictor.training.config import TrainConfig
from predictor.training.trainer import Trainer
from predictor.training.training_data import load_data
from tests.predictor.data.helpers import energy

OPEN = Physics(num_agents=2, box_m=1e6, dt_s=0.1, frames=61, substeps=50)  # no walls


def positions(*xy: tuple[float, float]) -> Tensor:
    return torch.tensor([xy], dtype=torch.float64)


def coupled(agents: int, **constants: float) -> Tensor:
    """Couplings of one scene, as `k01=2.0`."""
    matrix = torch.zeros(1, agents, agents)
    for pair, value in constants.items():
        i, j = int(pair[1]), int(pair[2])
        matrix[0, i, j] = matrix[0, j, i] = value
    return matrix


def drawn(count: int, physics: Physics, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    couplings = draw_springs(count, physics.num_agents, 0.7, generator)
    return (couplings, *draw_start(count, physics, generator))


# --- Motion -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("constant", [0.5, 2.0])
def test_two_on_a_spring_swing_at_their_frequency(constant: float):
    """The distance is a cosine of ω² = 2 k (reduced mass 1/2), the middle moves on steadily."""
    states = simulate(
        OPEN, coupled(2, k01=constant), positions((1.0, 2.0), (-1.0, 0.0)), positions((0.3, 0.1), (0.3, 0.1))
    )[0]
    t = OPEN.dt_s * torch.arange(OPEN.frames).double()
    swing = torch.cos(math.sqrt(2 * constant) * t)
    distance = states[:, 0, :2] - states[:, 1, :2]
    torch.testing.assert_close(distance, swing[:, None] * torch.tensor([2.0, 2.0]).double(), rtol=0, atol=1e-4)
    middle = states[..., :2].mean(1)
    expected = torch.stack([0.3 * t, 1.0 + 0.1 * t], dim=1)
    torch.testing.assert_close(middle, expected, rtol=0, atol=1e-12)
    rate = -math.sqrt(2 * constant) * torch.sin(math.sqrt(2 * constant) * t)
    torch.testing.assert_close(states[:, 0, 2] - states[:, 1, 2], 2.0 * rate, rtol=0, atol=2e-4)


def test_error_falls_with_the_square_of_the_substeps():
    """Five on random springs, against a simulation that is sixteen times as fine."""
    physics = replace(OPEN, num_agents=5, frames=21, substeps=5)
    start = drawn(3, physics)
    exact = simulate(replace(physics, substeps=80), *start)
    errors = [(simulate(replace(physics, substeps=n), *start) - exact).abs().max().item() for n in (5, 10)]
    assert errors[0] < 0.05
    assert 3.5 < errors[0] / errors[1] < 4.5


def test_without_springs_all_particles_go_straight_on():
    physics = replace(OPEN, num_agents=3)
    _, where, velocity = drawn(2, physics)
    states = simulate(physics, torch.zeros(2, 3, 3), where, velocity)
    t = physics.dt_s * torch.arange(physics.frames).double()[:, None, None]
    torch.testing.assert_close(states[..., :2], where[:, None] + t * velocity[:, None], rtol=0, atol=1e-10)
    torch.testing.assert_close(states[..., 2:], velocity[:, None].expand(-1, physics.frames, -1, -1), rtol=0, atol=0)


def test_the_given_state_comes_first_and_scenes_do_not_mix():
    physics = replace(OPEN, num_agents=4, frames=8)
    start = drawn(3, physics)
    together = simulate(physics, *start)
    assert torch.equal(together[:, 0], torch.cat(start[1:], dim=-1))
    for i in range(3):
        torch.testing.assert_close(simulate(physics, *(t[i : i + 1] for t in start))[0], together[i])


# --- Conservation -----------------------------------------------------------------------------------------------------


def energy_drift(substeps: int, box_m: float) -> float:
    """Largest relative deviation over 500 frames."""
    physics = Physics(frames=500, substeps=substeps, box_m=box_m)
    start = drawn(2, physics)
    total = energy(start[0], simulate(physics, *start))
    return ((total - total[:, :1]).abs() / total[:, :1]).max().item()


def test_energy_stays_and_its_error_falls_with_the_square_of_the_substeps():
    coarse, fine = energy_drift(5, box_m=1e6), energy_drift(10, box_m=1e6)
    assert coarse < 5e-3
    assert 3.3 < coarse / fine < 4.7


def test_energy_stays_within_walls():
    """Walls are elastic; a bounce costs an error of one substep, not energy."""
    assert energy_drift(25, box_m=1.5) < 0.02


def test_energy_closed_form():
    """Two at rest 5 m apart on k = 2: 25 J; one of three moving at 3 m/s adds 4.5 J."""
    states = torch.zeros(1, 1, 3, 4).double()
    states[0, 0, 1, :2] = torch.tensor([3.0, 4.0])
    states[0, 0, 2, 2] = 3.0
    assert energy(coupled(3, k01=2.0), states).tolist() == [[25.0 + 4.5]]


def test_momentum_stays_without_walls():
    physics = replace(OPEN, num_agents=5, frames=40)
    for kind in ("springs", "charged"):
        charged = replace(physics, kind=kind, substeps=10)
        couplings, where, velocity = drawn(3, charged)
        momentum = simulate(charged, couplings, where, velocity)[..., 2:].sum(2)
        torch.testing.assert_close(momentum, momentum[:, :1].expand_as(momentum), rtol=0, atol=1e-9)


# --- Walls ------------------------------------------------------------------------------------------------------------


def test_walls_reflect():
    """From 4.5 m at 2 m/s: at the wall after a quarter of a second, then back; the other axis goes on."""
    physics = Physics(num_agents=1, box_m=5.0, dt_s=0.125, frames=9, substeps=4)
    states = simulate(physics, torch.zeros(1, 1, 1), positions((4.5, 0.0)), positions((2.0, -1.0)))[0, :, 0]
    assert states[:, 0].tolist() == [4.5, 4.75, 5.0, 4.75, 4.5, 4.25, 4.0, 3.75, 3.5]
    assert states[:, 2].tolist() == [2.0] * 3 + [-2.0] * 6
    assert states[:, 1].tolist() == [-0.125 * t for t in range(9)]
    assert (states[:, 3] == -1.0).all()


def test_corners_reflect_both_axes():
    physics = Physics(num_agents=1, box_m=1.0, dt_s=0.5, frames=4, substeps=2)
    states = simulate(physics, torch.zeros(1, 1, 1), positions((-0.75, 0.75)), positions((-1.0, 1.0)))[0, :, 0]
    assert states.tolist() == [
        [-0.75, 0.75, -1.0, 1.0],
        [-0.75, 0.75, 1.0, -1.0],
        [-0.25, 0.25, 1.0, -1.0],
        [0.25, -0.25, 1.0, -1.0],
    ]


def test_no_particle_leaves_the_box():
    physics = Physics(box_m=0.6, frames=60, speed_mps=2.0)
    couplings, where, velocity = drawn(5, physics)
    states = simulate(physics, couplings, where.clamp(-0.6, 0.6), velocity)
    assert states[..., :2].abs().max() <= 0.6


# --- Charges ----------------------------------------------------------------------------------------------------------


def apart_after(product: float) -> tuple[float, float]:
    """Distance of two resting charges that began 2 m apart, after one short frame and a longer while."""
    physics = Physics("charged", num_agents=2, box_m=1e6, dt_s=0.05, frames=11, substeps=10)
    states = simulate(physics, coupled(2, k01=product), positions((-1.0, 0.0), (1.0, 0.0)), positions((0, 0), (0, 0)))
    distance = states[0, :, 1, 0] - states[0, :, 0, 0]
    return distance[1].item(), distance[-1].item()


def test_like_charges_repel_and_unlike_ones_attract():
    assert apart_after(1.0)[1] > 2.05
    assert apart_after(-1.0)[1] < 1.95


@pytest.mark.parametrize("product", [1.0, -2.0])
def test_force_of_charges_falls_with_the_square_of_the_distance(product: float):
    """At first each accelerates by q / (d² + ε²)^{3/2} · d, in opposite directions; dt²/2 of that is the way."""
    acceleration = product * 2.0 / (2.0**2 + 0.1**2) ** 1.5
    way = 2 * acceleration * 0.05**2 / 2
    assert apart_after(product)[0] - 2.0 == pytest.approx(way, rel=1e-2)


@pytest.mark.slow
def test_charges_do_not_explode_when_they_meet():
    physics = Physics("charged", num_agents=2, box_m=5.0, frames=40, substeps=50)
    start = (positions((-0.5, 0.0), (0.5, 1e-3)), positions((0.5, 0.0), (-0.5, 0.0)))
    states = simulate(physics, coupled(2, k01=-1.0), *start)
    assert torch.isfinite(states).all()
    assert states[..., 2:].abs().max() < math.sqrt(2 * (0.25 + 2 / 0.1))  # all of the energy there is


# --- Draws ------------------------------------------------------------------------------------------------------------


def test_drawn_springs():
    """20,000 pairs: four standard errors are 0.013 for the share of springs, 0.015 for the mean of k."""
    couplings = draw_springs(2000, 5, 0.7, torch.Generator().manual_seed(0))
    assert torch.equal(couplings, couplings.transpose(1, 2))
    assert not couplings.diagonal(dim1=1, dim2=2).any()
    pairs = couplings[:, *torch.triu_indices(5, 5, 1)]
    joined = pairs[pairs > 0]
    assert (pairs > 0).float().mean().item() == pytest.approx(0.7, abs=0.013)
    assert 0.5 <= joined.min() < 0.51 and 1.99 < joined.max() < 2.0
    assert joined.mean().item() == pytest.approx(1.25, abs=0.015)
    assert joined.var().item() == pytest.approx(1.5**2 / 12, rel=0.03)
    shares = (pairs > 0).float().mean(0)
    assert ((shares - 0.7).abs() < 0.045).all()  # each of the ten pairs


def test_drawn_constants_out_of_distribution():
    couplings = draw_springs(2000, 5, 0.5, torch.Generator().manual_seed(0), (1.0, 2.0, 3.0))
    pairs = couplings[:, *torch.triu_indices(5, 5, 1)]
    assert set(pairs.unique().tolist()) == {0.0, 1.0, 2.0, 3.0}
    shares = [(pairs == k).float().mean().item() for k in (0.0, 1.0, 2.0, 3.0)]
    assert shares == pytest.approx([1 / 2, 1 / 6, 1 / 6, 1 / 6], abs=0.015)


def test_drawn_charges():
    """Products of ±1, so signs along any triangle multiply to plus."""
    products = draw_charges(500, 4, 2.0, torch.Generator().manual_seed(0))
    assert torch.equal(products, products.transpose(1, 2))
    assert not products.diagonal(dim1=1, dim2=2).any()
    off = products[:, *torch.triu_indices(4, 4, 1)]
    assert set(off.unique().tolist()) == {-2.0, 2.0}
    assert (products[:, 0, 1] * products[:, 1, 2] * products[:, 0, 2] == 8.0).all()
    assert (off > 0).float().mean().item() == pytest.approx(0.5, abs=0.04)


def test_drawn_start():
    physics = Physics(position_std_m=0.25, speed_mps=0.75)
    where, velocity = draw_start(2000, physics, torch.Generator().manual_seed(0))
    assert where.shape == velocity.shape == (2000, 5, 2)
    torch.testing.assert_close(velocity.norm(dim=-1), torch.full((2000, 5), 0.75).double())
    assert where.std().item() == pytest.approx(0.25, rel=0.03)
    assert where.mean().item() == pytest.approx(0.0, abs=0.01)
    assert velocity.mean((0, 1)).tolist() == pytest.approx([0.0, 0.0], abs=0.022)


# --- Splits and stores ------------------------------------------------------------------------------------------------

SHORT = Physics(frames=6, substeps=5)


def config(out: Path, **changes: Any) -> SpringsConfig:
    small = {"train": 4, "val": 2, "test": 3, "ood": 2, "physics": SHORT}
    return SpringsConfig(out, **(small | changes))


def test_splits_are_a_function_of_seed_and_name(tmp_path: Path):
    one, again = (make_episodes(config(tmp_path), "train", 3) for _ in range(2))
    torch.manual_seed(5), np.random.default_rng()
    for ours, expected in zip(one, again, strict=True):
        np.testing.assert_array_equal(ours.states, expected.states)
        np.testing.assert_array_equal(ours.edge_attributes, expected.edge_attributes)
    others = [
        make_episodes(config(tmp_path), "val", 3),
        make_episodes(config(tmp_path), "test", 3),
        make_episodes(config(tmp_path), "ood", 3),
        make_episodes(config(tmp_path, seed=1), "train", 3),
    ]
    for other in others:
        assert not np.isclose(other[0].states[0], one[0].states[0]).any()


def test_chunks_do_not_show(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    at_once = make_episodes(config(tmp_path), "train", 5)
    monkeypatch.setattr(springs, "CHUNK", 2)
    for ours, expected in zip(make_episodes(config(tmp_path), "train", 5), at_once, strict=True):
        np.testing.assert_allclose(ours.states, expected.states, atol=1e-6)
        np.testing.assert_array_equal(ours.edge_types, expected.edge_types)


@pytest.mark.parametrize(
    ("split", "kind"), [("test", "springs"), ("ood", "springs"), ("test", "charged"), ("ood", "charged")]
)
def test_labels_are_the_graph_that_made_the_motion(tmp_path: Path, split: str, kind: Any):
    """Simulating anew from the labels gives the states."""
    physics = replace(SHORT, kind=kind)
    for episode in make_episodes(config(tmp_path, physics=physics), split, 3):
        assert episode.edge_types is not None and episode.edge_attributes is not None
        types, strength = torch.from_numpy(episode.edge_types[0]), torch.from_numpy(episode.edge_attributes[0, ..., 0])
        sign = torch.where(types == 1, -1.0, 1.0) if kind == "charged" else torch.ones(())
        start = torch.from_numpy(episode.states[:1]).double()
        states = simulate(physics, (sign * strength)[None], start[..., :2], start[..., 2:])[0]
        np.testing.assert_allclose(episode.states, states.numpy(), atol=1e-4)
        allowed = {"springs": {0, 1}, "charged": {1, 2}}[kind]
        off_diagonal = ~torch.eye(5).bool()
        assert set(types[off_diagonal].tolist()) <= allowed
        assert not types.diagonal().any() and not strength.diagonal().any()
        assert torch.equal(types > 0, strength > 0)
        if split == "ood":
            assert set(strength[strength > 0].tolist()) <= ({1.0, 2.0, 3.0} if kind == "springs" else {2.0})


def test_share_of_springs_in_each_split(tmp_path: Path):
    """3,000 pairs, so four standard errors are 0.04; out of distribution it is a half, whatever the option says."""
    settings = config(tmp_path, edge_probability=0.9, physics=replace(SHORT, frames=2, substeps=1))
    off_diagonal = ~np.eye(5, dtype=np.bool_)
    for split, share in (("train", 0.9), ("val", 0.9), ("test", 0.9), ("ood", 0.5)):
        types = np.stack([e.edge_types[0] for e in make_episodes(settings, split, 300) if e.edge_types is not None])
        assert types[:, off_diagonal].mean() == pytest.approx(share, abs=0.04), split


def test_written_stores(tmp_path: Path):
    took = make(config(tmp_path / "data"))
    assert sorted(p.name for p in (tmp_path / "data").iterdir()) == sorted(took) == ["ood", "test", "train", "val"]
    store = read_store(tmp_path / "data" / "train")
    assert (store.info.spec, store.info.source) == (spring_spec(SHORT), "5-springs")
    assert store.info.edge_attribute_names == ("spring_constant",)
    assert store.info.provenance["split"] == "train"
    expected = make_episodes(config(tmp_path), "train", 4)
    assert len(store.episodes) == 4
    for ours, made in zip(store.episodes, expected, strict=True):
        np.testing.assert_array_equal(ours.states, made.states)
        np.testing.assert_array_equal(ours.edge_types, made.edge_types)
        np.testing.assert_array_equal(ours.edge_attributes, made.edge_attributes)
        assert ours.valid.all() and ours.states.shape == (6, 5, 4) and ours.edge_types.shape == (1, 5, 5)
    assert {e.label for e in read_store(tmp_path / "data" / "ood").episodes} == {"ood"}


def test_layout():
    spec = spring_spec(Physics(num_agents=7, dt_s=0.2))
    assert (spec.dt_s, spec.frame, spec.has_ego, spec.max_agents) == (0.2, ("world", "world"), False, 7)


def test_splits_without_rollouts_are_left_out(tmp_path: Path):
    assert list(make(config(tmp_path / "data", train=0, ood=0))) == ["val", "test"]


# --- Bad input --------------------------------------------------------------------------------------------------------


def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The one line that a refusal prints; its exit status is checked here."""
    monkeypatch.setattr(sys, "argv", ["springs", *map(str, words)])
    with pytest.raises(SystemExit) as stop:
        run_entry_point(springs.main)
    assert stop.value.code == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1
    return captured.err.removeprefix("error: ").strip()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--train", "-1"], "train must not be negative, got -1"),
        (["--edge-probability", "1.5"], "edge_probability must lie between 0 and 1, got 1.5"),
        (
            ["--physics.kind", "charged", "--edge-probability", "0.5"],
            "charges act on all pairs, got edge_probability 0.5; leave it out",
        ),
        (["--physics.frames", "1"], "frames must be at least 2, got 1"),
        (["--physics.substeps", "0"], "substeps must be positive, got 0"),
        (["--physics.box-m", "-5"], "box_m must be positive, got -5.0"),
        (["--physics.num-agents", "0"], "num_agents must be positive, got 0"),
        (
            ["--train", "0", "--val", "0", "--test", "0", "--ood", "0"],
            "nothing to simulate: train, val, test and ood are all 0",
        ),
    ],
)
def test_bad_arguments_are_named_and_nothing_is_written(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    words: list[str],
    message: str,
):
    assert run(monkeypatch, capsys, "--out", tmp_path / "data", *words) == message
    assert list(tmp_path.iterdir()) == []


def test_existing_splits_are_not_overwritten_unasked(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    """No split is written if any of them is there already."""
    make(config(tmp_path / "data", train=0, val=0, ood=0))
    capsys.readouterr()
    before = (tmp_path / "data" / "test" / "zarr.json").read_bytes()
    given = run(monkeypatch, capsys, "--out", tmp_path / "data", "--train", 2)
    assert given == f"{tmp_path}/data/test exists; choose another --out or pass --overwrite"
    assert [p.name for p in (tmp_path / "data").iterdir()] == ["test"]
    assert (tmp_path / "data" / "test" / "zarr.json").read_bytes() == before
    make(config(tmp_path / "data", seed=1, overwrite=True))
    assert len(read_store(tmp_path / "data" / "train").episodes) == 4
    assert "kept" not in capsys.readouterr().err
    make(config(tmp_path / "data", seed=2, ood=0, overwrite=True))
    assert f"kept as it is: {tmp_path}/data/ood\n" in capsys.readouterr().err, "it is of another seed than the rest"


def test_constants_must_be_positive(tmp_path: Path):
    with pytest.raises(UserError, match="position_std_m must be positive, got 0"):
        replace(SHORT, position_std_m=0.0)


# --- Training on it ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_charges_train_a_model_of_three_edge_types(tmp_path: Path):
    """None, attraction, repulsion: from the simulator to a step on supervised types and attributes."""
    charged = config(tmp_path / "data", physics=replace(SHORT, kind="charged"), train=6)
    make(charged)
    settings = TrainConfig(
        (tmp_path / "data" / "train",),
        tmp_path / "run",
        val_data=(tmp_path / "data" / "val",),
        preset="fast",
        set=("num_edge_types=3", "hidden_dim=6", "rnn_dim=4"),
        type_label_weight=1.0,
        label_weight=1.0,
        batch_size=4,
        history_steps=3,
        horizon_steps=2,
        lr=1e-2,
    )
    trainer = Trainer(settings, load_data(settings))
    first = trainer.train_step()
    assert {"type_label", "label", "graph_accuracy"} <= first.keys() and all(map(math.isfinite, first.values()))
    assert trainer.data.val[0].flat.edge_types.values.max() == 2
    for _ in range(30):
        last = trainer.train_step()
    assert last["type_label"] < first["type_label"]


# --- Kicks ------------------------------------------------------------------------------------------------------------


def test_without_kicks_nothing_changes_and_with_kicks_everything_before_them_is_the_same():
    plain, kicked = (SpringsConfig(Path("unused"), kicks=share, physics=Physics(frames=12)) for share in (0.0, 1.0))
    calm, hit = (springs.make_episodes(one, "train", 6) for one in (plain, kicked))
    frames = set()
    for before, after in zip(calm, hit, strict=True):
        assert before.perturbed is None and after.perturbed is not None
        ((frame, particle),) = np.argwhere(after.perturbed)
        assert PERTURBATIONS[after.perturbed[frame, particle]] == "kick"
        np.testing.assert_array_equal(after.states[: frame + 1], before.states[: frame + 1])
        change = after.states[frame + 1] - before.states[frame + 1]
        assert np.linalg.norm(change[:, 2:], axis=-1).argmax() == particle
        assert 0.5 < np.linalg.norm(change[particle, 2:]) < 1.5
        frames.add(int(frame))
    assert len(frames) > 1


def test_a_share_of_the_rollouts_is_kicked_and_the_store_says_which(tmp_path: Path):
    config = SpringsConfig(tmp_path, train=40, val=0, test=0, ood=0, kicks=0.5, physics=Physics(frames=4))
    springs.make(config)
    episodes = read_store(tmp_path / "train").episodes
    shares = [e.perturbed is not None and bool(e.perturbed.any()) for e in episodes]
    assert 10 < sum(shares) < 30


def test_kicks_out_of_range_are_named(tmp_path: Path):
    with pytest.raises(UserError, match="kicks must lie between 0 and 1, got 1.5"):
        SpringsConfig(tmp_path, kicks=1.5)
    with pytest.raises(UserError, match="kick_mps must be positive, got 0"):
        SpringsConfig(tmp_path, kicks=0.5, kick_mps=0.0)


@pytest.mark.parametrize(
    "sizes", [{"train": 10**9}, {"train": 2000, "physics": Physics(num_agents=10**4, frames=10**6)}]
)
def test_what_cannot_fit_into_memory_is_named_with_the_number_that_was_given(sizes: dict[str, Any], tmp_path: Path):
    with pytest.raises(UserError, match=f"train={sizes['train']:,} needs at least"):
        SpringsConfig(tmp_path / "springs", **sizes)
