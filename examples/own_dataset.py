# SPDX-License-Identifier: Apache-2.0
"""A data set of one's own: a class with a length that returns frames; registered, it opens by its path.

python examples/own_dataset.py
"""

import json
from pathlib import Path

import numpy as np

from ggwarp import Camera, Frame, FrameReader, Slam, SlamConfig, SyntheticOffice, open_dataset
from ggwarp.datasets import FrameError, Kind, register


class Arrays:
    """A folder of ``camera.json`` and one NumPy archive a frame, with ``rgb`` and ``depth``."""

    kind = "arrays"
    has_depth, has_masks = True, False

    def __init__(self, path: Path) -> None:
        self.name = path.name
        self.camera = Camera(**json.loads((path / "camera.json").read_text()))
        self._files = sorted(path.glob("*.npz"))

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, index: int) -> Frame:
        file = self._files[index]
        try:
            arrays = np.load(file)
            return Frame(index, timestamp=index / 30.0, rgb=arrays["rgb"], depth=arrays["depth"])
        except (OSError, KeyError) as error:
            raise FrameError(f"{file}: {error}; the frame is left out") from None


def recognises(path: Path) -> bool:
    return any(path.glob("*.npz"))


def main(folder: Path = Path("data/own"), frames: int = 6, scale: float = 0.15) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    office = SyntheticOffice(frames=120, scale=scale)
    (folder / "camera.json").write_text(json.dumps(vars(office.camera)))
    for i in range(frames):
        np.savez(folder / f"{i:04d}.npz", rgb=office[i].rgb, depth=office[i].depth)

    # From here on `open_dataset` knows the kind, by what `recognises` sees in a folder.
    register(Kind("arrays", "camera.json and *.npz", recognises, lambda path, masks: Arrays(path)))
    dataset = open_dataset(str(folder), data_root=Path("data"))
    with FrameReader(dataset, range(len(dataset)), scale=1.0) as reader:
        slam = Slam(SlamConfig(use_identity=False), reader.camera, reader.sensor_camera, device="cpu")
        print(*(slam.step(frame).verdict.value for frame in reader), sep="\n")


if __name__ == "__main__":
    main()
