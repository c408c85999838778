"""The model with which a training begins: fresh weights with scales fitted to the data, or those of a checkpoint."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from torch import nn

from predictor.checkpoint import load_checkpoint
from predictor.data.causal_edges import CAUSAL_ATTRIBUTES
from predictor.data.store import Episode
from predictor.models import build, changed, configure
from predictor.scene import SceneSpec
from predictor.support.errors import UserError
from predictor.support.remote import address
from predictor.training.config import TrainConfig
from predictor.training.fitted_scales import typical_change, typical_label, typical_neighbour, typical_spread
from predictor.training.rescaling import SCALES, rescaled


def model_config(config: TrainConfig, spec: SceneSpec, episodes: Sequence[Episode]) -> Any:
    """Builds the network's config, with scales fitted to the training data.

    Raises:
        UserError: --set names a field that the model does not have.
    """
    plain = configure(config.model, config.preset, config.set)
    fitted: dict[str, Any] = {"delta_scales": typical_change(episodes, spec, plain.residual)}
    if config.model == "dgvae":
        if config.input_changes:
            fitted["change_scales"] = typical_change(episodes, spec, "state")
            fitted["changes_of_place"] = "centroid" in spec.frame
        if config.fit_inputs:
            fitted["input_scales"] = typical_spread(episodes, spec)
        if config.edge_geometry:
            fitted["geometry_scales"] = typical_neighbour(episodes, spec)
        fitted |= _labels(config, episodes)
    return configure(config.model, config.preset, config.set, **fitted)


def _labels(config: TrainConfig, episodes: Sequence[Episode], learned: Any = None) -> dict[str, Any]:
    """Returns fields of the network's config that say which attributes its first feature dimensions learn.

    Args:
        config: the training's config.
        episodes: episodes to which mean and standard deviation of each attribute are fitted.
        learned: config of a network whose weights are kept; those of attributes that it has learned stay as they are,
            also where the data do not know them.
    """
    if not (config.label_weight and config.causal_edges):
        return {}
    found = [typical_label(episodes, column) for column in range(len(CAUSAL_ATTRIBUTES))]
    for column, name in enumerate(CAUSAL_ATTRIBUTES if learned and learned.label_means else ()):
        if learned.feature_labels[column : column + 1] == (name,):
            found[column] = learned.label_means[column], learned.label_scales[column]
    names = (name if label else "" for name, label in zip(CAUSAL_ATTRIBUTES, found, strict=True))
    means, scales = zip(*(label or (0.0, 1.0) for label in found), strict=True)
    return {"feature_labels": tuple(names), "label_means": means, "label_scales": scales}


def initial_model(config: TrainConfig, spec: SceneSpec, episodes: Sequence[Episode]) -> Any:
    """Builds the model with random weights, or with those of the checkpoint to start from, for the data's scenes.

    Raises:
        UserError: as `model_config`; or the checkpoint cannot be read, is of another model or network, or its scenes
            have other features, or an ego where the data's have none, or none where the data's have one; or only its
            spread shall be trained, and it has none, or another horizon; or modes, or labels of edges, would not learn.
    """
    if not config.init:
        network = model_config(config, spec, episodes)
        _check_learns(config, network, episodes)
        return build(config.model, spec, network, config.horizon_steps)
    source, info = load_checkpoint(config.init)
    if info.model != config.model:
        raise UserError(f"checkpoint '{config.init}' is of model {info.model}; pass --model {info.model}")
    info.spec.check_recorded(spec, f"checkpoint '{config.init}'", f"store {address(config.data[0])}")
    spec = replace(spec, feature_scales=info.spec.feature_scales)  # scales are the network's, the rest the data's
    if not config.only_spread:
        if config.refit_scales:
            fitted = model_config(replace(config, set=(f"residual={info.config.residual}",)), spec, episodes)
            source = rescaled(source, info.model, {name: getattr(fitted, name) for name in SCALES}, info.horizon_steps)
        taught = any(getattr(source.config, "feature_labels", ()))
        if config.label_weight and taught and not config.causal_edges:
            raise UserError(
                f"features of checkpoint '{config.init}' have learned causal attributes, and label_weight would teach "
                "them those of the store; pass --causal-edges, or leave --label-weight out"
            )
        network = changed(replace(source.config, **_labels(config, episodes, source.config)), config.set)
        _check_learns(config, network, episodes)
        plain = build(info.model, spec, network, config.horizon_steps)
        _fill(plain, source, config)
        return plain
    if not getattr(info.config, "num_modes", 0):
        raise UserError(f"only_spread needs a checkpoint with modes, and '{config.init}' has none; leave it out")
    if config.horizon_steps != info.horizon_steps:
        raise UserError(
            f"only_spread keeps the horizon of '{config.init}', {info.horizon_steps} steps, got horizon_steps="
            f"{config.horizon_steps}; leave --horizon-steps out"
        )
    # the checkpoint keeps its scenes, too: their frame is that of the forecasts around which the spread lies
    model: Any = build(info.model, info.spec, replace(info.config, spread_by_type=True), config.horizon_steps)
    of_types = model.self_edges.spread_shift
    model.load_state_dict({"self_edges.spread_shift": of_types, **source.state_dict()})
    model.requires_grad_(False)
    model.self_edges.spread.requires_grad_(True)
    of_types.requires_grad_(True)
    return model


def _check_learns(config: TrainConfig, network: Any, episodes: Sequence[Episode]) -> None:
    """Checks that the modes of a network, where it has them, and its edge features, where they are labelled, can learn.

    Raises:
        UserError: the training has no roll-outs, or the network fewer edge features than the data have attributes.
    """
    attributes = max((e.edge_attributes.shape[-1] for e in episodes if e.edge_attributes is not None), default=0)
    features = getattr(network, "edge_feature_dim", 0)
    if config.label_weight and attributes > features:
        raise UserError(
            f"restricted labelling of {attributes} attributes needs as many edge features, got {features}; raise "
            "edge_feature_dim or set label_weight to 0"
        )
    if getattr(network, "num_modes", 0) and not config.rollout_weight:
        raise UserError("modes learn from roll-outs, and rollout_weight is 0; pass --preset fast, or a weight")


def _fill(model: nn.Module, source: nn.Module, config: TrainConfig) -> None:
    """Gives the model the weights of the checkpoint.

    Raises:
        UserError: --set made another network.
    """
    wanted, given = (
        {name: tuple(weight.shape) for name, weight in network.state_dict().items()} for network in (model, source)
    )
    if wanted != given:
        raise UserError(
            f"--set {' '.join(config.set)} needs other weights than checkpoint '{config.init}' has; change only fields "
            "that leave their shapes, such as static_dim, or leave --init out"
        )
    model.load_state_dict(source.state_dict())
