from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

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


@pytest.mark.parametrize(
    ("pictures", "message"),
    [
        ([], "x.mp4 needs at least one picture, got none"),
        ([PICTURE, PICTURE[:16]], r"all pictures of .*x.mp4 need the size \(32, 48, 3\), got \(16, 48, 3\)"),
    ],
)
def test_pictures_that_make_no_film_are_one_sentence(pictures: list[np.ndarray], message: str, tmp_path: Path):
    with pytest.raises(UserError, match=message):
        write_video(tmp_path / "x.mp4", pictures, fps=4)
    assert list(tmp_path.iterdir()) == []
