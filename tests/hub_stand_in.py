"""A small Hugging Face hub on this machine: what huggingface_hub asks a hub for downloads and commits, and no more."""

import base64
import hashlib
import json
import re
import threading
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from predictor.support import hub as support

TOKEN = "hf_stand_in"


@dataclass
class Hub:
    """Repositories in memory: the files of each commit, the latest last."""

    address: str = ""
    repositories: dict[str, dict[str, dict[str, bytes]]] = field(default_factory=dict)
    private: set[str] = field(default_factory=set)
    asked: list[str] = field(default_factory=list)
    """Method and path of every request."""
    sizes: dict[str, int] = field(default_factory=dict)
    """Sizes that the hub claims of files, in place of the true ones."""
    silent: threading.Event = field(default_factory=threading.Event)
    """Set while the hub takes connections and answers nothing."""
    broken: set[str] = field(default_factory=set)
    """Names of files whose transfer breaks off."""
    page: bytes | None = None
    """What every question is answered with, as by a login page in the hub's place."""
    released: threading.Event = field(default_factory=threading.Event)
    """Set at the end, so that no request waits any longer."""

    def commit(self, repository: str, removed: Collection[str] = (), **files: bytes) -> str:
        """Adds a commit with these files, `__` for a dot, over those of the commit before; returns its hash."""
        named = {name.replace("__", "."): content for name, content in files.items()}
        commits = self.repositories.setdefault(repository, {})
        before = list(commits.values())[-1] if commits else {}
        whole = {name: content for name, content in before.items() if name not in removed} | named
        sha = hashlib.sha1(repr((repository, len(commits), sorted(whole.items()))).encode()).hexdigest()
        commits[sha] = whole
        return sha

    def files(self, repository: str) -> dict[str, bytes]:
        """Returns the files of the latest commit."""
        return list(self.repositories[repository].values())[-1]


class _Handler(BaseHTTPRequestHandler):
    hub: Hub

    def log_message(self, *words: Any) -> None: ...

    def _answer(self, status: int, content: bytes = b"", **headers: str) -> None:
        self.send_response(status)
        for name, value in ({"Content-Length": str(len(content))} | headers).items():
            self.send_header(name.replace("_", "-"), value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(content)

    def _json(self, content: Any) -> None:
        self._answer(200, json.dumps(content).encode(), Content_Type="application/json")

    def _refuse(self, code: str, status: int = 404) -> None:
        self._answer(status, b"", X_Error_Code=code, X_Error_Message=code)

    def _commit_of(self, repository: str, revision: str) -> str | None:
        commits = self.hub.repositories[repository]
        return list(commits)[-1] if revision == "main" else revision if revision in commits else None

    def _may_read(self, repository: str) -> bool:
        known = repository in self.hub.repositories
        return known and (repository not in self.hub.private or TOKEN in (self.headers.get("Authorization") or ""))

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_GET(self) -> None:
        self.hub.asked.append(f"{self.command} {self.path}")
        if self.hub.silent.is_set():
            self.hub.released.wait(60)
            return
        if self.hub.page is not None:
            return self._answer(200, self.hub.page, Content_Type="text/html")
        path = self.path.partition("?")[0]
        if found := re.fullmatch(r"/api/models/([^/]+/[^/]+)(?:/revision/(.+))?", path):
            self._info(found[1], found[2] or "main")
        elif found := re.fullmatch(r"/([^/]+/[^/]+)/resolve/([^/]+)/(.+)", path):
            self._file(found[1], found[2], found[3])
        else:
            self._answer(404)

    def _info(self, repository: str, revision: str) -> None:
        if not self._may_read(repository):
            return self._refuse("RepoNotFound", 401)
        sha = self._commit_of(repository, revision)
        if sha is None:
            return self._refuse("RevisionNotFound")
        files = self.hub.repositories[repository][sha]
        sizes = {name: self.hub.sizes.get(name, len(content)) for name, content in files.items()}
        siblings = [{"rfilename": name, "size": size, "blobId": "0" * 40} for name, size in sizes.items()]
        self._json({"id": repository, "_id": "1", "sha": sha, "siblings": siblings, "private": False, "tags": []})

    def _file(self, repository: str, revision: str, name: str) -> None:
        sha = self._commit_of(repository, revision) if self._may_read(repository) else None
        content = self.hub.repositories[repository][sha].get(name) if sha else None
        if sha is None or content is None:
            return self._refuse("EntryNotFound" if sha else "RepoNotFound")
        if name in self.hub.broken:
            self.close_connection = True
            self.connection.close()
            return
        etag = f'"{hashlib.sha1(content).hexdigest()}"'
        self._answer(200, content, ETag=etag, X_Repo_Commit=sha, Accept_Ranges="none")

    def do_POST(self) -> None:
        self.hub.asked.append(f"POST {self.path}")
        body = self.rfile.read(int(self.headers["Content-Length"]))
        path = self.path.partition("?")[0]
        if path == "/api/validate-yaml":
            self._json({"errors": [], "warnings": []})
        elif TOKEN not in (self.headers.get("Authorization") or ""):
            self._answer(401)
        elif path == "/api/repos/create":
            asked = json.loads(body)
            repository = f"{asked.get('organization') or 'me'}/{asked['name']}"
            self.hub.repositories.setdefault(repository, {"0" * 40: {}})
            if asked.get("private") or asked.get("visibility") == "private":
                self.hub.private.add(repository)
            self._json({"url": f"{self.hub.address}/{repository}", "name": repository, "id": "1"})
        elif "/preupload/" in path:
            files = [file["path"] for file in json.loads(body)["files"]]
            self._json({"files": [{"path": p, "uploadMode": "regular", "shouldIgnore": False} for p in files]})
        elif found := re.fullmatch(r"/api/models/([^/]+/[^/]+)/commit/main", path):
            lines = [json.loads(line) for line in body.decode().splitlines()]
            written = {
                line["value"]["path"]: base64.b64decode(line["value"]["content"])
                for line in lines
                if line["key"] == "file"
            }
            removed = {line["value"]["path"] for line in lines if line["key"] == "deletedFile"}
            if not removed <= set(self.hub.files(found[1])):
                return self._answer(400)
            sha = self.hub.commit(found[1], removed, **written)
            self._json({"commitUrl": f"{self.hub.address}/{found[1]}/commit/{sha}", "commitOid": sha, "success": True})
        else:
            self._answer(404)


@contextmanager
def running_hub() -> Iterator[Hub]:
    """Serves a hub on a free port of this machine."""
    hub = Hub()
    handler = type("Handler", (_Handler,), {"hub": hub})
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    server.daemon_threads = True
    hub.address = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield hub
    finally:
        hub.released.set()
        server.shutdown()
        server.server_close()
        thread.join()


@contextmanager
def hub_for_test(folder: Path, monkeypatch: pytest.MonkeyPatch, fetched: Any) -> Iterator[Hub]:
    """Serves a hub to a test, which has the token and empty caches: a folder, and `fetched`, a cached function."""
    monkeypatch.setenv("HF_HUB_CACHE", str(folder))
    monkeypatch.setenv("HF_TOKEN", TOKEN)
    monkeypatch.setattr(support, "TIMEOUT_S", 1.0)
    fetched.cache_clear()
    with running_hub() as served:
        monkeypatch.setenv("HF_ENDPOINT", served.address)
        yield served
    fetched.cache_clear()
