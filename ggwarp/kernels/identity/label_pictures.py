# SPDX-License-Identifier: Apache-2.0
"""Labels that were found at the pixels of a grid, for every pixel of a picture.

A pixel has the label that its mask's id usually has, which leaves borders to the mask, but in the blocks of
grid pixels that have another.
"""

from typing import Any

import warp as wp

from ggwarp.runtime.launch import launch_split

wp.set_module_options({"enable_backward": False})


@wp.func
def _run_at(pixel: int, run: int, ends: wp.array[wp.int32]) -> int:
    """Return the run that has ``pixel``, which is ``run`` or a later one."""
    while run < ends.shape[0] - 1 and ends[run] <= pixel:
        run += 1
    return run


@wp.func
def _usual(run: int, ids: wp.array[wp.uint16], usual: wp.array[wp.int32]) -> int:
    """Return the label of a run's id; the last of ``usual`` is for those beyond, too."""
    return usual[wp.min(int(ids[run]), usual.shape[0] - 1)]


@wp.kernel
def _labels_kernel(
    offset: int,
    step: int,
    width: int,
    ids: wp.array[wp.uint16],
    ends: wp.array[wp.int32],
    first: wp.array[wp.int32],
    usual: wp.array[wp.int32],
    few: wp.array2d[wp.int32],
    others: wp.array2d[wp.int32],
    more: wp.array2d[wp.int32],
    without: wp.array2d[wp.uint8],
    out: wp.array2d[wp.int32],
    out_others: wp.array2d[wp.int32],
    out_more: wp.array2d[wp.int32],
):
    row = offset + wp.tid()
    # What is left over goes with the last block of a row or column.
    i = wp.min(row / step, few.shape[0] - 1)
    middle = i * step + step / 2
    run = int(0)
    middle_run = int(0)
    if ids:
        run = first[row]
        middle_run = first[middle]
    for column in range(width):
        j = wp.min(column / step, few.shape[1] - 1)
        own = few[i, j]
        label = own
        if ids:
            run = _run_at(row * width + column, run, ends)
            middle_run = _run_at(middle * width + j * step + step / 2, middle_run, ends)
            if _usual(middle_run, ids, usual) == own:
                label = _usual(run, ids, usual)
        if out:
            out[row, column] = label
        if out_others:
            other = others[i, j]
            changed = wp.where(other == own, label, other)
            if without:
                changed = wp.where(without[row, column] != wp.uint8(0), -1, changed)
            out_others[row, column] = changed
        if out_more:
            other = more[i, j]
            out_more[row, column] = wp.where(other == own, label, other)


def spread_labels(
    *,
    step: int,
    mask: tuple[Any, Any, Any],
    usual: Any,
    few: Any,
    out: Any,
    others: tuple[Any, Any],
    without: Any,
    out_others: tuple[Any, Any],
    shape: tuple[int, int],
    device: Any,
) -> None:
    """Write the labels of all pixels of a picture of ``shape``.

    Args:
        step: the grid's: its pixels are every ``step``-th of a row and column, from the ``step // 2``-th on.
        mask: its runs along rows: [r] uint16 id + 1, [r] int where in the picture, row after row, they end,
            and [h] int the first of each row; or None each: there is none, and each block has its grid
            pixel's label.
        usual: [k] int, the labels of ids from -1 on; the last is for those beyond, too.
        few: [gh, gw] int, the labels of the grid's pixels.
        out: [h, w] int, written; None: not asked for.
        others: [gh, gw] int, other labels of these pixels, or None: where one differs, its block has it.
        without: [h, w] uint8, where not 0 the first of these has -1; None: nowhere.
        out_others: [h, w] int, written: the picture with each of these; or None.
        device: a Warp device.
    """
    launch_split(
        _labels_kernel,
        shape[0],
        inputs=[step, shape[1], *mask, usual, few, *others, without],
        outputs=[out, *out_others],
        device=device,
    )
