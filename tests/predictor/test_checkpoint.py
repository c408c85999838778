import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from predictor import checkpoint
from predictor.baselines.constant_velocity import ConstantVelocity
from predictor.checkpoint import (
    CheckpointInfo,
    load_checkpoint,
    load_forecaster,
    name_of_folder,
    names_of,
    resolve,
    save_checkpoint,
)
from predictor.dgvae import DGVAE
from predictor.scene import SceneSpec
from predictor.support.errors import UserError
from tests.predictor.helpers import EVERY_MODEL, ROAD, any_model, model, random_presence, random_states, spec

INFO = CheckpointInfo(
    spec(ROAD),
    replace(model().config, delta_scales=(0.1, 0.2, 0.3, 1 / 3)),
    horizon_steps=4,
    std_m=(0.1, 0.25, 1 / 3, 0.7),
    sources=("toy-v0", "toy-v1"),
    provenance={"command": "python -m predictor.train", "result": {"step": 3}},
)


def made(seed: int = 0) -> DGVAE:
    torch.manual_seed(seed)
    return DGVAE(INFO.spec, INFO.config, INFO.horizon_steps)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A good checkpoint."""
    save_checkpoint(tmp_path / "toy", made(), INFO)
    return tmp_path / "toy"


def assert_holds(path: Path, expected: DGVAE) -> None:
    weights = load_checkpoint(path)[0].state_dict()
    assert weights.keys() == expected.state_dict().keys()
    for name, value in expected.state_dict().items():
        assert torch.equal(weights[name], value), name


def edit(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    content = json.loads((path / "config.json").read_text())
    change(content)
    (path / "config.json").write_text(json.dumps(content))


# --- Round trip -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("mask", "file_mode", "folder_mode"), [(0o022, 0o644, 0o755), (0o077, 0o600, 0o700)])
def test_modes_follow_the_umask(tmp_path: Path, mask: int, file_mode: int, folder_mode: int):
    before = os.umask(mask)
    try:
        save_checkpoint(tmp_path / "toy", made(), INFO)
    finally:
        os.umask(before)
    modes = {file.name: file.stat().st_mode & 0o777 for file in (tmp_path / "toy").iterdir()}
    assert modes == {"config.json": file_mode, "model.safetensors": file_mode}
    assert (tmp_path / "toy").stat().st_mode & 0o777 == folder_mode


def test_round_trip_is_exact(path: Path):
    assert_holds(path, made())
    loaded, info = load_checkpoint(path)
    assert info == INFO
    assert (loaded.spec, loaded.config, loaded.horizon_steps) == (INFO.spec, INFO.config, INFO.horizon_steps)
    assert sorted(p.name for p in path.iterdir()) == ["config.json", "model.safetensors"]
    assert [p.name for p in path.parent.iterdir()] == ["toy"]


def test_loaded_model_forecasts_what_the_saved_one_did(path: Path):
    states, valid = random_states(0, 2, 3, 4), torch.ones(2, 3).bool()
    forecasts = []
    for forecaster in (made().eval(), load_checkpoint(path)[0]):
        belief = forecaster.observe(forecaster.empty_memory(2, 3), states, valid)[1]
        forecasts.append(forecaster.rollout(belief, 4).states)
    assert torch.equal(*forecasts)


def test_loading_draws_nothing_from_torchs_global_generator(path: Path):
    before = torch.get_rng_state()
    load_checkpoint(path)
    assert torch.equal(torch.get_rng_state(), before)


def test_loaded_model_is_in_evaluation_mode(path: Path):
    assert not load_checkpoint(path)[0].training


def test_saving_again_replaces(path: Path):
    save_checkpoint(path, made(1), INFO)
    assert_holds(path, made(1))
    assert [p.name for p in path.parent.iterdir()] == ["toy"]


@pytest.mark.parametrize("beside", ["notes.txt", "train_state.pt", "checkpoint"])
def test_what_is_no_checkpoint_alone_is_never_replaced(path: Path, tmp_path: Path, beside: str):
    """A run folder, a folder of notes: all that they hold would be deleted."""
    (path / beside).write_text("years of work")
    mine = tmp_path / "mine"
    mine.mkdir()
    save_checkpoint(mine, made(), INFO)  # an empty folder
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "config.json").write_text("{}")
    for folder, named in ((path, beside), (tmp_path / "other", "config.json"), (tmp_path, "mine")):
        before = sorted(folder.rglob("*"))
        with pytest.raises(UserError, match=f"holds {named} and is no checkpoint, which alone is replaced; choose"):
            save_checkpoint(folder, made(1), INFO)
        assert sorted(folder.rglob("*")) == before
    assert (path / beside).read_text() == "years of work"


def test_a_checkpoint_with_its_card_is_replaced(path: Path):
    for name in ("README.md", "in_env.json"):
        (path / name).write_text("{}")
    save_checkpoint(path, made(1), INFO)
    assert sorted(p.name for p in path.iterdir()) == ["config.json", "model.safetensors"]


# --- Failed saves -----------------------------------------------------------------------------------------------------


def crash(*args: object, **kwargs: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("point", ["weights", "config", "replace"])
@pytest.mark.parametrize("existing", [True, False], ids=["overwriting", "new"])
def test_failed_save_leaves_the_old_checkpoint_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, point: str, existing: bool
):
    path = tmp_path / "toy"
    if existing:
        save_checkpoint(path, made(), INFO)
    before = {p.name: p.read_bytes() for p in path.iterdir()} if existing else {}
    match point:
        case "weights":
            monkeypatch.setattr(checkpoint, "save", crash)
        case "config":
            monkeypatch.setattr(checkpoint, "asdict", crash)
        case "replace":
            monkeypatch.setattr("predictor.support.files._replace_folder", crash)
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(path, made(1), INFO)
    monkeypatch.undo()
    assert [p.name for p in tmp_path.iterdir()] == ["toy"] * existing
    if existing:
        assert {p.name: p.read_bytes() for p in path.iterdir()} == before


def test_crash_in_the_moment_of_replacement_leaves_a_whole_checkpoint_beside(
    path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(os, "replace", crash)
    with pytest.raises(KeyboardInterrupt):
        save_checkpoint(path, made(1), INFO)
    monkeypatch.undo()
    (left,) = path.parent.iterdir()
    assert_holds(left, made())
    save_checkpoint(path, made(2), INFO)  # and the next save is not hindered
    assert_holds(path, made(2))


# --- Files that are no good -------------------------------------------------------------------------------------------


def truncated_weights(path: Path) -> None:
    file = path / "model.safetensors"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def no_weights(path: Path) -> None:
    (path / "model.safetensors").unlink()


def weights_are_text(path: Path) -> None:
    (path / "model.safetensors").write_text("PK, this is not it")


def foreign_weights(path: Path) -> None:
    save_file({"linear.weight": torch.zeros(3, 3)}, path / "model.safetensors")


def weights_of_another_size(path: Path) -> None:
    wider = DGVAE(INFO.spec, replace(INFO.config, rnn_dim=6), INFO.horizon_steps)
    save_file(wider.state_dict(), path / "model.safetensors")


def one_weight_missing(path: Path) -> None:
    tensors = load_file(path / "model.safetensors")
    del tensors["decoder.readout.bias"]
    save_file(tensors, path / "model.safetensors")


def weights_not_finite(path: Path) -> None:
    tensors = load_file(path / "model.safetensors")
    tensors["decoder.readout.bias"][1] = float("nan")
    save_file(tensors, path / "model.safetensors")


def truncated_config(path: Path) -> None:
    (path / "config.json").write_text((path / "config.json").read_text()[:100])


def no_config(path: Path) -> None:
    (path / "config.json").unlink()


def config_is_binary(path: Path) -> None:
    (path / "config.json").write_bytes(b"\x80\x04\x95\xff\xfe")


def foreign_json(path: Path) -> None:
    (path / "config.json").write_text('{"model_type": "bert", "hidden_size": 768}')


def json_list(path: Path) -> None:
    (path / "config.json").write_text("[1, 2]")


def newer_version(path: Path) -> None:
    edit(path, lambda c: c.update(version=2))


def unknown_size(path: Path) -> None:
    edit(path, lambda c: c["config"].update(attention_heads=4))


def unknown_spec_field(path: Path) -> None:
    edit(path, lambda c: c["spec"].update(lidar=True))


def no_spec(path: Path) -> None:
    edit(path, lambda c: c.pop("spec"))


def impossible_size(path: Path) -> None:
    edit(path, lambda c: c["config"].update(rnn_dim=0))


def impossible_dt(path: Path) -> None:
    edit(path, lambda c: c["spec"].update(dt_s=-1.0))


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (truncated_weights, r"toy/model\.safetensors is no safetensors file \(.*\); copy or train it again"),
        (no_weights, r"toy/model\.safetensors cannot be read"),
        (weights_are_text, r"toy/model\.safetensors is no safetensors file"),
        (
            foreign_weights,
            r"toy/model\.safetensors: tensor '\S+' should be \(.*\) by config\.json but is absent",
        ),
        (
            weights_of_another_size,
            r"tensor 'encoder\.\S+' should be \((5|20).*\) by config\.json but is \((6|24).*do not belong together",
        ),
        (one_weight_missing, r"tensor 'decoder\.readout\.bias' should be \(4,\) by config\.json but is absent"),
        (weights_not_finite, r"toy/model\.safetensors: tensor 'decoder\.readout\.bias' is not finite; train it again"),
        (truncated_config, r"toy/config\.json, line \d+: no JSON \(.*\); get it anew"),
        (no_config, r"toy is not a predictor checkpoint \(it has no config\.json\)"),
        (config_is_binary, r"toy/config\.json, line 1: expected text in UTF-8"),
        (foreign_json, r"toy is not a predictor checkpoint \(config\.json has no format 'dgvae-rl predictor'\)"),
        (json_list, "toy is not a predictor checkpoint"),
        (newer_version, "checkpoint .*toy has version 2, this release reads 1"),
        (unknown_size, r"config\.json: config: unknown key 'attention_heads'"),
        (unknown_spec_field, "spec: unknown key 'lidar'; there are dt_s, frame"),
        (no_spec, r"config\.json: key 'spec' is missing"),
        (impossible_size, "config: rnn_dim must be at least 1, got 0"),
        (impossible_dt, "spec: dt_s must be positive, got -1.0"),
    ],
)
def test_bad_files_are_refused(path: Path, damage: Callable[[Path], None], message: str):
    damage(path)
    before = {p.name: p.read_bytes() for p in path.iterdir()}
    with pytest.raises(UserError, match=message) as error:
        load_checkpoint(path)
    assert "\n" not in str(error.value)
    assert {p.name: p.read_bytes() for p in path.iterdir()} == before


# --- Names and specs --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_everything_that_ships_is_small_and_forecasts():
    assert checkpoint.shipped()
    for name in checkpoint.shipped():
        forecaster, info = load_checkpoint(name)
        agents = info.spec.max_agents
        states = torch.zeros(1, agents, info.spec.num_features)  # what lies beyond velocity is a role or a size
        states[..., :4] = random_states(0, 1, agents, 4)
        belief = forecaster.observe(forecaster.empty_memory(1, agents), states, torch.ones(1, agents).bool())[1]
        assert torch.isfinite(forecaster.rollout(belief, info.horizon_steps).states).all(), name
        assert len(info.std_m) == info.horizon_steps and info.provenance["command"], name
        assert (resolve(name) / "README.md").is_file(), name  # the model card
        assert sum(p.stat().st_size for p in resolve(name).iterdir()) < 5_000_000, name


def test_unknown_name_lists_the_known_ones(monkeypatch: pytest.MonkeyPatch, path: Path):
    monkeypatch.setattr(checkpoint, "PRETRAINED", path.parent)
    with pytest.raises(UserError) as error:
        resolve("highwy")
    assert str(error.value) == ("no checkpoint 'highwy': neither a folder nor a shipped name (toy, constant-velocity)")


def test_shipped_names_are_found(monkeypatch: pytest.MonkeyPatch, path: Path):
    monkeypatch.setattr(checkpoint, "PRETRAINED", path.parent)
    assert resolve("toy") == path
    assert load_checkpoint("toy")[1] == INFO


def test_half_written_folders_are_no_shipped_names(monkeypatch: pytest.MonkeyPatch, path: Path):
    path.rename(path.with_name(".toy.1234.partial"))
    monkeypatch.setattr(checkpoint, "PRETRAINED", path.parent)
    assert checkpoint.shipped() == []


def test_another_time_step_names_both_numbers(path: Path):
    with pytest.raises(UserError, match=r"was trained at dt_s=1 but env 'racetrack-v1' steps at dt_s=0.2; retrain"):
        load_forecaster(path, replace(INFO.spec, dt_s=0.2), "env 'racetrack-v1'")


def test_other_features_name_both_lists(path: Path):
    names, scales = (*INFO.spec.feature_names, "heading_rad"), (1.0,) * 5
    other = SceneSpec(1.0, feature_names=names, feature_scales=scales)
    with pytest.raises(
        UserError, match=r"features \('x_m', 'y_m', 'vx_mps', 'vy_mps'\) but env 'b' gives .*'heading_rad'"
    ):
        load_forecaster(path, other, "env 'b'")


def test_scenes_of_its_own_spec_are_taken(path: Path):
    assert load_forecaster(path, INFO.spec, "env 'a'").horizon_steps == 4


@pytest.mark.parametrize("load", [load_checkpoint, resolve])
def test_constant_velocity_has_no_weights(load: Callable[[str], object]):
    with pytest.raises(UserError, match="^'constant-velocity' has no weights; pass a checkpoint$"):
        load("constant-velocity")


def test_constant_velocity_takes_every_spec():
    forecaster = load_forecaster("constant-velocity", spec(dt_s=0.2), "env 'a'")
    assert isinstance(forecaster, ConstantVelocity) and forecaster.spec.dt_s == 0.2


# --- Every kind of model ----------------------------------------------------------------------------------------------


def save_any(path: Path, kind: str) -> CheckpointInfo:
    forecaster = any_model(kind)
    info = replace(
        INFO,
        spec=forecaster.spec,
        config=forecaster.config,
        horizon_steps=3,
        std_m=INFO.std_m[:3],
        model=EVERY_MODEL[kind][0],
    )
    save_checkpoint(path, forecaster, info)
    return info


@pytest.mark.parametrize("kind", EVERY_MODEL)
def test_every_model_comes_back_and_forecasts_the_same(tmp_path: Path, kind: str):
    info = save_any(tmp_path / "toy", kind)
    loaded, read = load_checkpoint(tmp_path / "toy")
    assert read == info
    assert type(loaded) is type(any_model(kind)) and not loaded.training
    loaded.requires_grad_(False)  # as the original: with gradients, torch may sum in another order
    states, valid = random_states(0, 4, 2, 4, 4), random_presence(0, 4, 2, 4)
    beliefs, forecasts = [], []
    for forecaster in (any_model(kind), loaded):
        memory = forecaster.empty_memory(2, 4)
        for now, present in zip(states, valid, strict=True):
            memory, belief = forecaster.observe(memory, now, present)
        beliefs.append(belief)
        forecasts.append(forecaster.rollout(belief, 3, 2, torch.Generator().manual_seed(0)).states)
    assert torch.equal(*forecasts)
    assert torch.equal(beliefs[0].edge_probs, beliefs[1].edge_probs)
    assert torch.equal(beliefs[0].edge_features, beliefs[1].edge_features)


def test_a_model_is_not_saved_under_another_ones_name(tmp_path: Path):
    with pytest.raises(UserError, match="the checkpoint says model 'mlp' but the network is 'dgvae'"):
        save_checkpoint(tmp_path / "toy", made(), replace(INFO, model="mlp"))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"model": "transformer"},
            "config.json: model: no model 'transformer'; there are dgvae, dnri, imma",
        ),
        ({"model": "mlp"}, "config: unknown key '.*'; there are hidden_dim, residual, delta_scales"),
        ({"horizon_steps": 0}, "config.json: horizon_steps must be at least 1, got 0"),
    ],
)
def test_impossible_models_are_refused(path: Path, change: dict[str, Any], message: str):
    edit(path, lambda c: c.update(change))
    with pytest.raises(UserError, match=message):
        load_checkpoint(path)


def test_weights_of_another_model_are_refused(path: Path, tmp_path: Path):
    save_any(tmp_path / "lstm", "lstm")
    (tmp_path / "lstm" / "model.safetensors").replace(path / "model.safetensors")
    with pytest.raises(
        UserError, match=r"tensor '\S+' should be \S+.* by config\.json but is .*do not belong together"
    ):
        load_checkpoint(path)


# --- Run folders ------------------------------------------------------------------------------------------------------


def run_folder(path: Path) -> Path:
    """A folder as `python -m predictor.train` leaves it, named as its checkpoint's parent."""
    save_checkpoint(path / "checkpoint", made(), CheckpointInfo(spec(), made().config, 2))
    (path / "config.json").write_text("{}")
    return path


