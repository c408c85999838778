"""Trained policies on disk: a Stable-Baselines3 zip with a note inside.

The note (`note.json`) names the algorithm and holds what a policy needs beside its weights: the forecaster whose
forecasts it was trained on, which agents learned, and the driver of the others. It is part of the zip, so that a policy
drives everywhere as it was trained. SB3's own ``load`` still reads the zip. It holds pickled data: load only files
whose source you trust.
"""

import hashlib
import json
import math
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, get_args

import gymnasium as gym
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from envs.arms import Arm, EntryLayout
from envs.sb3.algorithms import Algorithm, algorithm_class, algorithm_named, algorithm_of_parameters
from predictor.checkpoint import CONSTANT_VELOCITY, WEIGHTS, resolve
from predictor.scene import SceneSpec
from predictor.support.errors import UserError

NOTE_ENTRY = "note.json"
_POLICY_KEY = "policy"
_ALGORITHM_KEY = "algorithm"


@dataclass(frozen=True)
class ForecasterPin:
    """Forecaster that a policy was trained on, and the wrapper's options."""

    checkpoint: str
    """Shipped name, folder, or "constant-velocity"."""
    sha256: str | None
    """SHA-256 of the weights (model.safetensors); None for constant velocity, which has none."""
    horizon_steps: int
    """Number of steps forecast."""
    num_samples: int
    """Number of sampled futures per agent."""
    max_agents: int
    """Number of agents of a view, the viewer included."""
    perception_m: float | None
    """Range of perception [m]; None is unbounded, since JSON has no infinity."""
    arm: str = "forecast"
    """Part of the forecast that the policy sees (`envs.arms`)."""
    num_plans: int = 0
    """Number of candidate plans of the ego whose what-if forecasts it sees."""
    layout: EntryLayout | None = None
    """Sizes of the entries; None for the forecaster's own."""

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "ForecasterPin":
        """Returns the pin that `asdict` and JSON made; fields that older versions lacked get their defaults.

        Raises:
            TypeError: a field is missing or of another type.
        """
        known = {field.name: content[field.name] for field in fields(cls) if field.name in content}
        layout = known.get("layout")
        return cls(**known | {"layout": None if layout is None else EntryLayout(**layout)})

    def check(self, found: "ForecasterPin", policy: str) -> None:
        """Raises a `UserError` if `found` is another forecaster or has other options; its folder does not matter."""
        if self.sha256 != found.sha256 or (self.sha256 is None and self.checkpoint != found.checkpoint):
            raise UserError(
                f"{policy} was trained on forecaster {self._named}, but gets {found._named}; pass the checkpoint it "
                "was trained on, or train a policy on this one"
            )
        for name in ("arm", "horizon_steps", "num_samples", "num_plans", "max_agents", "perception_m"):
            if getattr(self, name) != getattr(found, name):
                raise UserError(
                    f"{policy} was trained on forecasts with {name}={getattr(self, name)}, but gets "
                    f"{name}={getattr(found, name)}; pass the old value, or train a policy on this one"
                )

    @property
    def _named(self) -> str:
        return f"'{self.checkpoint}'" + (f" (SHA-256 {self.sha256[:12]}…)" if self.sha256 else "")


@dataclass(frozen=True)
class PolicyNote:
    """Everything that a policy needs beside its weights."""

    forecaster: ForecasterPin | None = None
    """Forecaster that it was trained on; None for a policy without forecasts."""
    learners: tuple[str, ...] = ()
    """PettingZoo: agents or roles that learned; empty means all."""
    driver: str = "heuristic"
    """PettingZoo: name of the driver of the agents that did not learn."""
    env_id: str = ""
    """Environment that it was trained for; empty if it is not known."""
    env_kwargs: str = ""
    """Arguments of the environment, as the text of a JSON object."""


