# SPDX-License-Identifier: Apache-2.0
"""On which bits of a thread's index in its warp the addresses of shared memory depend.

So it is known how many places a warp asks for. A value is followed bit by bit through the machine code:
for each of its 32 bits, on which of the index's five it depends; 160 bits in one number, the value's
lowest first. Shifts move them, masks clear them, sums carry upwards, and whatever else there is depends in
all its bits on all that goes in. What comes through a branch that lanes take differently is not seen.
"""

from __future__ import annotations

import re
from itertools import product

from benchmarking.cubins.sass import Block, Instruction

_OPERAND = re.compile(r"(?:\[.*?\]|[^,\[]+)+")
_REGISTER = re.compile(r"\bU?R\d+\b")
_NUMBER = re.compile(r"^-?0x([0-9a-f]+)$")
_INDEX = sum(1 << (6 * b) for b in range(5))
"""A thread's index: its bit b depends on bit b, for b < 5; the bits above are the same in a warp."""

_ALL = (1 << 160) - 1
_WITHOUT_RESULT = ("STS", "STG", "ST", "STL", "RED", "BAR", "BRA", "EXIT", "BSSY", "BSYNC", "WARPSYNC", "NOP")


def wavefronts(blocks: list[Block]) -> dict[int, int]:
    """Return the address of each shared load or store -> its wavefronts, were there no conflicts of banks.

    They are the bytes of the places that differ, over 128.
    """
    entering: list[dict[str, int]] = [{} for _ in blocks]
    found: dict[int, int] = {}
    waiting = list(range(len(blocks)))
    while waiting:
        k = waiting.pop()
        values = dict(entering[k])
        for i in blocks[k].code:
            if i.operation in ("LDS", "STS"):
                places = 1 << _spread(_carried(_value(_place(i), values))).bit_count()
                found[i.address] = max(found.get(i.address, 1), -(-places * i.bytes // 128))
            _follow(i, values)
        for n in blocks[k].next:
            joined = {r: v | entering[n].get(r, 0) for r, v in values.items()}
            if any(v != entering[n].get(r, 0) for r, v in joined.items()):
                entering[n] |= joined
                waiting.append(n)
    return found


def _follow(i: Instruction, values: dict[str, int]) -> None:
    """Update what registers depend on by one instruction."""
    if i.operation in _WITHOUT_RESULT:
        return
    operands = [part.strip() for part in _OPERAND.findall(i.operands)]
    while operands and re.match(r"^!?U?PT?\d?$", operands[0]):  # predicates that are written, too
        operands.pop(0)
    if not operands or not _REGISTER.match(operands[0]):
        return
    result = _result(i, operands[1:], values)
    words = (
        max(i.bytes // 4, 2 if "WIDE" in i.name else 1)
        if i.operation.startswith(("LD", "IMAD", "UIMAD"))
        else 1
    )
    name = re.match(r"(U?R)(\d+)", operands[0])
    assert name is not None
    for word in range(words):
        register = f"{name[1]}{int(name[2]) + word}"
        values[register] = result | (values.get(register, 0) if i.predicate else 0)


def _result(i: Instruction, sources: list[str], values: dict[str, int]) -> int:
    if "SR_TID.X" in i.operands or "SR_LANEID" in i.operands:
        return _INDEX
    each = [_value(source, values) for source in sources]
    numbers = [_number(source) for source in sources]
    if i.operation in ("MOV", "UMOV"):
        return each[0]
    if i.operation in ("SHF", "USHF") and numbers[1] is not None and numbers[1] < 32:
        if ".R" in i.name:
            return each[2] >> (5 * numbers[1])
        return each[0] << (5 * numbers[1]) & _ALL
    if i.operation in ("LOP3", "ULOP3") and numbers[3] is not None:
        return _logic(
            each[:3],
            [0 if s in ("RZ", "URZ") else n for s, n in zip(sources, numbers, strict=True)][:3],
            numbers[3],
        )
    if i.name.startswith(("IMAD.SHL", "UIMAD.SHL")) and numbers[1]:
        return each[0] << (5 * (numbers[1].bit_length() - 1)) & _ALL
    if i.operation in ("LEA", "ULEA") and numbers[2] is not None and ".HI" not in i.name:
        return _carried(each[0] << (5 * numbers[2]) & _ALL | each[1])
    if i.operation in ("IADD3", "IADD", "UIADD3", "IMAD", "UIMAD", "VIADD") and "HI" not in i.name:
        return _carried(_union(each))
    return _everywhere(_spread(_union(each)))


def _logic(each: list[int], numbers: list[int | None], table: int) -> int:
    """A bitwise function of three: an operand counts where the others, as far as they are known, let it."""
    total = 0
    for bit in range(32):
        known = [None if n is None else n >> bit & 1 for n in numbers]
        rows = [
            r for r in product((0, 1), repeat=3) if all(k in (None, v) for k, v in zip(known, r, strict=True))
        ]
        for k in range(3):
            flipped = [(r, (*r[:k], 1 - r[k], *r[k + 1 :])) for r in rows]
            if known[k] is None and any(_entry(table, a) != _entry(table, b) for a, b in flipped):
                total |= each[k] & (31 << 5 * bit)
    return total


def _entry(table: int, row: tuple[int, ...]) -> int:
    return table >> (4 * row[0] + 2 * row[1] + row[2]) & 1


def _place(i: Instruction) -> str:
    found = re.search(r"\[(.*?)\]", i.operands)
    return found[1] if found else ""


def _value(source: str, values: dict[str, int]) -> int:
    return _union(values.get(r, 0) for r in _REGISTER.findall(source))


def _number(source: str) -> int | None:
    found = _NUMBER.match(source)
    return int(found[1], 16) if found else None


def _union(each) -> int:
    total = 0
    for value in each:
        total |= value
    return total


def _carried(value: int) -> int:
    """What a sum depends on: each bit on those below it, too."""
    for step in (1, 2, 4, 8, 16):
        value |= value << (5 * step) & _ALL
    return value


def _spread(value: int) -> int:
    """The bits of the index that any bit of a value depends on."""
    total = 0
    for bit in range(32):
        total |= value >> (5 * bit) & 31
    return total


def _everywhere(mask: int) -> int:
    return _union(mask << (5 * bit) for bit in range(32))