def test_a_run_folder_stands_for_its_best_checkpoint(tmp_path: Path):
    run = run_folder(tmp_path / "run")
    assert resolve(run) == resolve(run / "checkpoint") == run / "checkpoint"
    assert_holds(run, made())


def test_a_folder_with_weights_of_its_own_stands_for_itself(path: Path):
    run_folder(path)
    assert resolve(path) == path


def test_a_run_without_a_checkpoint_stands_for_itself(tmp_path: Path):
    (tmp_path / "checkpoint").mkdir()
    assert resolve(tmp_path) == tmp_path
    with pytest.raises(UserError, match="is not a predictor checkpoint"):
        load_checkpoint(tmp_path)


def test_folders_and_shipped_names_keep_their_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    assert resolve("highway").parent == checkpoint.PRETRAINED
    run_folder(Path("highway"))
    assert resolve("highway") == Path("highway") / "checkpoint"


@pytest.mark.parametrize(
    ("given", "name"),
    [("highway", "highway"), ("runs/a", "a"), ("runs/a/", "a"), ("runs/a/checkpoint", "a"), ("a/best", "best")],
)
def test_a_checkpoint_is_called_like_its_folder_or_its_run(given: str, name: str):
    assert name_of_folder(given) == name


def test_a_run_is_named_also_from_within(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "run" / "checkpoint").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "run")
    assert name_of_folder(".") == name_of_folder("checkpoint") == "run"


