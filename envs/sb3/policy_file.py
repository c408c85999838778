"""Trained policies on disk: a Stable-Baselines3 zip with a note inside.

The note (`note.json`) names the algorithm and holds what a policy needs beside its weights: the forecaster whose
forecasts it was trained on, which agents learned, and the driver of the others. It is part of the zip, so that a policy
drives everywhere as it was trained. SB3's own ``load`` still reads the zip. It holds pickled data: load only files
whose source you trust.
"""

import hashlib
import json
import math
import os
import pickle
import sys
import zipfile
import zlib
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, get_args

import gymnasium as gym
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from envs.arms import ARMS, Arm, EntryLayout
from envs.sb3.algorithms import Algorithm, algorithm_class, algorithm_named, algorithm_of_parameters
from predictor.checkpoint import CONSTANT_VELOCITY, WEIGHTS, resolve
from predictor.own_forecasters import is_own
from predictor.scene import MOST_AGENTS, SceneSpec
from predictor.support.config_checks import check_at_least, check_at_most, check_choice, check_positive
from predictor.support.errors import UserError
from predictor.support.reading import MIB, MOST_JSON_BYTES, as_object, check_regular, parse_json
from predictor.support.typed_values import from_table

NOTE_ENTRY = "note.json"
_POLICY_KEY = "policy"
_ALGORITHM_KEY = "algorithm"
FORECASTER = "forecaster"
"""Key of the forecaster's pin, in a policy's note and in a run's config."""
MOST_BYTES = 65_536 * MIB
"""Largest size of a policy's zip, which may hold a replay buffer."""


