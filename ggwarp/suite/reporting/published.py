# SPDX-License-Identifier: Apache-2.0
"""Figures that papers print: data with their source, never computed here."""

from __future__ import annotations

import math
import statistics
from collections.abc import Collection
from dataclasses import dataclass

from ggwarp.io.toml import read_toml
from ggwarp.suite.definition import PUBLISHED


@dataclass(frozen=True)
class PublishedRow:
    """What a paper prints of one system.

    Attributes:
        system: as it is called there.
        table: number of the table.
        values: figure -> sequence -> value.
        averages: figure -> what is printed as the average, where no sequence is.
        sequences: of the whole table.
    """

    system: str
    table: int
    values: dict[str, dict[str, float]]
    averages: dict[str, float]
    sequences: tuple[str, ...]

    def average(self, metric: str, over: Collection[str]) -> float | None:
        """Return the average over those sequences; None: they are not all printed."""
        if metric in self.averages:
            return self.averages[metric] if set(over) == set(self.sequences) else None
        values = self.values.get(metric, {})
        return statistics.fmean(values[s] for s in over) if values.keys() >= set(over) else None


@dataclass(frozen=True)
class Published:
    """Rows of one paper.

    Attributes:
        title: how the paper is called for short. source: how to find it.
    """

    title: str
    source: str
    rows: tuple[PublishedRow, ...]


def load_published(name: str) -> Published:
    """Return the published rows of that name.

    Raises:
        TomlError: there are none.
    """
    values = read_toml(PUBLISHED / f"{name}.toml")
    sequences: list[str] = values["sequences"]
    rows: list[PublishedRow] = []
    for row in values["rows"]:
        averages = row.get("average", {})
        figures = {key: row[key] for key in row.keys() - {"system", "table", "average"}}
        by_sequence = {
            metric: {s: v for s, v in zip(sequences, listed, strict=True) if not math.isnan(v)}
            for metric, listed in figures.items()
        }
        rows.append(PublishedRow(row["system"], row["table"], by_sequence, averages, tuple(sequences)))
    return Published(values["title"], values["source"], tuple(rows))
