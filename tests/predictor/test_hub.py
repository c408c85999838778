"""Checkpoints on a hub: pushed, found by name wherever a checkpoint is taken, and one sentence for what fails."""

import importlib.util
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from predictor import checkpoint, from_hub, load_checkpoint, push_to_hub
from predictor.checkpoint import load_forecaster, name_of_folder, resolve
from predictor.support.errors import UserError
from predictor.support.hub import _note_commit
from tests.hub_stand_in import Hub, hub_for_test

pytest.importorskip("huggingface_hub")


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    with hub_for_test(tmp_path / "cache", monkeypatch, checkpoint._fetched) as served:
        yield served


def shipped_files() -> dict[str, bytes]:
    folder = resolve("merge")
    return {name.replace(".", "__"): (folder / name).read_bytes() for name in ("config.json", "model.safetensors")}


def test_what_is_pushed_is_loaded_by_its_name(hub: Hub):
    assert push_to_hub("merge", "me/merge") == f"{hub.address}/me/merge"
    files = hub.files("me/merge")
    assert sorted(files) == ["README.md", "config.json", "model.safetensors"]
    assert (
        files["README.md"].startswith(b"---\nlibrary_name: dgvae-rl\n")
        and b"# Predictor checkpoint" in files["README.md"]
    )
    model, info = from_hub("me/merge")
    expected, same = load_checkpoint("merge")
    assert info == same
    assert all(
        torch.equal(a, b) for a, b in zip(model.state_dict().values(), expected.state_dict().values(), strict=True)
    )
    assert load_forecaster("hub:me/merge", info.spec, "env").horizon_steps == info.horizon_steps
    folder = resolve("hub:me/merge")
    assert name_of_folder("hub:me/merge") == name_of_folder(folder) == "merge", "its name in tables"


@pytest.mark.slow
def test_a_download_in_a_fresh_process_says_what_is_wrong(tmp_path: Path):
    """The library loads some of its modules only once something else was asked for."""
    nowhere = {"HF_ENDPOINT": "http://127.0.0.1:9", "HF_HUB_CACHE": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-c", "from predictor import from_hub; from_hub('owner/name')"],
        env=os.environ | nowhere, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "UserError: cannot reach http://127.0.0.1:9 for hub:owner/name" in done.stderr, done.stderr[-500:]


@pytest.mark.parametrize("name", ["hub:owner/name.git", "hub:-a/b", "hub:a--b/c"])
def test_a_name_that_no_repository_may_have_is_one_sentence(hub: Hub, name: str):
    with pytest.raises(UserError, match=f"'{name}' is no name of a repository on a hub"):
        resolve(name)


def test_a_checkpoint_without_a_card_gets_a_short_one(hub: Hub, tmp_path: Path):
    for name, content in shipped_files().items():
        (tmp_path / name.replace("__", ".")).write_bytes(content)
    push_to_hub(tmp_path, "hub:me/short", private=True)
    assert 'ForecastObservation(env, "hub:me/short")' in hub.files("me/short")["README.md"].decode()
    assert hub.private == {"me/short"}


def test_a_revision_pins_a_commit(hub: Hub):
    first = hub.commit("me/merge", **shipped_files())
    hub.commit("me/merge", config__json=b"{}")
    assert from_hub(f"hub:me/merge@{first}")[1].sources == load_checkpoint("merge")[1].sources
    with pytest.raises(UserError, match="is not a predictor checkpoint"):
        from_hub("me/merge")
    with pytest.raises(UserError, match="me/merge on http.* has no revision 'v9'"):
        from_hub("me/merge@v9")


def test_the_hub_is_asked_once_and_the_cache_serves_without_it(hub: Hub, monkeypatch: pytest.MonkeyPatch):
    hub.commit("me/merge", **shipped_files())
    folder, asked = resolve("hub:me/merge"), len(hub.asked)
    assert resolve("hub:me/merge") == folder and len(hub.asked) == asked > 0
    checkpoint._fetched.cache_clear()
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    assert resolve("hub:me/merge") == folder
    with pytest.raises(UserError, match=r"cannot reach http://127.0.0.1:9 for hub:me/other \(.*\), and has no copy"):
        resolve("hub:me/other")


@pytest.mark.slow
def test_a_silent_hub_is_not_waited_for(hub: Hub):
    hub.silent.set()
    began = time.monotonic()
    with pytest.raises(UserError, match="cannot reach .* for hub:me/merge .*no copy in the cache"):
        resolve("hub:me/merge")
    assert time.monotonic() - began < 10


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("hub:merge", "'hub:merge' names nothing on a hub; write hub:owner/name, or hub:owner/name@revision"),
        ("hub:me/../secret", "names nothing on a hub"),
        ("hub:me/merge@", "names nothing on a hub"),
        ("hub:me/nothing", "there is no hub:me/nothing on http.*, or you may not read it; check the name"),
        ("hub:me/half", "hub:me/half has no model.safetensors and is not what is asked for; there are config.json"),
    ],
)
def test_what_is_not_there_is_one_sentence(hub: Hub, name: str, sentence: str):
    hub.commit("me/half", config__json=b"{}")
    with pytest.raises(UserError, match=sentence):
        resolve(name)


