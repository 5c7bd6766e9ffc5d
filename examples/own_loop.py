# SPDX-License-Identifier: Apache-2.0
"""A loop of one's own: read frames, track and map each, look at the map, save it.

python examples/own_loop.py
"""

# --8<-- [start:loop]
from pathlib import Path

from ggwarp import FrameReader, Slam, SlamConfig, load_run, open_dataset


def main(out: Path = Path("runs/own_loop"), frames: int = 20, scale: float = 0.25) -> None:
    # The built-in office; a folder of your own or a Replica scene opens in the same way.
    dataset = open_dataset("office", data_root=Path("data"))

    # The reader reads ahead in a thread, and hands frames out at the map's image size.
    with FrameReader(dataset, range(frames), scale=scale) as reader:
        slam = Slam(SlamConfig(), reader.camera, reader.sensor_camera, device="cpu")
        for frame in reader:
            report = slam.step(frame)  # the pose first, then the map
            print(f"frame {report.index}: {report.verdict.value}, {report.gaussians} Gaussians")

    # Look at the map from any pose: colour, depth, opacity, object ids.
    view = slam.render(slam.reports[-1].T_wc)
    print(f"the last view shows {len(set(view.objects.ravel()) - {0})} objects")

    # What is saved opens like any run: `ggwarp objects runs/own_loop list`.
    slam.save(out)
    print(f"{out}: {len(load_run(out).gaussians)} Gaussians")


# --8<-- [end:loop]
if __name__ == "__main__":
    main()