# --- Devices ----------------------------------------------------------------------------------------------------------


def test_auto_is_a_device(path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    loaded, _ = load_checkpoint(path, "auto")
    assert {parameter.device.type for parameter in loaded.parameters()} == {"cpu"}
    with pytest.raises(UserError, match="device 'cuda' was asked for but torch finds no CUDA device"):
        load_checkpoint(path, "cuda")


def test_checkpoints_of_one_name_are_told_apart_by_the_folders_above(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    paths = ["a/run", "b/run/checkpoint", "c/other", "highway", "constant-velocity", "own:mine:make"]
    names = ["a/run", "b/run", "other", "highway", "constant-velocity", "mine:make"]
    assert list(names_of(paths).values()) == names
    assert list(names_of(["x/s/run", "y/s/run", "z/run"]).values()) == ["x/s/run", "y/s/run", "z/run"]
    assert names_of(["runs/highway", "highway"]) == {"runs/highway": "runs/highway", "highway": "highway"}
    assert names_of([]) == {}


@pytest.mark.parametrize("twice", [["a", "a"], ["runs/a", "runs/a/checkpoint"], ["highway", "highway"]])
def test_a_checkpoint_given_twice_is_refused(twice: list[str]):
    with pytest.raises(UserError, match="each checkpoint is given once, got"):
        names_of(twice)


def test_a_run_that_has_no_checkpoint_yet_is_named_as_one(tmp_path: Path):
    (tmp_path / "config.json").write_text('{"config": {"out": "runs/x", "eval_every": 250}}')
    with pytest.raises(UserError, match="is a training run without a checkpoint yet; train on, with --resume"):
        load_checkpoint(tmp_path)


@pytest.mark.parametrize(("called", "name"), [("loop", "loop"), ("checkpoint", "run")])
def test_a_link_to_itself_has_a_name_and_is_refused_where_it_is_read(tmp_path: Path, called: str, name: str):
    loop = tmp_path / "run" / called
    loop.parent.mkdir()
    loop.symlink_to(loop)
    assert name_of_folder(loop) == name and names_of([str(loop)]) == {str(loop): name}
    with pytest.raises(UserError, match=called):
        load_checkpoint(loop)


# --- Names and places -------------------------------------------------------------------------------------------------


def test_a_folder_without_a_checkpoint_hides_no_shipped_one(
    monkeypatch: pytest.MonkeyPatch, path: Path, tmp_path: Path
):
    monkeypatch.setattr(checkpoint, "PRETRAINED", path.parent)
    monkeypatch.chdir(tmp_path / "toy")
    Path("toy").mkdir()
    assert resolve("toy") == path, "a folder for recordings"
    with pytest.raises(UserError, match="toy is not a predictor checkpoint"):
        load_checkpoint("./toy")
    save_checkpoint(Path("toy"), made(1), INFO)
    assert resolve("toy") == Path("toy")
    assert_holds(Path("toy"), made(1))


def test_only_the_cache_of_a_hub_has_names_in_front_of_snapshots():
    assert name_of_folder("cache/models--me--merge/snapshots/5f6d877b") == "merge"
    assert name_of_folder("runs/exp/snapshots/100") == "100"


def test_numbers_of_numpy_are_numbers(tmp_path: Path):
    info = replace(INFO, horizon_steps=np.int64(4), std_m=tuple(np.float32([0.1, 0.25, 0.5, 0.7])))
    save_checkpoint(tmp_path / "toy", made(), info)
    assert load_checkpoint(tmp_path / "toy")[1].std_m == pytest.approx((0.1, 0.25, 0.5, 0.7))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda network: network.double(),
            r"/toy/model.safetensors: tensor '.*' must be float32 \(F32\), got F64; noth",
        ),
        (
            lambda network: network.decoder.readout.bias.data.fill_(np.nan),
            "'decoder.readout.bias' is not finite; train",
        ),
    ],
)
def test_weights_that_no_one_can_load_replace_nothing(path: Path, spoil: Callable[[Any], object], message: str):
    spoilt = made(1)
    spoil(spoilt)
    with pytest.raises(UserError, match=message):
        save_checkpoint(path, spoilt, INFO)
    assert_holds(path, made())
    assert [each.name for each in path.parent.iterdir()] == ["toy"]