def test_large_files_are_refused_before_they_are_downloaded(hub: Hub):
    hub.commit("me/large", **shipped_files())
    hub.sizes["config.json"] = checkpoint.MOST_CONFIG_BYTES + 1
    with pytest.raises(UserError, match="config.json is too large: at most 4,194,304 bytes, the hub says 4194305"):
        resolve("hub:me/large")
    assert not [asked for asked in hub.asked if "/resolve/" in asked]


def test_files_of_a_hub_are_checked_like_those_of_a_folder(hub: Hub):
    files = shipped_files()
    hub.commit("me/broken", **files | {"model__safetensors": files["model__safetensors"][:-4]})
    with pytest.raises(UserError, match="is no safetensors file"):
        from_hub("me/broken")


def test_pushing_without_a_login_or_with_a_wrong_name_is_one_sentence(hub: Hub, monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(UserError, match="no checkpoint 'absent'"):
        push_to_hub("absent", "me/merge")
    with pytest.raises(UserError, match="'hub:merge' names nothing on a hub"):
        push_to_hub("merge", "merge")
    with pytest.raises(UserError, match="'me/merge@v1' names a revision; push to owner/name"):
        push_to_hub("merge", "me/merge@v1")
    monkeypatch.setenv("HF_TOKEN", "hf_another")
    with pytest.raises(UserError, match="you may not write .*merge to hub:me/merge on http.*; log in with hf"):
        push_to_hub("merge", "me/merge")
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(UserError, match="merge was not pushed: cannot reach http://127.0.0.1:9 for hub:me/merge"):
        push_to_hub("merge", "me/merge")


def test_without_the_extra_one_sentence_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch):
    real = importlib.util.find_spec
    missing: Any = lambda name, *rest: None if name == "huggingface_hub" else real(name, *rest)  # noqa: E731
    monkeypatch.setattr(importlib.util, "find_spec", missing)
    for act in (lambda: resolve("hub:me/merge"), lambda: push_to_hub("merge", "me/merge")):
        with pytest.raises(UserError, match=r"need the package huggingface_hub; pip install 'dgvae-rl\[hub\]'"):
            act()


def test_an_update_that_breaks_off_leaves_the_copy_before_usable(hub: Hub, monkeypatch: pytest.MonkeyPatch):
    hub.commit("me/merge", **shipped_files())
    folder = resolve("hub:me/merge")
    files = shipped_files()
    hub.commit("me/merge", config__json=files["config__json"] + b"\n", model__safetensors=files["model__safetensors"])
    hub.broken.add("model.safetensors")
    checkpoint._fetched.cache_clear()
    with pytest.raises(UserError):
        resolve("hub:me/merge")
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    assert resolve("hub:me/merge") == folder


def test_the_latest_whole_copy_serves_without_a_network(hub: Hub, monkeypatch: pytest.MonkeyPatch):
    hub.commit("me/merge", **shipped_files())
    first = resolve("hub:me/merge")
    files = shipped_files()
    hub.commit("me/merge", config__json=files["config__json"] + b"\n", model__safetensors=files["model__safetensors"])
    checkpoint._fetched.cache_clear()
    second = resolve("hub:me/merge")
    checkpoint._fetched.cache_clear()
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    assert resolve("hub:me/merge") == second != first


@pytest.mark.slow
@pytest.mark.parametrize("answer", [b"<html>please log in</html>", b"[]"])
def test_a_page_in_the_place_of_the_hub_is_one_sentence(hub: Hub, answer: bytes):
    hub.commit("me/merge", **shipped_files())
    hub.page = answer
    with pytest.raises(UserError, match=r"http://.* does not answer as a hub does \(.*\); check HF_ENDPOINT"):
        resolve("hub:me/merge")


def test_a_cache_that_cannot_be_written_is_one_sentence(hub: Hub, monkeypatch: pytest.MonkeyPatch):
    hub.commit("me/merge", **shipped_files())
    monkeypatch.setenv("HF_HUB_CACHE", "/dev/null/cache")
    with pytest.raises(UserError, match="hub:me/merge on http.* could not be downloaded .*check HF_HUB_CACHE"):
        resolve("hub:me/merge")


def test_the_card_of_an_address_is_its_own(hub: Hub):
    push_to_hub(f"file://{resolve('merge')}", "me/merge")
    assert hub.files("me/merge")["README.md"].endswith((resolve("merge") / "README.md").read_bytes())


def test_a_cache_that_may_only_be_read_serves_what_it_has(hub: Hub, monkeypatch: pytest.MonkeyPatch):
    hub.commit("me/merge", **shipped_files())
    folder = resolve("hub:me/merge")
    checkpoint._fetched.cache_clear()
    monkeypatch.setattr("predictor.support.hub.write_text", lambda *_: pytest.fail("nothing is to be written"))
    assert resolve("hub:me/merge") == folder


def test_a_revision_leads_to_no_place_outside_of_the_cache(tmp_path: Path):
    snapshot = tmp_path / "models--me--merge" / "snapshots" / "5f6d877b"
    snapshot.mkdir(parents=True)
    for revision in ("../../outside", "../outside", "/" + str(tmp_path / "outside")):
        _note_commit(snapshot, revision)
    assert [path.name for path in tmp_path.rglob("*")] == ["models--me--merge", "snapshots", "5f6d877b"]
    _note_commit(snapshot, "feature/one")
    assert (tmp_path / "models--me--merge" / "refs" / "feature" / "one").read_text() == "5f6d877b"
