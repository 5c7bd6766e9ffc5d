# SPDX-License-Identifier: Apache-2.0
"""The pictures of the documents, small."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

import docs_images
from ggwarp.results.saved_run import RunError, load_run


def test_pictures_stand_side_by_side() -> None:
    red, blue = (np.full((10, 20, 3), colour, np.uint8) for colour in ((255, 0, 0), (0, 0, 255)))
    table = docs_images.side_by_side([[red, blue], [blue, red]])
    assert table.shape == (26, 46, 3)
    assert (table[5, 5] == (255, 0, 0)).all() and (table[20, 5] == (0, 0, 255)).all()
    assert (table[:, 22] == 255).all() and (table[12] == 255).all()
    assert docs_images.side_by_side([[red, blue]], width=23).shape[1] == 23


def test_a_run_is_filmed_while_it_grows(tmp_path: Path) -> None:
    film = docs_images.run_and_film(tmp_path / "run", 4, 0.1)
    docs_images.write_film(film, tmp_path / "growing.webp")
    shown = Image.open(tmp_path / "growing.webp")
    assert (shown.n_frames, shown.size) == (3, (480, 340))  # type: ignore[attr-defined]
    lit = [int((picture[:, 160:].max(axis=2) > 20).sum()) for picture in film]
    assert 0 < lit[0] <= lit[-1]
    run = load_run(tmp_path / "run")
    modes = docs_images.modes(run, run.poses[0])
    assert {picture.shape for picture in modes} == {(68, 120, 3)}
    assert all(picture.std() > 10.0 for picture in modes)
    assert np.abs(modes[0].astype(float) - modes[2]).mean() > 5.0


def test_a_real_run_s_middle_frame(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="no pictures"):
        docs_images.write_real(tmp_path, tmp_path / "real.jpg")
    (tmp_path / "pictures").mkdir()
    for number, grey in ((0, 10), (5, 120), (9, 250)):
        for kind in ("frame", "render", "depth", "difference"):
            name = tmp_path / "pictures" / f"frame{number:06d}_{kind}.jpg"
            cv2.imwrite(str(name), np.full((30, 40, 3), grey, np.uint8))
    docs_images.write_real(tmp_path, tmp_path / "real.jpg")
    picture = cv2.imread(str(tmp_path / "real.jpg"))
    assert picture.shape == (30, 86, 3) and abs(int(picture[15, 20, 0]) - 120) < 3


def test_too_few_frames_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        docs_images.main(["--frames", "50"])
    assert "need 105 or more" in capsys.readouterr().err
