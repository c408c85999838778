"""What a training run is made of: its data, its config, its schedules, and every kind of model through all of it."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from predictor.checkpoint import load_checkpoint, save_checkpoint
from predictor.data.device_windows import window_sizes
from predictor.data.store import Episode, StoreInfo, write_store
from predictor.data.windows import Windows
from predictor.dgvae.config import PRESETS
from predictor.evaluation import outcomes as outcomes_module
from predictor.models import build, name_of
from predictor.scene import KINEMATIC_FEATURES, KINEMATIC_FEATURES_3D, SceneSpec
from predictor.support.errors import UserError
from predictor.train import train
from predictor.training import fitted_scales
from predictor.training import trainer as trainer_module
from predictor.training.config import TrainConfig
from predictor.training.fitted_scales import typical_change, typical_neighbour, typical_spread
from predictor.training.objective import window_loss
from predictor.training.start import model_config
from predictor.training.trainer import Trainer
from predictor.training.training_data import TrainingData, load_data
from tests.predictor.helpers import FAST_LIKE, circling_episode, random_states, spec, write_circles

SMALL = {"steps": 2, "batch_size": 4, "history_steps": 3, "horizon_steps": 2, "val_fraction": 0.34, "eval_every": 2}
INPUTS = {"input_changes": "change_scales", "fit_inputs": "input_scales", "edge_geometry": "geometry_scales"}
# Every kind of model at a size that trains in milliseconds, as a user would ask for it.
MODELS: dict[str, dict[str, Any]] = {
    "dgvae": {"set": ("hidden_dim=5", "rnn_dim=4")},
    "dgvae-bare": {"input_changes": False, "fit_inputs": False, "edge_geometry": False},
    "dgvae-rich": {
        "set": ("static_dim=2", "innovation_rounds=1", "substeps=2", "gated_messages=true", "residual=trapezoid"),
    },
    "dgvae-plural": {"set": ("num_modes=3", "rollout_graph=frozen")},
    "dnri": {"set": ("hidden_dim=5", "rnn_dim=4", "decoder_dim=6", "message_dim=7")},
    "imma": {"set": ("hidden_dim=5", "rnn_dim=4", "decoder_dim=6", "message_dim=7", "num_layers=3")},
    "lstm": {"set": ("embed_dim=5", "rnn_dim=4")},
    "lstm-joint": {"set": ("embed_dim=5", "rnn_dim=4", "joint=true")},
    "mlp": {"set": ("hidden_dim=5",)},
}
pytestmark = pytest.mark.usefixtures("tiny")


def config(data: Path, out: Path, **changes: Any) -> TrainConfig:
    preset: dict[str, Any] = {} if "init" in changes else {"preset": "fast"}  # the tiny network, without modes
    return TrainConfig(data=(data,), out=out, **(preset | SMALL | changes))


def made(settings: TrainConfig) -> Trainer:
    return Trainer(settings, load_data(settings))


def fitted_config(settings: TrainConfig, data: TrainingData) -> Any:
    return model_config(settings, data.spec, data.train_episodes)


def test_gradients_are_clipped_to_the_norm_that_was_asked_for(tmp_path: Path):
    data = write_circles(tmp_path / "data", episodes=3, steps=6)
    trainer = made(config(data, tmp_path / "out", clip_norm=1e-3))
    before = float(trainer.train_step()["grad_norm"])
    gradients = [p.grad for p in trainer.model.parameters() if p.grad is not None]
    after = float(torch.stack([gradient.norm() for gradient in gradients]).norm())
    assert before > 0.01 and after == pytest.approx(1e-3, rel=1e-2)


# --- Every kind of model ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", MODELS)
def test_every_model_trains_and_comes_back(circles: Path, tmp_path: Path, kind: str):
    name = kind.partition("-")[0]
    settings = config(circles, tmp_path / "run", model=name, **MODELS[kind])
    loaded, info = load_checkpoint(train(settings))
    assert (name_of(loaded), info.model, info.config) == (name, name, loaded.config)
    assert info.provenance["train_config"]["model"] == name
    assert info.provenance["result"]["step"] == 2
    assert loaded.config.delta_scales and math.isfinite(info.provenance["result"]["val_min_ade_m"])
    for override in settings.set:
        what, _, value = override.partition("=")
        assert str(getattr(loaded.config, what)).lower() == value
    trained = Trainer(settings, load_data(settings))
    trained.restore(tmp_path / "run" / "train_state.pt")
    for name_, value in trained.model.state_dict().items():
        assert torch.equal(loaded.state_dict()[name_], value), name_
    states, valid = random_states(0, 1, 2, 4), torch.ones(1, 2).bool()
    trained.model.eval()
    forecasts = []
    for forecaster in (trained.model, loaded):
        belief = forecaster.observe(forecaster.empty_memory(1, 2), states, valid)[1]
        forecasts.append(forecaster.rollout(belief, 2).states)
    assert torch.equal(*forecasts)


@pytest.mark.parametrize("kind", MODELS)
def test_every_model_moves_all_of_its_weights(tmp_path: Path, kind: str):
    crowd = write_circles(tmp_path / "crowd", agents=3)  # attention over a single other agent has nothing to learn
    settings = config(crowd, tmp_path / "run", model=kind.partition("-")[0], **MODELS[kind])
    trainer = made(settings)
    before = {name: p.detach().clone() for name, p in trainer.model.named_parameters()}
    terms = trainer.train_step()
    assert all(map(math.isfinite, terms.values()))
    assert ("kl" in terms) == (kind.startswith(("dgvae", "dnri")))
    still = {name for name, p in trainer.model.named_parameters() if torch.equal(p, before[name])}
    assert not still


@pytest.mark.parametrize(
    ("kind", "expected"), [("dgvae-plural", [2, 3, 2, 3]), ("dgvae", [None] * 4)], ids=["modes", "no-modes"]
)
def test_steps_take_turns_with_few_and_all_modes(circles: Path, tmp_path: Path, kind: str, expected: list[Any]):
    """A model without modes is not asked for any."""
    trainer, asked = made(config(circles, tmp_path, **MODELS[kind])), []
    window = trainer.model.window

    def watching(*arguments: Any, **named: Any) -> Any:
        asked.append(named.get("num_modes"))
        output = window(*arguments, **named)
        assert (0 if output.modes is None else output.modes.states.shape[1]) == (asked[-1] or 0)
        return output

    trainer.model.window = watching
    for _ in range(4):
        terms = trainer.train_step()
        assert ({"energy", "joint_energy", "nll_spread"} <= set(terms)) == (kind == "dgvae-plural")
    assert asked == expected


@pytest.mark.parametrize(("kind", "samples"), [("dgvae-plural", 3), ("dgvae", trainer_module.VALIDATION_DRAWS)])
def test_modes_are_validated_as_enumerated_and_others_by_draws(
    circles: Path, tmp_path: Path, kind: str, samples: int, monkeypatch: pytest.MonkeyPatch
):
    trainer = made(config(circles, tmp_path, **MODELS[kind]))
    (first, _), (second, _) = trainer.validate(), trainer.validate()
    with monkeypatch.context() as patch:  # nobody reaches the last step
        patch.setattr("predictor.training.trainer.fitted_std_m", lambda outcomes: (1.0, math.nan))
        assert trainer.validate()[1] == ()
    assert first.num_samples == samples and first.energy_m == second.energy_m
    assert bool(first.mixture_nll) == bool(first.mixture_coverage) == (kind == "dgvae-plural")


@pytest.mark.parametrize("model", ["dnri", "mlp"])
def test_teacher_forced_training_takes_no_free_run(circles: Path, tmp_path: Path, model: str):
    """As the NRI family is trained; validation is a free run all the same."""
    trainer = made(config(circles, tmp_path, model=model, rollout_weight=0.0, set=("hidden_dim=4",)))
    terms = trainer.train_step()
    assert "nll_rollout" not in terms and "nll_one_step" in terms
    assert math.isfinite(trainer.validate()[0].min_ade_m)


# --- Config of the network --------------------------------------------------------------------------------------------


def test_scales_are_fitted_to_the_training_episodes(circles: Path, tmp_path: Path):
    """All of them, unless options say otherwise."""
    settings = config(circles, tmp_path, set=("residual=trapezoid",))
    data = load_data(settings)
    fitted = fitted_config(settings, data)
    assert fitted.delta_scales == typical_change(data.train_episodes, spec(), "trapezoid")
    assert fitted.change_scales == typical_change(data.train_episodes, spec(), "state")
    assert fitted.input_scales == typical_spread(data.train_episodes, spec())
    assert fitted.geometry_scales == typical_neighbour(data.train_episodes, spec())
    assert fitted.delta_scales[:2] != fitted.change_scales[:2]
    assert fitted.delta_scales[2:] == fitted.change_scales[2:]
    plain = replace(fitted, delta_scales=(), change_scales=(), input_scales=(), geometry_scales=())
    assert plain == replace(FAST_LIKE, residual="trapezoid")
    for option, scales in INPUTS.items():
        unset = fitted_config(replace(settings, **{option: False}), data)
        assert unset == replace(fitted, **{scales: ()}) != fitted


def test_a_network_that_nothing_was_said_about_is_plural_and_has_all_inputs(circles: Path, tmp_path: Path):
    settings = TrainConfig((circles,), tmp_path)
    made_of = fitted_config(settings, load_data(settings))
    plural = PRESETS["plural"]
    assert plural.num_modes and all(getattr(made_of, scales) for scales in INPUTS.values())
    assert replace(made_of, delta_scales=(), **dict.fromkeys(INPUTS.values(), ())) == plural


def test_given_scales_win_over_fitted_ones(circles: Path, tmp_path: Path):
    settings = config(circles, tmp_path, model="mlp", set=("delta_scales=1,2,3,4",))
    assert fitted_config(settings, load_data(settings)).delta_scales == (1.0, 2.0, 3.0, 4.0)


@pytest.mark.parametrize("model", ["dnri", "imma", "lstm", "mlp"])
def test_inputs_of_the_dgvae_have_no_effect_on_other_models(circles: Path, tmp_path: Path, model: Any):
    settings = config(circles, tmp_path, model=model)
    data = load_data(settings)
    without = replace(settings, **dict.fromkeys(INPUTS, False))
    assert fitted_config(settings, data) == fitted_config(without, data)
    assert settings.without_effect == tuple(INPUTS) and replace(settings, model="dgvae").without_effect == ()


def test_geometry_is_left_out_where_no_step_has_two_agents(tmp_path: Path):
    settings = config(write_circles(tmp_path / "alone", agents=1), tmp_path / "run")
    trainer = made(settings)
    fitted = trainer.model.config
    assert fitted.geometry_scales == () and fitted.change_scales and fitted.input_scales
    assert math.isfinite(trainer.read(trainer.train_step())["loss"])


@pytest.mark.parametrize(
    ("residual", "position"),
    # 3 m at 2 m/s, then 4 m at 3 m/s, ending at 5 m/s, along the third axis
    [
        ("state", math.sqrt((9 + 16) / 2)),
        ("constant_velocity", math.sqrt((1 + 1) / 2)),
        ("trapezoid", math.sqrt((0.5**2 + 0) / 2)),
    ],
)
def test_typical_change_in_space(residual: Any, position: float):
    states = np.zeros((3, 1, 6), dtype=np.float32)
    states[:, 0, 2], states[:, 0, 5] = (0.0, 3.0, 7.0), (2.0, 3.0, 5.0)
    layout = SceneSpec(1.0, ("world",) * 3, KINEMATIC_FEATURES_3D, (1.0,) * 6, has_ego=False)
    episode = replace(circling_episode(0, 3, 1), states=states)
    expected = [1e-3, 1e-3, position, 1e-3, 1e-3, math.sqrt((1 + 4) / 2)]
    assert typical_change([episode], layout, residual) == pytest.approx(expected)


# --- Data -------------------------------------------------------------------------------------------------------------


def test_validation_stores_are_used_as_they_are(circles: Path, tmp_path: Path):
    """All episodes of `data` train, all of `val_data` validate, and only `data` is what the model was made from."""
    write_store(tmp_path / "val", StoreInfo(spec(), "held out"), [circling_episode(100 + i, steps=7) for i in range(3)])
    settings = config(circles, tmp_path, val_data=(tmp_path / "val",), val_fraction=0.9)
    data = load_data(settings)
    assert ([len(w) for w in data.train], [len(w) for w in data.val]) == ([6 * 9], [3 * 6])
    assert (data.sources, data.spec) == (("circles",), spec())
    assert [e.seed for e in data.train_episodes] == list(range(6))
    assert data.val[0].batch(np.array([0])).states[0, 0, 0].tolist() == pytest.approx(
        circling_episode(100).states[0, 0].tolist()
    )


def test_a_checkpoint_sees_as_many_agents_as_the_largest_of_its_stores(circles: Path, tmp_path: Path):
    larger = replace(spec(), max_agents=spec().max_agents + 5)
    write_store(tmp_path / "larger", StoreInfo(larger, "larger"), [circling_episode(i) for i in range(50, 56)])
    both = replace(config(circles, tmp_path), data=(circles, tmp_path / "larger"))
    assert load_data(both).spec == larger
    validated = config(circles, tmp_path, val_data=(tmp_path / "larger",))
    assert load_data(validated).spec == spec()


def test_a_store_does_not_validate_what_it_trains(circles: Path, tmp_path: Path):
    with pytest.raises(UserError, match="val_data holds a store of data, so that nothing would be held out"):
        load_data(config(circles, tmp_path, val_data=(circles,)))


def test_no_episode_of_a_store_validates_what_another_trains(circles: Path, tmp_path: Path):
    """Stores of one environment and of overlapping seeds hold the same episodes, though their contents differ."""
    recorded = StoreInfo(spec(), "env", {"seed": 0})
    write_store(tmp_path / "train", recorded, [circling_episode(i) for i in range(6)])
    write_store(tmp_path / "other", recorded, [circling_episode(i, steps=7) for i in range(6, 9)])
    others = [replace(circling_episode(i, steps=7), label="another driver") for i in range(4, 9)]
    write_store(tmp_path / "val", recorded, others)
    write_store(tmp_path / "elsewhere", replace(recorded, source="another"), [circling_episode(0)])
    begun = replace(config(circles, tmp_path), data=(circles, tmp_path / "train"))
    said = r"val \(val_data\) plays 2 of the episodes of .*train: the same environment and seeds, such as 4; collect it"
    with pytest.raises(UserError, match=said):
        load_data(replace(begun, val_data=(tmp_path / "elsewhere", tmp_path / "val")))
    data = load_data(replace(begun, val_data=(tmp_path / "elsewhere", tmp_path / "other")))
    assert len(data.val) == 2 and len(data.train_episodes) == 12
    for name, count in (("idle", 15), ("random", 12)):
        driven = [replace(circling_episode(i, steps=4 + len(name)), label=name) for i in range(count)]
        write_store(tmp_path / name, recorded, driven)
    trained = load_data(replace(begun, data=(tmp_path / "idle", tmp_path / "random"))).train_episodes
    idle, random = ({e.seed for e in trained if e.label == label} for label in ("idle", "random"))
    assert random == idle & set(range(12)) and 0 < len(random) < 8  # 4 of 12 are held out, and others of the 15


def test_no_recording_validates_what_it_trains(circles: Path, tmp_path: Path):
    """A file that was cut into episodes of another length has the same scenes."""
    whole = circling_episode(3, steps=12)
    stretch = replace(whole, states=whole.states[4:], valid=whole.valid[4:], seed=0)
    for name, episodes in (("val", [circling_episode(40), stretch]), ("other", [circling_episode(40)])):
        write_store(tmp_path / name, StoreInfo(spec(), "files", {"split": name}), episodes)
    write_store(tmp_path / "train", StoreInfo(spec(), "files", {"split": "train"}), [whole, circling_episode(9)])
    begun = replace(config(circles, tmp_path), data=(tmp_path / "train",))
    said = r"val \(val_data\) has 8 of its \d+ scenes in common with .*train: the same recording; make it from other"
    with pytest.raises(UserError, match=said):
        load_data(replace(begun, val_data=(tmp_path / "val",)))
    assert len(load_data(replace(begun, val_data=(tmp_path / "other",))).val) == 1


@pytest.mark.parametrize("recordings", [6, 5])
def test_stretches_of_one_recording_stay_on_one_side_of_the_split(recordings: int, circles: Path, tmp_path: Path):
    """With five recordings a tenth is none, so that stretches are held out."""
    labels = [f"video {i % recordings}" for i in range(4 * recordings)]
    stretches = [replace(circling_episode(i), label=label, seed=i) for i, label in enumerate(labels)]
    of_each = [int(label.split()[1]) for label in labels]
    write_store(tmp_path / "read", StoreInfo(spec(), "videos", {"recordings": of_each}), stretches)
    write_store(tmp_path / "made", StoreInfo(spec(), "videos"), stretches)
    for seed in range(4):
        trained, made = (
            load_data(
                replace(config(circles, tmp_path), data=(tmp_path / name,), seed=seed, val_fraction=0.1)
            ).train_episodes
            for name in ("read", "made")
        )
        held = set(range(len(labels))) - {episode.seed for episode in trained}
        assert len(made) == 4 * recordings - 2
        if recordings == 6:
            assert len({labels[i] for i in held}) == 1 and len(held) == 4
        else:
            assert [e.seed for e in trained] == [e.seed for e in made] and len(held) == 2


def test_a_recording_in_two_stores_is_on_one_side_of_the_split(circles: Path, tmp_path: Path):
    walks = [replace(circling_episode(i), label=f"video {i}", seed=i) for i in range(12)]
    for name, of_store in (("all", walks), ("half", walks[:6])):
        recordings = {"recordings": [walk.label for walk in of_store]}
        write_store(tmp_path / name, StoreInfo(spec(), "videos", recordings), of_store)
    for seed in range(6):
        both = replace(config(circles, tmp_path), data=(tmp_path / "all", tmp_path / "half"), seed=seed)
        found = load_data(replace(both, val_fraction=0.25))
        trained, held = speeds_in(found.train), speeds_in(found.val)
        assert held and trained and not held & trained


def speeds_in(parts: list[Windows]) -> set[int]:
    """Returns the speeds of all agents, by which an episode of circles is known: they never change [0.1 mm/s]."""
    found = [part.flat.states[..., 2:4].norm(dim=-1).flatten() for part in parts]
    return {int(speed) for speed in (1e4 * torch.cat(found)).round().tolist() if speed > 0}


def test_few_recordings_are_told(circles: Path, tmp_path: Path):
    stretches = [replace(circling_episode(i), seed=i) for i in range(6)]
    for name, recordings in (("two", [0, 0, 0, 1, 1, 1]), ("six", list(range(6)))):
        write_store(tmp_path / name, StoreInfo(spec(), "videos", {"recordings": recordings}), stretches)
    settings = replace(config(circles, tmp_path), val_fraction=0.2)
    (told,) = load_data(replace(settings, data=(tmp_path / "two",))).notes
    assert "two: 2 are too few recordings to hold out 20% of them, so stretches are held out beside those" in told
    assert load_data(replace(settings, data=(tmp_path / "six",))).notes == ()
    write_store(tmp_path / "one", StoreInfo(spec(), "videos", {"recordings": [0]}), stretches[:1])
    with pytest.raises(UserError, match="1 episodes split into .* convert with a smaller --episode-steps, or pass --v"):
        load_data(replace(settings, data=(tmp_path / "one",)))


def test_stores_that_differ_in_frame_or_range_are_named(circles: Path, tmp_path: Path):
    near = replace(spec(), perception_m=7.5)
    write_store(tmp_path / "near", StoreInfo(near, "near"), [circling_episode(i) for i in range(6)])
    both = replace(config(circles, tmp_path), data=(tmp_path / "near", circles))
    (note,) = Trainer(both, load_data(both)).notes
    assert note.startswith("perception_m is 7.5 in ") and f"near and {spec().perception_m} in " in note
    assert note.endswith("circles; the checkpoint keeps that of the first") and load_data(both).spec == near
    scaled = replace(spec(), feature_scales=tuple(2 * scale for scale in spec().feature_scales))
    write_store(tmp_path / "scaled", StoreInfo(scaled, "scaled"), [circling_episode(i) for i in range(6)])
    assert load_data(replace(both, data=(circles, tmp_path / "scaled"))).notes[0].startswith("feature_scales is ")
    alike = replace(both, data=(circles, circles))
    assert load_data(alike).notes == ()


@pytest.mark.parametrize(
    ("name", "value", "shown"),
    [("feature_names", (*KINEMATIC_FEATURES, "size"), "size"), ("constant_features", ("role",), "role")],
)
def test_stores_of_different_features_do_not_mix(name: str, value: Any, shown: str, tmp_path: Path):
    first = replace(spec(), feature_names=(*KINEMATIC_FEATURES, "role"), feature_scales=(1.0,) * 5)
    paths = tmp_path / "first", tmp_path / "second"
    for path, layout in zip(paths, (first, replace(first, **{name: value})), strict=True):
        episodes = [circling_episode(i) for i in range(6)]
        wider = [replace(e, states=np.pad(e.states, ((0, 0), (0, 0), (0, 1)))) for e in episodes]
        write_store(path, StoreInfo(layout, "circles"), wider)
    with pytest.raises(UserError, match=f"the same {name}, but .*first has .* and .*second has .*{shown}"):
        load_data(replace(config(tmp_path / "first", tmp_path), data=paths))


def test_validation_stores_must_fit(circles: Path, tmp_path: Path):
    write_store(tmp_path / "val", StoreInfo(spec(dt_s=0.2), "quick"), [circling_episode(0)])
    with pytest.raises(UserError, match=r"the same dt_s, but .*circles has 1\.0 and .*val has 0\.2"):
        load_data(config(circles, tmp_path, val_data=(tmp_path / "val",)))


@pytest.mark.parametrize("given", [False, True], ids=["held_out", "given"])
def test_training_episodes_can_be_limited(circles: Path, tmp_path: Path, given: bool):
    """The first ones of each training store; validation is what it was."""
    write_store(tmp_path / "val", StoreInfo(spec(), "circles"), [circling_episode(i) for i in range(70, 73)])
    changes = {"val_data": (tmp_path / "val",)} if given else {}
    everything, few = (load_data(config(circles, tmp_path, max_episodes=n, **changes)) for n in (0, 2))
    assert [e.seed for e in few.train_episodes] == [e.seed for e in everything.train_episodes][:2]
    assert [len(w) for w in few.train] == [2 * 9]
    assert [len(w) for w in few.val] == [len(w) for w in everything.val]


def test_a_store_that_is_listed_twice_counts_twice(circles: Path, tmp_path: Path):
    """Its held-out episodes stay out of both."""
    once = load_data(config(circles, tmp_path))
    twice = load_data(replace(config(circles, tmp_path), data=(circles, circles)))
    assert [len(w) for w in twice.train] == 2 * [len(w) for w in once.train]
    assert [e.seed for e in twice.train_episodes] == 2 * [e.seed for e in once.train_episodes]
    assert len(twice.sources) == 2 and [len(w) for w in twice.val] == 2 * [len(w) for w in once.val]


def test_validation_may_ask_for_whole_histories_and_horizons(circles: Path, tmp_path: Path):
    """As in the tables: `history_steps` of burn-in and the whole horizon; training windows stay as they were."""
    loose, strict = (load_data(config(circles, tmp_path, val_history_steps=n)) for n in (1, 3))
    assert strict.val[0].index[:, 1].min() == 2 and strict.val[0].index[:, 1].max() == 10 - 2 - 1
    assert loose.val[0].index[:, 1].min() == 0 and loose.val[0].index[:, 1].max() == 10 - 1 - 1
    assert np.array_equal(strict.train[0].index, loose.train[0].index)
    batch = strict.val[0].batch(np.arange(len(strict.val[0])))
    assert (batch.last_observed == 2).all() and batch.valid[..., 0].all()


@pytest.mark.parametrize(
    ("option", "needed"), [("label_weight", "edge_attributes"), ("type_label_weight", "edge_types")]
)
def test_weights_of_labels_need_labels(circles: Path, tmp_path: Path, option: str, needed: str):
    """In every training store; validation does without."""
    labels = {
        "edge_types": np.zeros((1, 2, 2), dtype=np.int8),
        "edge_attributes": np.zeros((1, 2, 2, 1), dtype=np.float32),
    }
    episodes = [replace(circling_episode(i), **{needed: labels[needed]}) for i in range(70, 73)]
    write_store(tmp_path / "labelled", StoreInfo(spec(), "labelled"), episodes)
    fine = config(tmp_path / "labelled", tmp_path / "run", val_data=(circles,), **{option: 1.0})
    assert len(load_data(fine).train_episodes) == 3
    with pytest.raises(UserError, match=f"{option} needs {needed}, and store .*circles has none; set it to 0 or use"):
        load_data(replace(fine, data=(tmp_path / "labelled", circles)))


@pytest.mark.parametrize("data_device", ["cpu", "device"])
def test_stores_with_other_attributes_train_together_unless_these_are_labels(tmp_path: Path, data_device: str):
    stores = (("gap", "speed"), ("gap", "speed", "wish"))
    for names in stores:
        known = np.ones((1, 2, 2, len(names)), dtype=np.float32)
        episodes = [replace(circling_episode(i), edge_attributes=known) for i in range(3)]
        write_store(tmp_path / str(len(names)), StoreInfo(spec(), "road", edge_attribute_names=names), episodes)
    both = (tmp_path / "2", tmp_path / "3")
    settings = replace(config(both[0], tmp_path / "run", data_device=data_device), data=both)
    assert train(settings).exists()
    message = "the same edge attributes in every store, but .*2 has gap, speed, .*3 has gap, speed, wish; train on one"
    with pytest.raises(UserError, match=message):
        load_data(replace(settings, label_weight=1.0))


# --- Schedules --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Seen:
    """What one training step was like."""

    history_steps: int
    rollout_steps: int
    kl_scale: float
    states: Tensor = field(compare=False)


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> list[Seen]:
    """Filled by every training step."""
    seen: list[Seen] = []

    def watching(model: Any, batch: Any, output: Any, settings: Any, kl_scale: Tensor, scales: Tensor) -> Any:
        longest = int(batch.last_observed.max()) + 1
        seen.append(Seen(longest, output.rollout.shape[2], float(kl_scale), batch.states.clone()))
        return window_loss(model, batch, output, settings, kl_scale, scales)

    monkeypatch.setattr(trainer_module, "window_loss", watching)
    return seen


def run(settings: TrainConfig, steps: int, restore: Path | None = None) -> Trainer:
    trainer = made(settings)
    if restore:
        trainer.restore(restore)
    for _ in range(steps):
        trainer.train_step()
    return trainer


@pytest.mark.parametrize(
    ("changes", "what", "expected"),
    [
        ({}, "rollout_steps", [3] * 8),
        ({"curriculum_steps": 6}, "rollout_steps", [1, 1, 1, 2, 2, 2, 3, 3]),
        ({"curriculum_steps": 2}, "rollout_steps", [1, 2, 3, 3, 3, 3, 3, 3]),
        ({"rollout_weight": 0.0}, "rollout_steps", [0] * 8),
        ({}, "kl_scale", [1.0] * 8),
        ({"kl_warmup_steps": 4}, "kl_scale", [0.25, 0.5, 0.75, 1.0, 1.0, 1.0, 1.0, 1.0]),
        ({"kl_warmup_steps": 1}, "kl_scale", [1.0] * 8),
        ({}, "history_steps", [5] * 8),
        ({"min_history_steps": 5}, "history_steps", [5] * 8),
    ],
)
def test_schedules(circles: Path, tmp_path: Path, watched: list[Seen], changes: Any, what: str, expected: list[Any]):
    run(config(circles, tmp_path, history_steps=5, horizon_steps=3, batch_size=32, **changes), 8)
    assert [getattr(seen, what) for seen in watched] == expected


def test_histories_are_drawn_between_the_shortest_and_the_longest(circles: Path, tmp_path: Path, watched: list[Seen]):
    run(config(circles, tmp_path, model="mlp", min_history_steps=2, history_steps=4, batch_size=32), 40)
    drawn = [seen.history_steps for seen in watched]
    assert set(drawn) == {2, 3, 4}
    assert min(drawn.count(n) for n in (2, 3, 4)) > 5


@pytest.mark.slow
def test_schedules_are_functions_of_seed_and_step(circles: Path, tmp_path: Path, watched: list[Seen]):
    """A run that is resumed sees the very batches that it would have seen."""
    settings = config(
        circles, tmp_path, min_history_steps=1, history_steps=5, horizon_steps=3, curriculum_steps=5, kl_warmup_steps=5
    )
    run(settings, 6)
    whole = list(watched)
    run(settings, 2).save(tmp_path / "state")
    watched.clear()
    np.random.default_rng().random(), torch.manual_seed(123)
    run(settings, 4, restore=tmp_path / "state")
    assert len(watched) == 4
    for ours, expected in zip(watched, whole[2:], strict=True):
        assert ours == expected and torch.equal(ours.states, expected.states)
    watched.clear()
    run(replace(settings, seed=1), 6)
    assert [s.history_steps for s in watched] != [s.history_steps for s in whole]
    assert [(s.rollout_steps, s.kl_scale) for s in watched] == [(s.rollout_steps, s.kl_scale) for s in whole]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "check"),
    [
        ({"edge_cost": 50.0}, lambda terms: terms["prior_edge_share"]),
        ({"kl_weight": 50.0}, lambda terms: terms["kl"]),
    ],
    ids=["edge_cost", "kl"],
)
def test_weights_of_the_objective_are_felt(
    circles: Path, tmp_path: Path, changes: dict[str, float], check: Callable[[dict[str, float]], float]
):
    def after(**weights: float) -> float:
        trainer = made(config(circles, tmp_path, lr=0.2, batch_size=16, variance=1.0, **weights))
        for _ in range(20):
            terms = trainer.train_step()
        return check(trainer.read(terms))

    assert after(**changes) < 0.5 * after(**dict.fromkeys(changes, 0.0))


def test_inputs_are_divided_by_their_spread_in_the_frame_of_the_spec():
    """A road of 500 m by 12 m: the lane gets a scale of metres; relative to the ego, 10 km do not count."""
    rng = np.random.default_rng(0)
    states = np.zeros((40, 2, 4), dtype=np.float32)
    states[..., 0] = 10_000 + rng.uniform(0, 500, (40, 2))
    states[..., 1] = rng.uniform(0, 12, (40, 2))
    states[..., 2] = 25 + rng.normal(size=(40, 2))
    episode = Episode(states, np.ones((40, 2), dtype=np.bool_), np.arange(2))
    world = typical_spread([episode], SceneSpec(dt_s=1.0))
    assert world == pytest.approx([*states.reshape(-1, 4).std(axis=0)[:3], 0.3], rel=1e-3)  # a spread of 0 has a floor
    relative = typical_spread([episode], SceneSpec(dt_s=1.0, frame=("ego", "world")))
    assert relative[0] == pytest.approx((states[..., 0] - states[:, :1, 0]).std(), rel=1e-3)


def test_typical_neighbours_are_the_nearest_ones():
    states = np.zeros((2, 3, 4), dtype=np.float32)
    states[:, :, 0] = [0.0, 3.0, 10.0]
    states[:, :, 2] = [5.0, 7.0, 4.0]
    valid = np.ones((2, 3), dtype=np.bool_)
    valid[1, 1] = False  # then the others are 10 m apart
    episode = Episode(states, valid, np.arange(3))
    # distances 3, 3, 7, 10, 10; relative speeds 2, 2, 3, 1, 1
    assert typical_neighbour([episode], spec()) == pytest.approx((7.0, 2.0))


def test_an_agent_alone_has_no_typical_neighbour():
    alone = Episode(np.zeros((3, 1, 4), dtype=np.float32), np.ones((3, 1), dtype=np.bool_), np.arange(1))
    assert typical_neighbour([alone], spec()) == ()
    apart = Episode(np.zeros((2, 2, 4), dtype=np.float32), np.eye(2, dtype=np.bool_), np.arange(2))  # never together
    assert typical_neighbour([alone, apart], spec()) == ()


# --- From a checkpoint ------------------------------------------------------------------------------------------------


def test_training_may_start_from_a_checkpoint(circles: Path, tmp_path: Path):
    first = train(config(circles, tmp_path / "first", set=("num_modes=3", "rollout_graph=frozen")))
    began = made(config(circles, tmp_path / "second", init=str(tmp_path / "first"), horizon_steps=1))
    source, info = load_checkpoint(first)
    assert began.model.config == info.config and began.model.horizon_steps == 1
    for name, value in source.state_dict().items():
        assert torch.equal(began.model.state_dict()[name], value), name


@pytest.mark.slow
def test_the_spread_alone_may_be_trained(circles: Path, tmp_path: Path):
    """Of a checkpoint whose modes have one spread, too: means, probabilities and all other weights stay bit by bit."""
    first = train(config(circles, tmp_path / "first", set=("num_modes=3", "rollout_graph=frozen")))
    settings = config(
        circles, tmp_path / "second", init=str(tmp_path / "first"), only_spread=True, steps=40, lr=0.1, eval_every=20
    )
    began = made(settings)
    before, _ = began.validate()
    last = train(settings)
    (old, old_info), (new, new_info) = load_checkpoint(first), load_checkpoint(last)
    told = new_info.provenance["spread"]
    assert new_info == replace(
        old_info,
        config=replace(old_info.config, spread_by_type=True),
        provenance=old_info.provenance | {"spread": told},
    )
    moved = {
        name for name, value in new.state_dict().items() if not torch.equal(value, old.state_dict().get(name, value))
    }
    assert moved == {"self_edges.spread.weight", "self_edges.spread.bias"}
    assert len(new.self_edges.spread_shift.unique(dim=0)) == 3
    states = random_states(0, 2, 1, 3, 4)
    one, other = (m.rollout(m.observe(m.empty_memory(2, 3), states[:, 0], torch.ones(2, 3).bool())[1], 2, 3)
                  for m in (old, new))  # fmt: skip
    assert torch.equal(one.states, other.states) and torch.equal(one.mode_probs, other.mode_probs)
    result = told["result"]
    assert (
        told["train_config"]["only_spread"]
        and result["step"] > 0
        and result["val_mixture_nll"] < float(np.mean(before.mixture_nll))
    )
    assert began.score(before) == float(np.mean(before.mixture_nll)) != before.energy_m
    plain = made(config(circles, tmp_path / "third"))
    assert plain.score(before) == before.energy_m
    again = made(replace(settings, init=str(last)))
    assert torch.equal(again.model.self_edges.spread_shift, new.self_edges.spread_shift)


def test_only_the_spread_needs_roll_outs_and_a_checkpoint_that_has_one(circles: Path, tmp_path: Path):
    with pytest.raises(UserError, match="only_spread is of roll-outs, and rollout_weight is 0"):
        config(circles, tmp_path / "second", init="anywhere", only_spread=True, rollout_weight=0.0, horizon_steps=2)
    with pytest.raises(UserError, match="only_spread keeps the network of its checkpoint; leave --set out"):
        config(circles, tmp_path / "second", init="anywhere", only_spread=True, set=("static_dim=1",))
    with pytest.raises(UserError, match="only_spread needs the checkpoint whose spread it trains; pass --init"):
        config(circles, tmp_path / "second", only_spread=True)
    train(config(circles, tmp_path / "first"))
    with pytest.raises(UserError, match="only_spread needs a checkpoint with modes, and '.*first' has none"):
        made(config(circles, tmp_path / "second", init=str(tmp_path / "first"), only_spread=True))


def test_the_spread_keeps_the_horizon_and_the_scenes_of_its_checkpoint(circles: Path, tmp_path: Path):
    modes = ("num_modes=3", "rollout_graph=frozen")
    _, info = load_checkpoint(train(config(circles, tmp_path / "first", set=modes)))
    only_spread = config(circles, tmp_path / "second", init=str(tmp_path / "first"), only_spread=True)
    with pytest.raises(UserError, match="only_spread keeps the horizon of '.*first', 2 steps, got horizon_steps=1"):
        made(replace(only_spread, horizon_steps=1))
    framed = replace(spec(), frame=("centroid", "centroid"))
    write_store(tmp_path / "framed", StoreInfo(framed, "circles"), [circling_episode(i) for i in range(6)])
    assert made(replace(only_spread, data=(tmp_path / "framed",))).model.spec == info.spec


def test_an_episode_held_out_in_one_store_is_not_trained_on_in_another(tmp_path: Path):
    """Plain episodes and branches of the same seeds, and a store that counts twice."""
    info = StoreInfo(spec(), "circles", provenance={"seed": 0})
    write_store(tmp_path / "plain", info, [circling_episode(i) for i in range(10)])
    write_store(tmp_path / "branches", info, [circling_episode(i, steps=12) for i in range(8)])
    for name, source, made_by in (("other", "elsewhere", {"seed": 0}), ("numbered", "circles", {})):
        info = StoreInfo(spec(), source, provenance=made_by)  # of the last, seeds only number the episodes
        write_store(tmp_path / name, info, [circling_episode(i) for i in range(10)])
    names = ("plain", "branches", "plain", "other", "numbered")
    data = load_data(replace(config(tmp_path, tmp_path / "run"), data=tuple(tmp_path / name for name in names)))
    counts = [len(windows.flat.steps) for windows in data.val]
    assert counts == [3, 3, 3, 3, 3]
    alone = [load_data(config(tmp_path / name, tmp_path / "run")) for name in names]
    held_out = [
        set(range(n)) - {e.seed for e in one.train_episodes} for n, one in zip((10, 8, 10, 10, 10), alone, strict=True)
    ]
    trained = [len(windows.flat.steps) for windows in data.train]
    left = [len(set(range(n)) - held_out[0] - held_out[1]) for n in (10, 8, 10)]
    assert trained == [*left, 7, 7] and held_out[0] != held_out[1] and trained[0] < 7


@pytest.mark.parametrize("pairs", [1, 10_000_000])
def test_neighbours_are_found_in_parts(pairs: int, monkeypatch: pytest.MonkeyPatch):
    episodes = [circling_episode(i, agents=4) for i in range(2)]
    whole = typical_neighbour(episodes, spec())
    monkeypatch.setattr(fitted_scales, "_MOST_PAIRS", pairs)
    assert typical_neighbour(episodes, spec()) == whole


def test_a_validation_forwards_as_many_windows_as_its_pairs_allow(
    circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    trainer, sizes = made(config(circles, tmp_path / "run", val_windows=10)), list[int]()
    observe, agents = trainer.model.observe, 2
    whole, _ = trainer.validate()

    def watched(memory: Any, states: Tensor, valid: Tensor) -> Any:
        sizes.append(len(states))
        return observe(memory, states, valid)

    monkeypatch.setattr(trainer.model, "observe", watched)
    monkeypatch.setattr(outcomes_module, "MOST_PAIRS", 3 * agents**2 * trainer_module.VALIDATION_DRAWS)
    parts, _ = trainer.validate()
    assert max(sizes) == 3 and parts.ade_m == pytest.approx(whole.ade_m) and parts.agents == whole.agents


def test_a_gradient_that_is_not_finite_changes_no_weight(
    circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    trainer = made(config(circles, tmp_path / "run"))
    before = {name: value.clone() for name, value in trainer.model.state_dict().items()}
    monkeypatch.setattr(torch.nn.utils, "clip_grad_norm_", lambda *given: torch.tensor(torch.nan))
    with pytest.raises(UserError, match="the gradient is nan at step 0; lower --lr or check the data"):
        trainer.train_step()
    assert all(torch.equal(value, before[name]) for name, value in trainer.model.state_dict().items())
    trainer._checks_each_loss = False  # as on a CUDA device
    terms = dict.fromkeys(trainer.train_step(), torch.zeros(()))
    with pytest.raises(UserError, match="the loss or its gradient was not finite in some step from 0 to 0"):
        trainer.read(terms)


def test_a_run_does_not_go_on_from_a_checkpoint_that_was_trained_anew(circles: Path, tmp_path: Path):
    """Its weights would be under scales that they were not trained with."""
    train(config(circles, tmp_path / "first"))
    begun = config(circles, tmp_path / "second", init=str(tmp_path / "first"), steps=4, eval_every=2)
    train(replace(begun, steps=2))
    kept = load_checkpoint(tmp_path / "first" / "checkpoint")
    other = replace(kept[1].config, delta_scales=tuple(2 * s for s in kept[1].config.delta_scales))
    model = build(kept[1].model, kept[1].spec, other, kept[1].horizon_steps)
    save_checkpoint(tmp_path / "first" / "checkpoint", model, replace(kept[1], config=other))
    with pytest.raises(UserError, match="cannot resume: '.*first' has another network than when the run began"):
        train(replace(begun, resume=True))


def test_a_start_takes_the_frame_and_range_of_the_data(circles: Path, tmp_path: Path):
    first = str(train(config(circles, tmp_path / "first")))
    seen = replace(spec(frame=("ego", "world"), perception_m=50.0), feature_scales=(7.0, 7.0, 7.0, 7.0))
    write_store(tmp_path / "moving", StoreInfo(seen, "circles"), [circling_episode(i) for i in range(6)])
    began = made(config(tmp_path / "moving", tmp_path / "second", init=first))
    assert began.model.spec == replace(seen, feature_scales=spec().feature_scales)
    kept = load_checkpoint(train(config(tmp_path / "moving", tmp_path / "second", init=first)))[1]
    assert kept.spec == began.model.spec


def test_a_start_weighs_errors_by_the_scales_of_the_checkpoint(circles: Path, tmp_path: Path):
    first = str(train(config(circles, tmp_path / "first")))
    others = replace(spec(), feature_scales=tuple(10 * scale for scale in spec().feature_scales))
    write_store(tmp_path / "others", StoreInfo(others, "circles"), [circling_episode(i) for i in range(6)])
    began = made(config(tmp_path / "others", tmp_path / "second", init=first))
    assert tuple(began._scales.tolist()) == spec().feature_scales


def test_a_start_with_another_ego_is_named(circles: Path, tmp_path: Path):
    first = str(train(config(circles, tmp_path / "first")))
    write_store(tmp_path / "equals", StoreInfo(spec(has_ego=False), "circles"), [circling_episode(i) for i in range(6)])
    with pytest.raises(UserError, match="first.*' needs episodes with an ego but store .*equals has none"):
        made(config(tmp_path / "equals", tmp_path / "second", init=first))
    with pytest.raises(UserError, match="the same has_ego, but .*circles has True and .*equals has False; train on"):
        load_data(config(circles, tmp_path / "second", val_data=(tmp_path / "equals",)))


def write_followers(path: Path, speed_mps: float = 20.0, gap_s: float = 0.0) -> Path:
    """Circles with causal labels (an intervention on agent 0 moves agent 1 by 2 m); agent 0 leads agent 1."""
    episodes = []
    for i in range(6):
        plain = circling_episode(i)
        steps, agents = plain.valid.shape
        types = np.tile(-np.eye(agents, dtype=np.int8), (steps, 1, 1))
        shift_m = np.full((steps, agents, agents), np.nan, dtype=np.float32)
        attributes = np.zeros((steps, agents, agents, 2), dtype=np.float32)
        types[:, 1, 0], shift_m[:, 1, 0], attributes[:, 1, 0] = 1, 2.0, (speed_mps + i, 1.0 + gap_s * i)
        episodes.append(replace(plain, edge_types=types, edge_attributes=attributes, causal_shift_m=shift_m))
    names = ("desired_speed_mps", "time_gap_s")
    info = StoreInfo(spec(), "circles", edge_attribute_names=names, causal_threshold_m=1.0)
    write_store(path, info, episodes)
    return path


LABELS: dict[str, Any] = {"causal_edges": True, "label_weight": 1.0}


@pytest.mark.parametrize("init", [False, True])
def test_features_learn_what_is_known_of_edges_in_units_of_its_spread(tmp_path: Path, init: bool):
    """From random weights and from a checkpoint that learned none."""
    data, changes = write_followers(tmp_path / "followers"), dict(LABELS)
    if init:
        changes["init"] = str(train(config(data, tmp_path / "first", causal_edges=True)))
    trainer = made(config(data, tmp_path / "second", **changes))
    learned = trainer.model.config
    assert learned.feature_labels == ("desired_speed_mps", "", "leader", "")  # the others never vary here
    speeds = [e.edge_attributes[..., 0] for e in trainer.data.train_episodes if e.edge_attributes is not None]
    known = np.concatenate([speed[np.isfinite(speed)] for speed in speeds]).astype(np.float64)
    assert learned.label_means == pytest.approx((known.mean(), 0, 1 / 2, 0)) and known.std() > 0
    assert learned.label_scales == pytest.approx((known.std(), 1, 0.5, 1))
    assert "label" in trainer.train_step()
    plain = made(config(data, tmp_path / "third", causal_edges=True))
    assert not plain.model.config.feature_labels and "label" not in plain.train_step()


def test_features_that_are_learned_keep_their_unit(tmp_path: Path):
    """Weights that are kept emit what they emitted before; what they have not learned is fitted to the new data."""
    first = train(config(write_followers(tmp_path / "one"), tmp_path / "first", **LABELS))
    before = load_checkpoint(first)[1].config
    faster = write_followers(tmp_path / "two", speed_mps=100.0, gap_s=2.0)
    after = made(config(faster, tmp_path / "second", init=str(first), **LABELS)).model.config
    assert after.feature_labels == ("desired_speed_mps", "", "leader", "time_gap_s")
    assert (after.label_means[0], after.label_scales[0]) == (before.label_means[0], before.label_scales[0])
    assert before.label_means[0] < 30 and after.label_means[3] > 2
    mute = write_followers(tmp_path / "three", speed_mps=-9.0)  # drivers that yield throughout: their wish is not known
    kept = made(config(mute, tmp_path / "third", init=str(first), **LABELS)).model.config
    assert kept.feature_labels[0] == "desired_speed_mps"
    assert (kept.label_means[0], kept.label_scales[0]) == (before.label_means[0], before.label_scales[0])


def test_an_attribute_that_never_varies_is_not_learned(tmp_path: Path):
    """Its error, in no unit, was hundreds of times as large as that of all others."""
    trainer = made(config(write_followers(tmp_path / "followers"), tmp_path / "first", **LABELS))
    learned = trainer.model.config
    units = learned.in_units(torch.ones(2, len(learned.feature_labels)))
    assert [bool(column.isnan().all()) for column in units.T] == [not name for name in learned.feature_labels]
    assert float(trainer.train_step()["label"]) < 10


def test_learned_causal_features_are_not_taught_the_attributes_of_a_store(tmp_path: Path):
    """They stand in other columns: a time gap would be taught as a wished speed."""
    data = write_followers(tmp_path / "followers")
    first = str(train(config(data, tmp_path / "first", **LABELS)))
    with pytest.raises(UserError, match="have learned causal attributes, .*; pass --causal-edges, or leave"):
        made(config(data, tmp_path / "second", init=first, label_weight=1.0))
    made(config(data, tmp_path / "second", init=first))


def test_more_attributes_than_features_are_refused_before_a_run_is_made(tmp_path: Path):
    data, out = write_followers(tmp_path / "followers"), tmp_path / "out"
    few = config(data, out, label_weight=1.0, set=("edge_feature_dim=1",))
    with pytest.raises(UserError, match="restricted labelling of 2 attributes needs as many edge features, got 1"):
        train(few)
    assert not out.exists()


@pytest.mark.slow
def test_a_run_with_labels_goes_on_where_it_stopped(tmp_path: Path):
    data = write_followers(tmp_path / "followers")
    first = str(train(config(data, tmp_path / "first", causal_edges=True)))
    whole = config(data, tmp_path / "whole", init=first, steps=4, set=("static_dim=1",), **LABELS)
    train(whole)
    stopped = replace(whole, out=tmp_path / "stopped")
    train(replace(stopped, steps=2))
    train(replace(stopped, resume=True))
    ours, theirs = (load_checkpoint(tmp_path / name)[0].state_dict() for name in ("stopped", "whole"))
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    kept = load_checkpoint(tmp_path / "stopped")[1].config
    assert kept.static_dim == 1 and kept.feature_labels == ("desired_speed_mps", "", "leader", "")


@pytest.mark.slow
def test_what_began_well_is_kept_if_training_makes_it_worse(circles: Path, tmp_path: Path):
    first = train(config(circles, tmp_path / "first", steps=30, lr=1e-2))
    harmed = train(config(circles, tmp_path / "second", init=str(first), lr=200.0))
    before, after = (load_checkpoint(path)[0].state_dict() for path in (first, harmed))
    assert all(torch.equal(before[name], after[name]) for name in before)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fit_inputs": False}, "init takes the network of 'RUN'; leave out fit_inputs"),
        ({"preset": "paper", "set": ("rnn_dim=3",)}, "leave out preset$"),
        ({"set": ("rnn_dim=3",)}, "--set rnn_dim=3 needs other weights than checkpoint 'RUN' has; change only"),
        ({"model": "lstm"}, "is of model dgvae; pass --model dgvae"),
        ({"init": "nowhere"}, "nowhere"),
    ],
)
def test_a_start_that_does_not_fit_is_named(circles: Path, tmp_path: Path, changes: dict[str, Any], message: str):
    first = str(train(config(circles, tmp_path / "first")))
    with pytest.raises(UserError, match=message.replace("RUN", first)):
        made(config(circles, tmp_path / "second", **({"init": first} | changes)))


def test_windows_in_which_nobody_is_seen_are_not_trained_on(tmp_path: Path):
    """Batches are sorted by their number of agents: some would have none, and their steps would teach nothing."""
    episodes = []
    for seed in range(6):
        walk = circling_episode(seed, 4)
        states, valid = (np.zeros((40, *part.shape[1:]), part.dtype) for part in (walk.states, walk.valid))
        states[30:34], valid[30:34] = walk.states, walk.valid
        episodes.append(replace(walk, states=states, valid=valid))
    write_store(tmp_path / "street", StoreInfo(spec(has_ego=False), "street"), episodes)
    settings = config(tmp_path / "street", tmp_path / "run", steps=8, preset="plural", set=("num_modes=2",))
    data = load_data(settings)
    assert all(window_sizes(windows).all() for windows in data.train) and not window_sizes(data.val[0]).all()
    assert train(settings) == settings.out / "checkpoint"


def test_a_recording_of_nobody_is_named(tmp_path: Path):
    walks = [circling_episode(seed, 8) for seed in range(6)]
    nobody = [replace(walk, states=0 * walk.states, valid=np.zeros_like(walk.valid)) for walk in walks]
    write_store(tmp_path / "street", StoreInfo(spec(has_ego=False), "street"), nobody)
    with pytest.raises(UserError, match="no agent is there in any window of the episodes for training"):
        load_data(config(tmp_path / "street", tmp_path / "run"))


@pytest.mark.parametrize(("frame", "expected"), [("centroid", True), ("world", False)])
def test_new_networks_see_changes_of_place(frame: Any, expected: bool, tmp_path: Path):
    """Where the origin jumps; a network that is trained on keeps what it saw."""
    store = StoreInfo(spec((frame, "world"), has_ego=False), "street")
    write_store(tmp_path / "street", store, [circling_episode(seed) for seed in range(6)])
    settings = config(tmp_path / "street", tmp_path / "run")
    assert made(settings).model.config.changes_of_place == expected
    old = train(replace(settings, set=("changes_of_place=false",)))
    begun = made(config(tmp_path / "street", tmp_path / "next", init=str(old)))
    assert begun.model.config.changes_of_place is False


def test_a_validation_draws_its_windows_from_all_held_out_episodes(circles: Path, tmp_path: Path):
    few = {"val_fraction": 0.5, "val_windows": 12}
    [(windows, drawn)] = made(config(circles, tmp_path / "run", **few))._val_indices()
    [(_, again)] = made(config(circles, tmp_path / "run", **few))._val_indices()
    assert len(set(drawn.tolist())) == 12 < len(windows) and drawn.tolist() == again.tolist()
    assert set(windows.index[drawn, 0]) == set(windows.index[:, 0])


def test_weights_whose_score_is_not_finite_do_not_replace_the_last_ones(
    circles: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(Trainer, "score", lambda trainer, accuracy: 1.0 if trainer.step == 2 else float("nan"))
    train(config(circles, tmp_path / "run", keep="last", steps=6, eval_every=2))
    assert load_checkpoint(tmp_path / "run")[1].provenance["result"]["step"] == 2
