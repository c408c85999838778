"""Trained policies on a Hugging Face hub: `push_policy_to_hub("runs/highway", "owner/name")`.

**A policy's zip runs code when it is loaded**: it is Stable-Baselines3's format and holds pickled Python objects. A
policy of a hub is therefore loaded only if `trust_pickle=True` says so; then whoever can write to that repository runs
code on this machine. Naming a commit (owner/name@commit) keeps later changes out. Predictors hold no code
(`predictor.hub`). The extra "hub" brings the package huggingface_hub.
"""

import functools
from pathlib import Path

from agents.runs import CONFIG_FILE, POLICY_FILE, SUMMARY_FILE, policy_zip, read_config
from envs.sb3.policy_file import PolicyNote, algorithm_of, read_policy_note
from predictor.checkpoint import CARD, CONSTANT_VELOCITY, shipped
from predictor.own_forecasters import is_own
from predictor.support.errors import UserError
from predictor.support.hub import PREFIX, fetch, is_hub, push
from predictor.support.reading import MIB, check_regular

MOST_POLICY_BYTES, MOST_CONFIG_BYTES, MOST_SUMMARY_BYTES = 4096 * MIB, 4 * MIB, 64 * MIB
"""Largest sizes of the files of a policy on a hub."""
_HEADER = "---\nlibrary_name: dgvae-rl\ntags:\n- reinforcement-learning\n- stable-baselines3\n- dgvae-rl\n---\n\n"


def push_policy_to_hub(path: str | Path, repository: str, private: bool = False) -> str:
    """Writes a policy into a repository of the hub; returns the repository's address.

    Its run's config.json and summary.json go with it, and a card that warns of the pickle. Those of a policy that was
    pushed there before are removed in the same commit where this one has none.

    Args:
        path: run folder of train_policy.py, or a policy's ``.zip``.
        repository: owner and name, as "owner/name"; a new one is made if it does not exist.
        private: whether a new repository is private.

    Raises:
        UserError: no policy there, or one whose forecaster others cannot have; the extra is missing, or the hub
            refuses.
    """
    if is_hub(path):
        raise UserError(f"{path} is on a hub already; push a run folder or a .zip")
    zipped = policy_zip(path)
    algorithm, note = algorithm_of(zipped), read_policy_note(zipped) or PolicyNote()
    _check_forecaster(None if note.forecaster is None else note.forecaster.checkpoint, "the forecaster", "--checkpoint")
    name = repository.removeprefix(PREFIX)
    content: dict[str, bytes | Path] = {POLICY_FILE: zipped, CARD: (_HEADER + card_of(note, algorithm, name)).encode()}
    for file, most in ((CONFIG_FILE, MOST_CONFIG_BYTES), (SUMMARY_FILE, MOST_SUMMARY_BYTES)):
        if Path(path).is_dir() and (zipped.parent / file).exists():
            check_regular(zipped.parent / file, most)
            content[file] = zipped.parent / file
    if CONFIG_FILE in content:
        _check_forecaster(read_config(zipped.parent).get("sizes_of"), "the sizes of the checkpoint", "--sizes-of")
    # those of a policy that was there before would be taken for this one's
    superseded = [file for file in (CONFIG_FILE, SUMMARY_FILE) if file not in content]
    return push(zipped, repository, private, f"Policy of {note.env_id or 'an environment'}", content, superseded)


def policy_from_hub(name: str, trust_pickle: bool = False) -> Path:
    """Downloads a policy; returns the path of its zip, which `load_policy` takes.

    Args:
        name: "owner/name", or "owner/name@revision" for a branch, tag or commit; "hub:" may stand before it.
        trust_pickle: whether you trust everyone who can write to the repository: loading a policy runs their code.

    Raises:
        UserError: `trust_pickle` is False, or the hub does not give the policy.
    """
    name = name if is_hub(name) else f"{PREFIX}{name}"
    if not trust_pickle:
        raise UserError(
            f"{name} is a policy: its zip holds pickled Python objects, and loading it runs code of whoever wrote it; "
            "if you trust them, say so with trust_pickle=True (--trust-pickle)"
        )
    return _fetched(name)


@functools.lru_cache(maxsize=64)
def _fetched(name: str) -> Path:
    return fetch(name, {POLICY_FILE: MOST_POLICY_BYTES}, {CONFIG_FILE: MOST_CONFIG_BYTES}) / POLICY_FILE


def local_policy(path: str | Path, trust_pickle: bool = False) -> Path:
    """Returns the path of a policy on this machine: itself, or what `policy_from_hub` downloads.

    Raises:
        UserError: see `policy_from_hub`.
    """
    return policy_from_hub(str(path), trust_pickle) if is_hub(path) else Path(path)


def card_of(note: PolicyNote, algorithm: str, repository: str) -> str:
    """Returns the card of a policy."""
    pin = note.forecaster
    shown = "forecasts" if pin is None or pin.arm == "forecast" else f"the arm `{pin.arm}` in the shape of forecasts"
    sees = "Sees no forecasts." if pin is None else f"Sees {shown} of `{pin.checkpoint}` ({pin.horizon_steps} steps)."
    return (
        f"# Policy of `{note.env_id or 'an environment'}`\n\n{algorithm}, Stable-Baselines3. {sees}\n\n"
        "**The zip holds pickled Python objects: loading it runs code.** Load it only if you trust its source.\n\n"
        "```python\nfrom dgvae_rl import load_policy\n\n"
        f'policy, env = load_policy("hub:{repository}", trust_pickle=True)\n```\n'
    )


def _check_forecaster(name: str | None, what: str, option: str) -> None:
    """Checks that others can have a checkpoint that a policy was trained with.

    Args:
        name: its name; None for none.
        what: name of what it gave the policy, for the message.
        option: option that names it.

    Raises:
        UserError: it is a folder of this machine.
    """
    if name is None or name == CONSTANT_VELOCITY or is_hub(name) or is_own(name) or name in shipped():
        return
    raise UserError(
        f"the policy was trained on {what} '{name}', a folder that others do not have; push that first, train with "
        f"{option} hub:owner/name, and push that policy"
    )
