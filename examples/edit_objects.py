# SPDX-License-Identifier: Apache-2.0
"""Edit objects of a saved run: move one, paint another, remove a third and fill what was behind it.

python examples/edit_objects.py
"""

from pathlib import Path

import numpy as np

from ggwarp import FrameReader, Slam, SlamConfig, SyntheticOffice, load_run
from ggwarp.editing import MapView, fill_removed, motion_about, move, recolour, save_run, select


def main(out: Path = Path("runs/edited"), frames: int = 12, scale: float = 0.2) -> None:
    # A run to edit; any run folder of the command does as well.
    dataset = SyntheticOffice(frames=120, scale=scale)
    with FrameReader(dataset, range(frames), scale=1.0) as reader:
        slam = Slam(SlamConfig(), reader.camera, reader.sensor_camera, device="cpu")
        for frame in reader:
            slam.step(frame)
    slam.save(out / "before", dataset.class_names)

    run = load_run(out / "before")
    print("objects:", ", ".join(f"{o.id} {o.name} ({o.count})" for o in run.objects))
    moved, painted, removed = run.find("sofa"), run.find("bookshelf"), run.find("poster")

    # Which Gaussians are an object: a mask [n], to be used like any other.
    chosen = select(run.gaussians, moved.id)
    motion = motion_about(moved.centre, rotation=np.eye(3), translation=[0.0, 0.0, 0.3])
    run = run.edited(move(run.gaussians, chosen, motion), {"edit": "move", "id": moved.id})

    chosen = select(run.gaussians, painted.id)
    run = run.edited(recolour(run.gaussians, chosen, (200, 40, 40)), {"edit": "recolor", "id": painted.id})

    chosen = select(run.gaussians, removed.id)
    filled, added = fill_removed(run.gaussians, chosen, run.camera, run.poses)
    run = run.edited(filled, {"edit": "remove", "ids": [removed.id]})
    print(f"{removed.name} removed, {added} Gaussians fill what was behind")

    # The edited map, seen from the first pose, and saved as a run of its own.
    view = MapView(run.gaussians, run.camera).render(run.poses[0])
    print(f"opaque: {float((view.opacity > 0.5).mean()):.0%} of the view")
    save_run(run, out / "after")


if __name__ == "__main__":
    main()
