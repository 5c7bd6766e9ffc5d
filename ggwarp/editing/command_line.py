# SPDX-License-Identifier: Apache-2.0
"""What ``ggwarp objects`` is asked for."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import NoReturn

from ggwarp.results.saved_run import RunError

THEN = "then"
"""Joins several edits in one call."""

EDITS = ("remove", "move", "recolor", "label", "merge", "split")
"""Verbs that make a new map."""

_DESCRIPTION = """\
List, show, take out, move, paint, name, merge and split the objects of a run.

An ID is an object's number, or its label or class, or a word of it, where only one object has it. Edits
write a new run folder and never change the old one; several are joined by `then`:

  ggwarp objects runs/latest remove mug then move stool --translate 0.5 0 0
"""


class _Parser(argparse.ArgumentParser):
    """Raises where argparse would print its usage and exit."""

    def error(self, message: str) -> NoReturn:
        raise RunError(f"{message} (--help says more)")


def parse(arguments: list[str]) -> list[argparse.Namespace]:
    """Return one namespace a step; all share ``run``, ``out`` and ``device``.

    Raises:
        RunError: they cannot be used.
    """
    parser = _make_parser()
    parts: list[list[str]] = [[]]
    for word in arguments:
        if word == THEN:
            parts.append([])
        else:
            parts[-1].append(word)
    steps = [parser.parse_args(parts[0])]
    steps += [parser.parse_args([str(steps[0].run), *part]) for part in parts[1:]]
    if len(steps) > 1:
        for step in steps:
            if step.verb not in EDITS:
                raise RunError(f"{step.verb}: only edits are joined by `then`: {', '.join(EDITS)}")
    for name in ("out", "device"):
        given = [v for v in (getattr(step, name) for step in steps) if v is not None]
        for step in steps:
            setattr(step, name, given[-1] if given else None)
    return steps


def _make_parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="ggwarp objects",
        description=_DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("run", metavar="RUN", type=Path, help="a run folder, such as runs/latest")
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", required=True, parser_class=_Parser)

    def verb(name: str, text: str, out: str) -> argparse.ArgumentParser:
        made = verbs.add_parser(name, help=text, description=text, allow_abbrev=False)
        made.add_argument("--device", help="auto (CUDA if there is one), cpu or cuda:N")
        made.add_argument("--out", type=Path, help=out)
        return made

    verbs.add_parser("list", help="a table of the objects").set_defaults(out=None, device=None)
    pictures = "folder for the files (RUN/objects/ID-NAME)"
    show = verb("show", "pictures with the object lit", pictures)
    extract = verb("extract", "the object's own PLY and pictures of it alone", pictures)
    for one in (show, extract):
        one.add_argument("id", metavar="ID")
        one.add_argument("--views", type=int, default=3, help="pictures, from the best views (3)")
    folder = "the new run folder (RUN-edit1, RUN-edit2, ...)"
    remove = verb("remove", "take objects out", folder)
    remove.add_argument("ids", metavar="ID", nargs="+")
    move = verb("move", "turn an object about its centre, then shift it", folder)
    move.add_argument(
        "--translate", type=_number, nargs=3, metavar=("X", "Y", "Z"), help="metres, world axes"
    )
    move.add_argument(
        "--rotate",
        type=_number,
        nargs=3,
        metavar=("ROLL", "PITCH", "YAW"),
        help="degrees about the world's x, then y, then z axis",
    )
    move.add_argument(
        "--axis", type=_number, nargs=3, metavar=("X", "Y", "Z"), help="turn about this, with --angle"
    )
    move.add_argument("--angle", type=_number, metavar="DEGREES", help="by so much about --axis")
    for one, default in ((remove, True), (move, False)):
        one.add_argument(
            "--fill",
            action=argparse.BooleanOptionalAction,
            default=default,
            help=f"fill the holes that it leaves (default here: {'yes' if default else 'no'})",
        )
    recolor = verb("recolor", "paint an object, keeping light and shade", folder)
    label = verb("label", "name an object", folder)
    merge = verb("merge", "make several objects one, with the first one's id and name", folder)
    merge.add_argument("ids", metavar="ID", nargs="+")
    split = verb("split", "make the parts of an object that are apart objects of their own", folder)
    split.add_argument("--parts", type=int, metavar="N", help="cut it into N compact parts instead")
    for one in (move, recolor, label, split):
        one.add_argument("id", metavar="ID")
    for colour in ("red", "green", "blue"):
        recolor.add_argument(colour, type=int, metavar=colour[0].upper(), help="0 to 255")
    label.add_argument("name", metavar="NAME", help="empty: take the label away")
    for one in (remove, move, recolor, label, merge, split):
        one.add_argument(
            "--picture",
            action=argparse.BooleanOptionalAction,
            default=True,
            help="write a picture of before and after (default: yes)",
        )
    for one in (show, extract, remove, move, recolor):
        _add_selection(one, cut_outliers=one in (extract, move))
    return parser


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError
    return value


_number.__name__ = "number"  # what argparse calls it


def _add_selection(parser: argparse.ArgumentParser, *, cut_outliers: bool) -> None:
    group = parser.add_argument_group("which Gaussians are the object's")
    group.add_argument(
        "--probability",
        type=_number,
        metavar="P",
        help="those whose class probability is above P (published: 0.3); default: those with the object's id",
    )
    group.add_argument(
        "--adopt",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="add those on its surface that are called something that is far away (default: yes)",
    )
    group.add_argument(
        "--cut-outliers",
        action=argparse.BooleanOptionalAction,
        default=cut_outliers,
        help=f"drop strays away from its main parts (default here: {'yes' if cut_outliers else 'no'})",
    )
    group.add_argument("--fill-hull", action="store_true", help="add all within the chosen ones' convex hull")
