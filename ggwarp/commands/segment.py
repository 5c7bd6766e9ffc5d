# SPDX-License-Identifier: Apache-2.0
"""Write per-frame instance masks of a sequence with an image segmenter, for ``--masks-kind untracked``.

    pip install torchvision                      # Mask R-CNN; its weights are fetched on first use
    ggwarp segment redkitchen masks
    ggwarp run --seq redkitchen --masks masks --masks-kind untracked

    pip install git+https://github.com/facebookresearch/sam2    # segments of everything, without classes
    ggwarp segment redkitchen masks --model sam2 --device cuda

    ggwarp segment redkitchen masks --model mymodule:segment       # one's own

A segmenter is a function of a picture [h, w, 3] uint8 (RGB) that returns [h, w] int ids: one per segment,
arbitrary and different in every frame, 0 = no object.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from ggwarp.datasets import DatasetError, open_dataset
from ggwarp.datasets.base import Dataset
from ggwarp.datasets.formats.mask_file import write_mask
from ggwarp.io.printable import printable

Ids = NDArray[np.int32]
Picture = NDArray[np.uint8]
Segment = Callable[[Picture], Ids]


class SegmenterError(Exception):
    """A segmenter that cannot be used, or gives what is not a mask."""


def painted(masks: Iterable[NDArray[np.bool_]], shape: tuple[int, int], *, least_area: int = 0) -> Ids:
    """Return ids [h, w], 1 for the first of ``masks`` (each [h, w]), later ones over earlier ones.

    Segments of fewer than ``least_area`` pixels are left out.
    """
    ids = np.zeros(shape, np.int32)
    for number, mask in enumerate(masks, start=1):
        if mask.sum() >= least_area:
            ids[mask] = number
    return ids


def mask_rcnn(device: str, *, score: float = 0.5, least_area: int = 100, model: Any = None) -> Segment:
    """Return torchvision's Mask R-CNN as a segmenter: things of the COCO classes, the surest on top.

    Args:
        device: of torch.
        score: of the least sure detection that counts.
        least_area: pixels that a segment has at least.
        model: a torchvision detection model with masks; None: Mask R-CNN with COCO weights, fetched.

    Raises:
        SegmenterError: torch or torchvision is not installed.
    """
    torch = _package("torch")
    if model is None:
        detection = _package("torchvision.models.detection")
        model = detection.maskrcnn_resnet50_fpn_v2(weights="DEFAULT")
    model = model.eval().to(device)

    def segment(rgb: Picture) -> Ids:
        image = torch.from_numpy(np.ascontiguousarray(rgb)).to(device).permute(2, 0, 1) / 255.0
        with torch.inference_mode():
            found = model([image])[0]
        sure = found["scores"].cpu().numpy()
        masks = found["masks"].cpu().numpy()[:, 0] > 0.5
        order = [i for i in np.argsort(sure, kind="stable").tolist() if sure[i] >= score]
        return painted((masks[i] for i in order), rgb.shape[:2], least_area=least_area)

    return segment


def sam2(device: str, *, name: str = "facebook/sam2.1-hiera-small", least_area: int = 100) -> Segment:
    """Return SAM 2 as a segmenter of everything: small segments lie over large ones.

    Args:
        device: of torch.
        name: of the weights, fetched on first use.
        least_area: pixels that a segment has at least.

    Raises:
        SegmenterError: sam2 is not installed.
    """
    generation = _package("sam2.automatic_mask_generator")
    generator = generation.SAM2AutomaticMaskGenerator.from_pretrained(name, device=device)

    def segment(rgb: Picture) -> Ids:
        found = [np.asarray(record["segmentation"], bool) for record in generator.generate(rgb)]
        found.sort(key=np.count_nonzero, reverse=True)
        return painted(found, rgb.shape[:2], least_area=least_area)

    return segment


MODELS: dict[str, Callable[[str], Segment]] = {"maskrcnn": mask_rcnn, "sam2": sam2}


def load_segmenter(model: str, device: str) -> Segment:
    """Return the segmenter that ``model`` names: one of :data:`MODELS`, or ``MODULE:FUNCTION``.

    Raises:
        SegmenterError: there is none of that name, or what it needs is not installed.
    """
    if model in MODELS:
        return MODELS[model](device)
    module, colon, function = model.partition(":")
    if not (module and colon and function):
        raise SegmenterError(f"--model {model}: give {', '.join(MODELS)} or MODULE:FUNCTION")
    sys.path.insert(0, os.getcwd())  # a script's own folder stands there instead
    found: Any = getattr(_package(module), function, None)
    if not callable(found):
        raise SegmenterError(f"--model {model}: {module} has no function {function}")
    return cast(Segment, found)


def _package(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        top = name.partition(".")[0]
        raise SegmenterError(f"{name} cannot be imported ({error}); install {top}") from None


def write_masks(dataset: Dataset, segment: Segment, out: Path, *, step: int = 1) -> int:
    """Write ``out/<stem>.png``, the segments of every ``step``-th frame of ``dataset``; return how many.

    Raises:
        DatasetError: ``out`` is not empty, or the frames have no names.
        SegmenterError: ``segment`` returns what is not a mask of its picture.
    """
    if out.exists() and any(out.iterdir()):
        raise DatasetError(f"{out}: is not empty; name a new folder")
    stems: list[str] = getattr(dataset, "stems", [])
    if not stems:
        raise DatasetError("the sequence's frames have no file names, which masks are found by")
    out.mkdir(parents=True, exist_ok=True)
    indices = range(0, len(stems), step)
    for index in indices:
        rgb = dataset[index].rgb
        ids = np.asarray(segment(rgb))
        if ids.shape != rgb.shape[:2] or not np.issubdtype(ids.dtype, np.integer) or ids.min() < 0:
            raise SegmenterError(
                f"{stems[index]}: the segmenter gave {ids.dtype} {ids.shape} for a picture {rgb.shape}; "
                "it must give [h, w] integers from 0"
            )
        write_mask(out / f"{stems[index]}.png", ids.astype(np.int32))
    return len(indices)


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = argparse.ArgumentParser(prog="ggwarp segment", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("source", help="a sequence's name or folder")
    parser.add_argument("out", type=Path, help="folder for the masks: new, or empty")
    parser.add_argument(
        "--model", default="maskrcnn", help=f"{', '.join(MODELS)} or MODULE:FUNCTION (maskrcnn)"
    )
    parser.add_argument("--data", type=Path, help="data root (default: $GGWARP_DATA, else ./data)")
    parser.add_argument("--device", default="cpu", help="torch device of the models above (cpu)")
    parser.add_argument("--step", type=int, default=1, help="segment every N-th frame (1)", metavar="N")
    options = parser.parse_args(arguments)
    if options.step < 1:
        parser.error(f"--step {options.step}: must be at least 1")
    root = options.data or Path(os.environ.get("GGWARP_DATA") or "data")
    try:
        dataset = open_dataset(options.source, data_root=root, masks="none")
        segment = load_segmenter(options.model, options.device)
        written = write_masks(dataset, segment, options.out, step=options.step)
    except (DatasetError, SegmenterError, OSError) as error:
        print(f"ggwarp segment: {printable(str(error))}", file=sys.stderr)
        return 2
    print(f"{written} masks in {options.out}; run with --masks {options.out} --masks-kind untracked")
    return 0


if __name__ == "__main__":
    sys.exit(main())
