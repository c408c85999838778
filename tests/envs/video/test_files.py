import gc
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from envs.video import files
from envs.video.files import write_picture, write_video
from predictor.support.errors import UserError

PICTURE = np.arange(32 * 48 * 3, dtype=np.uint8).reshape(32, 48, 3)


@pytest.mark.parametrize("kind", [str, Path])
def test_files_are_named_by_strings_or_paths(kind: type, tmp_path: Path):
    write_video(kind(tmp_path / "x.mp4"), [PICTURE] * 4, fps=4)
    assert imageio_ffmpeg.count_frames_and_secs(tmp_path / "x.mp4")[0] == 4
    write_picture(kind(tmp_path / "x.png"), PICTURE)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "x.png")), PICTURE)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["x.mp4", "x.png"]


def test_the_first_folder_of_a_relative_path_may_have_a_colon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    write_video("pkg:Env-ppo/x.mp4", [PICTURE] * 4, fps=4)
    assert imageio_ffmpeg.count_frames_and_secs(tmp_path / "pkg:Env-ppo" / "x.mp4")[0] == 4


def test_a_video_without_pictures_is_refused(tmp_path: Path):
    with pytest.raises(UserError, match="needs at least one picture, got none; play at least one step"):
        write_video(tmp_path / "x.mp4", [], fps=4)


def test_without_any_ffmpeg_there_is_no_still_and_a_film_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def none() -> str:
        raise RuntimeError("No ffmpeg exe could be found")

    monkeypatch.setattr(files.imageio_ffmpeg, "get_ffmpeg_exe", none)
    monkeypatch.setattr("imageio_ffmpeg._io.get_ffmpeg_exe", none)
    assert files.still_of(tmp_path / "x.mp4") == b""
    with pytest.raises(UserError, match="x.mp4, but it is missing or it failed; repair it with pip install"):
        write_video(tmp_path / "x.mp4", [PICTURE] * 3, fps=4)
    assert not list(tmp_path.iterdir())


def test_pictures_of_another_size_are_refused(tmp_path: Path):
    pictures = [PICTURE] * 3 + [PICTURE[:16]] * 4
    with pytest.raises(UserError, match="size of the first one, 48×32 px, got 48×16 px for number 4; let the environ"):
        write_video(tmp_path / "x.mp4", pictures, fps=4)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # imageio-ffmpeg leaves its pipe open
@pytest.mark.parametrize("script", [None, "exit 1", "head -c 1000 > /dev/null; exit 1"], ids=["gone", "silent", "dies"])
def test_an_ffmpeg_that_fails_is_named(script: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    program = tmp_path / "ffmpeg"
    if script is not None:
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
    with pytest.raises(UserError, match="x.mp4, but it is missing or it failed; repair it with pip install"):
        write_video(tmp_path / "films" / "x.mp4", [PICTURE] * 40, fps=4)
    assert not list((tmp_path / "films").iterdir())
    gc.collect()


def test_a_folder_that_takes_no_file_is_told_before_ffmpeg_starts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def started(*given: Any, **more: Any) -> Any:
        raise AssertionError("ffmpeg was started")

    monkeypatch.setattr("imageio_ffmpeg.write_frames", started)
    with pytest.raises(FileNotFoundError):
        write_video("/proc/nowhere/film.mp4", [np.zeros((4, 4, 3), np.uint8)], 5)
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        write_video(tmp_path / "file" / "film.mp4", [np.zeros((4, 4, 3), np.uint8)], 5)