@dataclass(frozen=True)
class ForecasterPin:
    """Forecaster that a policy was trained on, and the wrapper's options."""

    checkpoint: str
    """Shipped name, folder, "constant-velocity", or the name of a user's own (`predictor.own_forecasters`)."""
    sha256: str | None
    """SHA-256 of the weights (model.safetensors); None for constant velocity and forecasters of a user's own."""
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

    def __post_init__(self) -> None:
        """Checks ranges.

        Raises:
            UserError: a value is out of range.
        """
        check_at_least(self, 1, "horizon_steps", "num_samples", "max_agents")
        check_at_least(self, 0, "num_plans")
        check_at_most(self, MOST_AGENTS, "horizon_steps", "num_samples", "max_agents", "num_plans")
        check_positive(self, "perception_m")
        check_choice("arm", self.arm, tuple(ARMS))

    @classmethod
    def from_json(cls, content: Any, where: str = FORECASTER) -> "ForecasterPin":
        """Returns the pin that `asdict` and JSON made; fields that older versions lacked get their defaults.

        Args:
            content: content of JSON.
            where: file and key, for messages.

        Raises:
            UserError: a field is missing, of another type or out of range.
        """
        given = as_object(content, where)
        return from_table(cls, {f.name: given[f.name] for f in fields(cls) if f.name in given}, where)

    def check(self, found: "ForecasterPin", policy: str) -> None:
        """Raises a `UserError` if `found` is another forecaster or has other options; its folder does not matter."""
        if self.sha256 != found.sha256 or (self.sha256 is None and self.checkpoint != found.checkpoint):
            raise UserError(
                f"{policy} was trained on forecaster {self._named}, but gets {found._named}; pass the checkpoint it "
                "was trained on, or train a policy on this one"
            )
        if self.num_plans != found.num_plans:
            raise UserError(
                f"{policy} was trained with {self.num_plans} candidate plans of the ego, but here there are "
                f"{found.num_plans}; give the environment the actions that it was trained with (env_kwargs), or train "
                "a policy on these plans"
            )
        for name in ("arm", "horizon_steps", "num_samples", "max_agents", "perception_m"):
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
        checkpoint: shipped name, folder, "constant-velocity", or the name of a user's own.
        space: space of an observation with forecasts.
        spec: layout of the scenes that are forecast.
        arm: arm of the wrapper; None shows everything.

    Raises:
        UserError: no such checkpoint.
    """
    shape = space["forecast"].shape or ()
    digest = None
    if checkpoint != CONSTANT_VELOCITY and not is_own(checkpoint):
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


def selection_return(best: Path) -> float:
    """Returns the mean return on the selection seeds that a kept model had; minus infinity without a file.

    Raises:
        UserError: the file is damaged.
    """
    if not os.path.lexists(best):
        return -math.inf
    check_whole(best, "remove it to go on without it")
    found: float = read_note(best).get("selection_return", -math.inf)
    return found


def check_whole(path: Path, advice: str) -> None:
    """Checks that a zip is as it was written.

    A zip of SB3 holds its weights as a zip of their own. Where it is cut soon after these, what is left looks like that
    inner zip, all of whose checksums are right; only that it does not begin where the file does tells them apart.

    Args:
        path: path of the zip.
        advice: what to do, for the message.

    Raises:
        UserError: it is no zip, was cut, or an entry differs from its checksum.
    """
    check_regular(path, MOST_BYTES)
    try:
        with zipfile.ZipFile(path) as archive:
            if min((part.header_offset for part in archive.infolist()), default=1):
                raise zipfile.BadZipFile("the archive does not begin with the file")
            if (name := archive.testzip()) is not None:
                raise zipfile.BadZipFile(f"{name} differs from its checksum")
    except (zipfile.BadZipFile, *_DAMAGED) as error:
        raise UserError(f"{path} is damaged; {advice}") from error


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
    where = f"{path}: note"
    content = as_object(content, where)
    for key in (FORECASTER, "learners", "driver"):
        if key not in content:
            raise UserError(f"{where}: key '{key}' is missing; save the policy again")
    pin = content[FORECASTER]
    others = {key: value for key, value in content.items() if key != FORECASTER}
    forecaster = None if pin is None else ForecasterPin.from_json(pin, f"{where}: {FORECASTER}")
    return from_table(PolicyNote, others, where, {"forecaster": forecaster})


def _note(path: Path) -> dict[str, Any]:
    return as_object(_entry(path, NOTE_ENTRY, {}), f"{path}: {NOTE_ENTRY} (its note)") if os.path.lexists(path) else {}


_DAMAGED = (OSError, RuntimeError, NotImplementedError, ValueError, zlib.error, EOFError)
"""What `zipfile` raises for an archive that is damaged, encrypted or of a later version."""


def _entry(path: Path, name: str, default: Any = None) -> Any:
    """Returns an entry of JSON of a policy's zip.

    Raises:
        UserError: the file cannot be read, or the entry is too large or no JSON.
        zipfile.BadZipFile: the file is no zip.
    """
    check_regular(path, MOST_BYTES)
    try:
        with zipfile.ZipFile(path) as archive:
            if name not in archive.namelist():
                return default
            too_large = archive.getinfo(name).file_size > MOST_JSON_BYTES
            content = b"" if too_large else archive.read(name)
    except _DAMAGED as error:
        raise zipfile.BadZipFile(str(error)) from error
    if too_large:
        raise UserError(f"{path}: {name} is too large, at most {MOST_JSON_BYTES // MIB} MiB; save the policy again")
    return parse_json(content, f"{path}: {name}")


def algorithm_of(path: Path) -> Algorithm:
    """Returns the algorithm that the note inside a zip names; without one, it is decided by the parameters.

    Raises:
        UserError: no such file, one that is damaged, or a policy of no known algorithm.
    """
    if not os.path.lexists(path):
        raise UserError(f"no policy at {path}; train one with python train_policy.py")
    check_whole(path, "copy it again, or name another .zip of its run")
    parameters = _entry(path, "data")
    known = parameters if isinstance(parameters, dict) else {}
    found = algorithm_named(_note(path).get(_ALGORITHM_KEY)) or algorithm_of_parameters(known)
    if found is None:
        raise UserError(f"{path} holds no policy of {', '.join(get_args(Algorithm))}")
    return found


def _our_names() -> AbstractContextManager[None]:
    """Returns what lets a pickle find our classes where a user's folders hide ours (`dgvae_rl.own_packages`)."""
    finders = [each.ours_first for each in sys.meta_path if hasattr(each, "ours_first")]
    return finders[0]() if finders else nullcontext()


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
        with _our_names():
            return kind.load(path, env=venv, device=device)
    except (
        *(ValueError, KeyError, TypeError, AttributeError, AssertionError, EOFError, RuntimeError),
        *(ImportError, pickle.PickleError),
    ) as error:
        reason = " ".join(str(error).split())
        raise UserError(f"{path} is no {algorithm} policy that fits here: {reason}") from error