def pin_forecaster(checkpoint: str, space: gym.spaces.Dict, spec: SceneSpec, arm: Arm | None = None) -> ForecasterPin:
    """Returns the pin of a forecaster with the options of an observation space.

    Args:
        checkpoint: shipped name, folder, or "constant-velocity".
        space: space of an observation with forecasts.
        spec: layout of the scenes that are forecast.
        arm: arm of the wrapper; None shows everything.

    Raises:
        UserError: no such checkpoint.
    """
    shape = space["forecast"].shape or ()
    digest = None
    if checkpoint != CONSTANT_VELOCITY:
        with (resolve(checkpoint) / WEIGHTS).open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
    samples = shape[1] if len(shape) == 4 else 1
    perception_m = float(spec.perception_m) if math.isfinite(spec.perception_m) else None
    plans = space["what_if_risk"].shape or (0,) if "what_if_risk" in space.spaces else (0,)
    arm = arm or Arm()
    return ForecasterPin(
        checkpoint, digest, shape[-2], samples, 1 + shape[0], perception_m, arm.name, plans[-1], arm.layout
    )


def write_note(
    path: Path, policy: PolicyNote | None, extra: Mapping[str, Any], algorithm: Algorithm | None = None
) -> None:
    """Adds the note to a saved policy.

    Args:
        path: path of a zip without a note.
        policy: note on the policy; None writes none.
        extra: more JSON content, which `read_note` returns.
        algorithm: algorithm that saved the zip; None leaves it out.
    """
    content = dict(extra) | ({} if policy is None else {_POLICY_KEY: asdict(policy)})
    content |= {} if algorithm is None else {_ALGORITHM_KEY: algorithm}
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(NOTE_ENTRY, json.dumps(content))


def read_note(path: Path) -> dict[str, Any]:
    """Returns the extra content of a policy's note; empty if there is no such file or note."""
    return {key: value for key, value in _note(path).items() if key not in (_POLICY_KEY, _ALGORITHM_KEY)}


def read_policy_note(path: Path) -> PolicyNote | None:
    """Returns the note of a policy; None for a zip without one (saved by SB3 alone or by an old version).

    Raises:
        UserError: the note is not valid.
    """
    try:
        content = _note(path).get(_POLICY_KEY)
    except zipfile.BadZipFile:
        return None  # `load_policy` has the message for it
    if content is None:
        return None
    try:
        pin = content["forecaster"]
        forecaster = None if pin is None else ForecasterPin.from_json(pin)
        place = {name: str(content[name]) for name in ("env_id", "env_kwargs") if name in content}
        return PolicyNote(forecaster, tuple(content["learners"]), str(content["driver"]), **place)
    except (KeyError, TypeError) as error:
        raise UserError(f"the note inside {path} cannot be understood ({error!r}); save the policy again") from error


def _note(path: Path) -> dict[str, Any]:
    if not path.exists():
        return {}
    with zipfile.ZipFile(path) as archive:
        return json.loads(archive.read(NOTE_ENTRY)) if NOTE_ENTRY in archive.namelist() else {}


def algorithm_of(path: Path) -> Algorithm:
    """Returns the algorithm that the note inside a zip names; without one, it is decided by the parameters.

    Raises:
        UserError: no such file, or a policy of no known algorithm.
    """
    if not path.exists():
        raise UserError(f"no policy at {path}; train one with python train_policy.py")
    try:
        with zipfile.ZipFile(path) as archive:
            parameters = json.loads(archive.read("data"))
        found = algorithm_named(_note(path).get(_ALGORITHM_KEY)) or algorithm_of_parameters(parameters)
    except (zipfile.BadZipFile, KeyError, ValueError, OSError):
        found = None
    if found is None:
        raise UserError(f"{path} holds no policy of {', '.join(get_args(Algorithm))}")
    return found


def load_policy(path: Path, venv: VecEnv | None = None, device: str = "cpu") -> BaseAlgorithm:
    """Loads a policy of any known algorithm. Its zip holds pickled data: load only files whose source you trust.

    Args:
        path: path of the zip.
        venv: environments to continue training in; their spaces must be the policy's.
        device: device of the network.

    Raises:
        UserError: no such file, no known algorithm, its package is not installed, or not made for these spaces.
    """
    algorithm = algorithm_of(path)
    kind = algorithm_class(algorithm)
    try:
        return kind.load(path, env=venv, device=device)
    except (ValueError, KeyError, TypeError, AttributeError, AssertionError, EOFError, RuntimeError) as error:
        reason = " ".join(str(error).split())
        raise UserError(f"{path} is no {algorithm} policy that fits here: {reason}") from error
