# SPDX-License-Identifier: Apache-2.0
"""Spoil object masks as trackers and segmenters do, repeatably, to see what a run makes of them.

    ggwarp spoil-masks office spoilt --dots 0.05 --ragged 3 --missing 0.1 --swapped 0.05
    ggwarp run --seq office --masks spoilt

The source is a sequence (its own masks are spoilt) or a folder of masks. Faults are drawn from (seed, frame)
alone; pixels are those of the masks, so that a run at ``--scale 0.25`` sees a quarter of them.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ggwarp.datasets import DatasetError, open_dataset
from ggwarp.datasets.built_in.faults import MaskFaults, faulty_mask
from ggwarp.datasets.formats.mask_file import read_mask, write_mask
from ggwarp.datasets.masks import MASK_FOLDERS
from ggwarp.datasets.pairing import frame_numbers
from ggwarp.io.printable import printable

Ids = NDArray[np.int32]


def masks_of(source: str, data_root: Path) -> Iterator[tuple[str, int, Ids]]:
    """Yield (stem, frame number, ids [h, w]) of every mask of a folder of masks, or of a sequence.

    Raises:
        DatasetError: there are none.
    """
    found = False
    for folder in [Path(source) / name for name in MASK_FOLDERS] + [Path(source)]:
        files = sorted(folder.glob("*.png"))
        for position, (path, number) in enumerate(zip(files, frame_numbers(files), strict=True)):
            found = True
            yield path.stem, position if number is None else number, read_mask(path)
        if found:
            return
    dataset = open_dataset(source, data_root=data_root)
    stems: list[str] = getattr(dataset, "stems", [])
    for index, stem in enumerate(stems):
        if (mask := dataset[index].mask) is not None:
            found = True
            yield stem, index, mask
    if not found:
        raise DatasetError(f"{source}: the sequence has no object masks to spoil")


def spoil(source: str, out: Path, faults: MaskFaults, data_root: Path) -> tuple[int, int]:
    """Write ``out/<stem>.png`` for every mask of ``source`` but the missing ones.

    Returns:
        Masks written, and masks left out.

    Raises:
        DatasetError: ``source`` has no masks, or ``out`` is not empty.
    """
    if out.exists() and any(out.iterdir()):
        raise DatasetError(f"{out}: is not empty; name a new folder")
    ids = np.unique(np.concatenate([np.unique(mask) for _, _, mask in masks_of(source, data_root)]))
    ids = ids[ids > 0].astype(np.int32)
    out.mkdir(parents=True, exist_ok=True)
    written = missing = 0
    for stem, number, mask in masks_of(source, data_root):
        spoilt = faulty_mask(mask, faults, number, ids)
        if spoilt is None:
            missing += 1
        else:
            written += 1
            write_mask(out / f"{stem}.png", spoilt)
    return written, missing


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = argparse.ArgumentParser(prog="ggwarp spoil-masks", description="Spoil object masks, repeatably.")
    parser.add_argument("source", help="a sequence's name or folder, or a folder of masks")
    parser.add_argument("out", type=Path, help="folder for the spoilt masks: new, or empty")
    parser.add_argument("--data", type=Path, help="data root (default: $GGWARP_DATA, else ./data)")
    parser.add_argument(
        "--dots", type=float, default=0.0, help="share of the pixels under dots of a wrong id"
    )
    parser.add_argument("--dot-radius", type=int, default=2, help="largest radius of a dot, pixels (2)")
    parser.add_argument("--ragged", type=float, default=0.0, help="how far edges stray, pixels")
    parser.add_argument("--missing", type=float, default=0.0, help="share of frames without a mask")
    parser.add_argument(
        "--dropped", type=float, default=0.0, help="share of object-frames without the object"
    )
    parser.add_argument(
        "--swapped", type=float, default=0.0, help="share of object-frames with the id of another in view"
    )
    parser.add_argument(
        "--reborn", type=float, default=0.0, help="share of the objects with a new id from --changed-at on"
    )
    parser.add_argument(
        "--stolen",
        type=float,
        default=0.0,
        help="share of the objects whose id is the next object's from --changed-at on",
    )
    parser.add_argument("--changed-at", type=int, default=0, help="frame at which tracks break for good")
    parser.add_argument(
        "--shared", type=float, default=0.0, help="share of the objects with the id of another all along"
    )
    parser.add_argument("--shuffle-ids", action="store_true", help="draw the ids anew in every frame")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    faults = MaskFaults(
        dots=options.dots,
        dot_radius=options.dot_radius,
        ragged=options.ragged,
        dropped=options.dropped,
        swapped=options.swapped,
        shuffled=options.shuffle_ids,
        missing=options.missing,
        reborn=options.reborn,
        stolen=options.stolen,
        changed_at=options.changed_at,
        shared=options.shared,
        seed=options.seed,
    )
    names = ("dots", "missing", "dropped", "swapped", "reborn", "stolen", "shared")
    shares = {name: getattr(faults, name) for name in names}
    for name, share in shares.items():
        if not 0.0 <= share < 1.0:
            parser.error(f"--{name} {share:g}: give a share, at least 0 and below 1")
    if faults.dot_radius < 1 or faults.ragged < 0.0:
        parser.error("--dot-radius must be at least 1, and --ragged at least 0")
    root = options.data or Path(os.environ.get("GGWARP_DATA") or "data")
    try:
        written, missing = spoil(options.source, options.out, faults, root)
    except (DatasetError, OSError) as error:
        print(f"ggwarp spoil-masks: {printable(str(error))}", file=sys.stderr)
        return 2
    print(f"{written} masks in {options.out}; {missing} frames have none")
    return 0


if __name__ == "__main__":
    sys.exit(main())
