# SPDX-License-Identifier: Apache-2.0
"""A kernel's machine code (SASS), as ``cuobjdump -sass`` prints it: loops, and the way through one.

A warp executes what lies on its lanes' common way; so the instructions between a loop's head and its end,
along one way through its branches, are what one round costs. Two ways are told apart in the loop that tests
whether a splat reaches alpha = 1/255: one that fails the test, and the longest of those that pass it.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field

_LINE = re.compile(r"/\*([0-9a-f]{4,6})\*/\s+(?:(@!?U?P\w+)\s+)?([A-Z][\w.]*)\s*(.*?)\s*;")
_TARGET = re.compile(r"(?:0x|\.L_x_)([0-9a-f]+)")
_CONDITION = re.compile(r"^!?U?P\d")
_WIDTHS = {"64": 8, "128": 16, "U8": 1, "S8": 1, "U16": 2, "S16": 2}


@dataclass(frozen=True)
class Instruction:
    """One line.

    Attributes:
        address: bytes from the kernel's beginning.
        predicate: such as @!P0; empty: always executed.
        name: the operation with its modifiers, such as LDG.E.128.
        operands: as printed.
    """

    address: int
    predicate: str
    name: str
    operands: str

    @property
    def operation(self) -> str:
        return self.name.split(".")[0]

    @property
    def bytes(self) -> int:
        """What a lane loads or stores."""
        return next((_WIDTHS[part] for part in self.name.split(".") if part in _WIDTHS), 4)


@dataclass
class Block:
    """Instructions without a branch among them.

    Attributes:
        code: they.
        next: blocks that may follow, by their place.
    """

    code: list[Instruction]
    next: list[int] = field(default_factory=list)


@dataclass(frozen=True)
class Loop:
    """A natural loop: the block that it begins with, and all of its blocks."""

    head: int
    body: frozenset[int]


def parse(text: str) -> dict[str, list[Instruction]]:
    """Return the instructions of every function in what ``cuobjdump -sass`` printed."""
    functions = {}
    for part in text.split("Function : ")[1:]:
        name, _, body = part.partition("\n")
        code = [
            Instruction(int(at, 16), predicate, operation, operands)
            for at, predicate, operation, operands in _LINE.findall(body)
        ]
        functions[name.strip()] = code
    return functions


def blocks_of(code: list[Instruction]) -> list[Block]:
    """Cut code at branches and their targets; calls (of a division's rare cases, say) count as one step."""
    targets = {_target(i) for i in code if i.operation in ("BRA", "BSSY")}
    starts = [0]
    for place in range(1, len(code)):
        if code[place].address in targets or code[place - 1].operation in ("BRA", "EXIT", "BRX", "RET"):
            starts.append(place)
    blocks = [Block(code[a:b]) for a, b in zip(starts, [*starts[1:], len(code)], strict=True)]
    at = {block.code[0].address: k for k, block in enumerate(blocks)}
    for k, block in enumerate(blocks):
        last = block.code[-1]
        # BRA.DIV leads aside where a warp's lanes have not come together: the rare case.
        aside = ".DIV" in last.name
        conditional = aside or bool(last.predicate) or bool(_CONDITION.match(last.operands))
        ends = last.operation in ("BRA", "EXIT", "BRX", "RET") and not conditional
        if not ends and k + 1 < len(blocks):
            block.next.append(k + 1)
        if last.operation == "BRA" and not aside and _target(last) in at:
            block.next.append(at[_target(last)])
    return blocks


def loops_of(blocks: list[Block]) -> list[Loop]:
    """Return the natural loops, innermost first; back edges to one head are one loop."""
    bodies: dict[int, set[int]] = {}
    before = _before(blocks)
    dominators = _dominators(before)
    for head, leading in enumerate(before):
        for k in leading:
            if head in dominators[k]:
                body = bodies.setdefault(head, {head})
                waiting = [k]
                while waiting:
                    b = waiting.pop()
                    if b not in body:
                        body.add(b)
                        waiting += before[b]
    return sorted((Loop(head, frozenset(b)) for head, b in bodies.items()), key=lambda loop: len(loop.body))


def _before(blocks: list[Block]) -> list[list[int]]:
    """Return for each block those that lead to it, of the blocks that can be reached."""
    before: list[list[int]] = [[] for _ in blocks]
    waiting, seen = [0], {0}
    while waiting:
        k = waiting.pop()
        for following in blocks[k].next:
            before[following].append(k)
            if following not in seen:
                seen.add(following)
                waiting.append(following)
    return before


def _dominators(before: list[list[int]]) -> list[set[int]]:
    """Return for each block those that every way from the beginning passes."""
    everything = set(range(len(before)))
    found = [{0}] + [set(everything) for _ in before[1:]]
    changed = True
    while changed:
        changed = False
        for k in range(1, len(before)):
            ways = [found[p] for p in before[k]]
            new = set.intersection(*ways) | {k} if ways else {k}
            if new != found[k]:
                found[k], changed = new, True
    return found


@dataclass(frozen=True)
class Way:
    """A way through a loop, from its head back to it.

    Attributes:
        marks: how many of the marked instructions lie on it; a compiler may have unrolled the loop.
        length: instructions, or what else was counted.
    """

    marks: int
    length: int

    @property
    def each(self) -> float:
        """Instructions for a mark."""
        return self.length / self.marks


def way_through(
    blocks: list[Block],
    loop: Loop,
    marked: dict[int, int],
    *,
    without: set[int],
    longest: bool,
    cost: Callable[[int], int] | None = None,
) -> Way | None:
    """Return the shortest or longest way through a loop, of those that pass most marks.

    Args:
        marked: block -> marks in it.
        without: blocks that are not on it.
        longest: prefer the longest way; loops inside are passed once.
        cost: what a block, by its place, adds to the length; the default is its instructions.
    """
    ends: list[Way] = []
    kept: dict[int, dict[int, int]] = {}
    inner = {h.head: h.body for h in loops_of(blocks) if h.body < loop.body}
    order = _topological(blocks, loop)
    kept[loop.head] = {0: 0}
    choose = max if longest else min
    for b in order:
        if b not in kept or b in without:
            continue
        for marks, length in kept[b].items():
            marks, length = marks + marked.get(b, 0), length + (cost(b) if cost else len(blocks[b].code))
            for following in blocks[b].next:
                if following == loop.head:
                    ends.append(Way(marks, length))
                elif following in loop.body and b not in inner.get(following, ()):
                    lengths = kept.setdefault(following, {})
                    lengths[marks] = choose(lengths.get(marks, length), length)
    ends = [way for way in ends if way.marks > 0]
    if not ends:
        return None
    most = max(way.marks for way in ends)
    return choose((way for way in ends if way.marks == most), key=lambda way: way.length)


def _topological(blocks: list[Block], loop: Loop) -> list[int]:
    """Return a loop's blocks such that each comes after those that lead to it, back edges aside."""
    order: list[int] = []
    seen: set[int] = set()

    def visit(start: int) -> None:
        waiting = [(start, iter(blocks[start].next))]
        seen.add(start)
        while waiting:
            b, following = waiting[-1]
            for n in following:
                if n in loop.body and n not in seen:
                    seen.add(n)
                    waiting.append((n, iter(blocks[n].next)))
                    break
            else:
                order.append(b)
                waiting.pop()

    visit(loop.head)
    return order[::-1]


def _target(instruction: Instruction) -> int:
    found = _TARGET.findall(instruction.operands)
    return int(found[-1], 16) if found else -1
