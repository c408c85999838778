"""Files of a Hugging Face hub, by names such as "hub:owner/name" and "hub:owner/name@revision".

Only files that are asked for by name are downloaded, after their sizes have been compared with what their kind may
have. They lie in the cache of the package huggingface_hub (extra "hub"), which also serves them without a network. The
environment variables of that package hold: HF_ENDPOINT is the hub, HF_HUB_CACHE the cache, HF_TOKEN the login.
"""

import importlib.util
import os
import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from predictor.support.errors import DISK_ERRORS, UserError, short
from predictor.support.files import write_text

PREFIX = "hub:"
"""Beginning of the name of a folder on a hub, where a checkpoint or a policy is expected."""
TIMEOUT_S = 10.0
"""Longest time that the hub may take to answer a question [s]."""
PUBLIC = "https://huggingface.co"
_PART = r"[\w.-]{1,96}"
_NAME = re.compile(rf"hub:(?P<repository>{_PART}/{_PART})(@(?P<revision>[\w./-]{{1,200}}))?", re.ASCII)


@dataclass(frozen=True)
class HubName:
    """Repository of a hub."""

    repository: str
    """Owner and name, as "owner/name"."""
    revision: str | None = None
    """Branch, tag or commit; None takes the main branch."""

    def __str__(self) -> str:
        """Returns the name as it is written in options."""
        return f"{PREFIX}{self.repository}" + (f"@{self.revision}" if self.revision else "")


def is_hub(name: object) -> bool:
    """Returns whether a name is that of a folder on a hub."""
    return isinstance(name, str | Path) and str(name).startswith(PREFIX)


def hub_name(name: str | Path) -> HubName:
    """Returns what a name says.

    Raises:
        UserError: it is no "hub:owner/name" or "hub:owner/name@revision".
    """
    found = _NAME.fullmatch(str(name))
    if found is None:
        raise UserError(
            f"'{short(name, 120)}' names nothing on a hub; write hub:owner/name, or hub:owner/name@revision for a "
            "branch, tag or commit"
        )
    return HubName(found["repository"], found["revision"])


def endpoint() -> str:
    """Returns the address of the hub."""
    return (os.environ.get("HF_ENDPOINT") or PUBLIC).rstrip("/")


def fetch(name: str | Path, files: Mapping[str, int], optional: Mapping[str, int] | None = None) -> Path:
    """Downloads files of a repository; returns the folder of the cache that holds them.

    Without a network the files come from the cache, if it has them.

    Args:
        name: name of the repository.
        files: largest size of each file [bytes], by its name.
        optional: likewise, of files that the repository need not have.

    Raises:
        UserError: the extra is missing, the hub cannot be reached and the cache lacks the files, there is no such
            repository, revision or file, or one is larger than it may be.
    """
    wanted, hub = hub_name(name), _library()
    try:
        with _errors_of(wanted, hub):
            info = hub.HfApi(endpoint=endpoint()).model_info(
                wanted.repository, revision=wanted.revision, files_metadata=True, timeout=TIMEOUT_S
            )
    except _NoNetwork as error:
        return _cached(wanted, hub, files, error)
    sizes = {file.rfilename: file.size for file in info.siblings or ()}
    absent = [file for file in files if file not in sizes]
    if absent:
        raise UserError(f"{wanted} has no {absent[0]} and is not what is asked for; there are {_some(sizes)}")
    limits = dict(files) | {file: most for file, most in (optional or {}).items() if file in sizes}
    for file, most in limits.items():
        if sizes[file] is None or sizes[file] > most:
            raise UserError(f"{wanted}: {file} is too large: at most {most:,} bytes, the hub says {sizes[file]}")
    commit = HubName(wanted.repository, str(info.sha))
    with _errors_of(wanted, hub):
        folder = {Path(_download(hub, commit, file)).parent for file in limits}.pop()
    _note_commit(folder, wanted.revision or "main")
    return folder


def push(
    folder: Path,
    repository: str,
    private: bool,
    message: str,
    content: Mapping[str, bytes | Path],
    superseded: Collection[str] = (),
) -> str:
    """Writes files into a repository in one commit; makes the repository if there is none. Returns its address.

    Args:
        folder: what is written, for messages.
        repository: owner and name, as "owner/name".
        private: whether a new repository is private.
        message: message of the commit.
        content: content or path of each file, by its name.
        superseded: names of files of earlier pushes that the same commit removes; others in the repository stay.

    Raises:
        UserError: the extra is missing, the name is none, the hub cannot be reached, or refuses.
    """
    wanted, hub = hub_name(f"{PREFIX}{repository.removeprefix(PREFIX)}"), _library()
    if wanted.revision is not None:
        raise UserError(f"'{repository}' names a revision; push to owner/name")
    operations: list[Any] = [
        hub.CommitOperationAdd(path_in_repo=name, path_or_fileobj=str(data) if isinstance(data, Path) else data)
        for name, data in content.items()
    ]
    api = hub.HfApi(endpoint=endpoint())
    try:
        with _errors_of(wanted, hub, short(folder)), _short_waits(hub):
            api.create_repo(wanted.repository, private=private, exist_ok=True)
            if superseded:  # a hub refuses to remove what is not there
                there = {file.rfilename for file in api.model_info(wanted.repository).siblings or ()}
                operations += [hub.CommitOperationDelete(name) for name in superseded if name in there]
            api.create_commit(wanted.repository, operations, commit_message=message)
    except _NoNetwork as error:
        raise UserError(f"{short(folder)} was not pushed: {error}") from error
    return f"{endpoint()}/{wanted.repository}"


class _NoNetwork(UserError):
    """Raised where the hub gives no answer."""


def _library() -> Any:
    if importlib.util.find_spec("huggingface_hub") is None:
        raise UserError("names that begin with hub: need the package huggingface_hub; pip install 'dgvae-rl[hub]'")
    import huggingface_hub
    import huggingface_hub.errors  # which the package does not load by itself

    return huggingface_hub


def _download(hub: Any, wanted: HubName, file: str, cached: bool = False) -> str:
    path: str = hub.hf_hub_download(
        wanted.repository, file, revision=wanted.revision, endpoint=endpoint(), etag_timeout=TIMEOUT_S,
        cache_dir=os.environ.get("HF_HUB_CACHE"), local_files_only=cached,
    )  # fmt: skip
    return path


def _cached(wanted: HubName, hub: Any, files: Mapping[str, int], reason: _NoNetwork) -> Path:
    """Returns the folder of an earlier download; raises `reason` if there is none."""
    try:
        found = {Path(_download(hub, wanted, file, cached=True)).parent for file in files}
    except (hub.errors.LocalEntryNotFoundError, OSError) as error:
        raise UserError(f"{reason}, and has no copy in the cache; connect to the network, or name a folder") from error
    return found.pop()


def _note_commit(snapshot: Path, revision: str) -> None:
    """Notes in the cache that a branch or tag is at this commit, for later use without a network; all files are there.

    The package notes it before the first file arrives; a download that breaks off then hides the older copy.
    """
    note = snapshot.parent.parent / "refs" / revision
    leads_out = ".." in note.parts or not note.is_relative_to(snapshot.parent.parent)
    if leads_out or revision == snapshot.name or (note.is_file() and note.read_text() == snapshot.name):
        return  # a cache that is shared may be read-only
    write_text(note, snapshot.name)


@contextmanager
def _errors_of(wanted: HubName, hub: Any, pushed: str = "") -> Iterator[None]:
    """Turns errors of the hub into one sentence."""
    from httpx2 import HTTPError, InvalidURL

    known, where = hub.errors, f"{wanted} on {endpoint()}"
    try:
        yield
    except known.RevisionNotFoundError as error:
        raise UserError(f"{wanted.repository} on {endpoint()} has no revision '{wanted.revision}'") from error
    except known.RepositoryNotFoundError as error:
        raise UserError(
            f"there is no {where}, or you may not read it; check the name, or log in with hf auth"
        ) from error
    except known.HFValidationError as error:
        raise UserError(f"'{wanted}' is no name of a repository on a hub ({_reason(error)}); check it") from error
    except known.HfHubHTTPError as error:
        status = error.response.status_code
        if status in (401, 403):
            doing = f"write {pushed} to" if pushed else "read"
            raise UserError(f"you may not {doing} {where}; log in with hf auth login, or set HF_TOKEN") from error
        raise UserError(f"{endpoint()} answers {status} for {wanted}; try again later") from error
    except known.LocalEntryNotFoundError as error:
        raise _NoNetwork(f"cannot reach {endpoint()} for {wanted}") from error
    except (HTTPError, InvalidURL, known.OfflineModeIsEnabled) as error:
        raise _NoNetwork(f"cannot reach {endpoint()} for {wanted} ({_reason(error)})") from error
    except UserError:
        raise
    except (ValueError, TypeError, KeyError) as error:
        raise UserError(
            f"{endpoint()} does not answer as a hub does ({_reason(error)}); check HF_ENDPOINT, and whether a login "
            "page or a proxy answers in its place"
        ) from error
    except OSError as error:
        if error.errno in DISK_ERRORS:
            raise
        raise UserError(
            f"{where} could not be downloaded ({_reason(error)}); try again, or check HF_HUB_CACHE"
        ) from error


@contextmanager
def _short_waits(hub: Any) -> Iterator[None]:
    """Limits how long questions without a limit of their own wait for an answer."""
    from httpx2 import Timeout

    session = hub.get_session()
    before, session.timeout = session.timeout, Timeout(6 * TIMEOUT_S, connect=TIMEOUT_S)
    try:
        yield
    finally:
        session.timeout = before


def _reason(error: Exception) -> str:
    return short(" ".join(str(error).split()) or type(error).__name__, 120)


def _some(names: Mapping[str, Any]) -> str:
    shown = ", ".join(short(name, 60) for name in sorted(names)[:8])
    return f"{shown}, …" if len(names) > 8 else shown or "no files"
