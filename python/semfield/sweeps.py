"""Experiments: the program's `semfield sweep`, and its results as rows."""

from __future__ import annotations

import csv
import os
import pathlib
from typing import Any, Dict, List, Optional

from .errors import InputError
from .program import command
from .scenes import PathLike


def _rows(path: PathLike) -> List[Dict[str, str]]:
    """Rows of a table. An apostrophe before a text keeps spreadsheets from taking it for a formula; it is taken off."""
    with open(path, newline="", encoding="utf-8") as file:
        return [{key: value[1:] if value.startswith("'") and value.lstrip("'")[:1] in tuple("=+-@\t\r") else value for key, value in row.items()}
                for row in csv.DictReader(file)]


class Sweep:
    """The folder of a sweep that ran.

    Attributes:
        folder: holds cells/, tables.md, results.csv and a .csv a table.
    """

    def __init__(self, folder: PathLike) -> None:
        self.folder = os.fspath(folder)

    def __repr__(self) -> str:
        return f"Sweep({self.folder!r})"

    def _file(self, name: str) -> pathlib.Path:
        path = pathlib.Path(self.folder) / name
        if not path.is_file():
            raise InputError(f"no sweep has ended in {self.folder!r}: there is no {name}; run semfield.sweep(file, out=...)", exit_code=66,
                             code="sweep.result.missing")
        return path

    def table(self) -> List[Dict[str, Any]]:
        """A row for every value of every finished cell: experiment, scene, variant, seed, metric, value.

        ``pandas.DataFrame(sweep.table())`` takes them.
        """
        rows: List[Dict[str, Any]] = []
        for row in _rows(self._file("results.csv")):
            rows.append({**row, "seed": int(row["seed"]), "value": float(row["value"])})
        return rows

    def means(self) -> List[Dict[str, Any]]:
        """A row for every variant, scene and metric: n, mean, half_width of the 95 % interval over seeds."""
        rows: List[Dict[str, Any]] = []
        self._file("results.csv")
        for path in sorted(pathlib.Path(self.folder).glob("*.csv")):
            if path.name in ("results.csv", "cells.csv"):
                continue
            for row in _rows(path):
                rows.append({**row, "experiment": path.stem, "n": int(row["n"]), "mean": float(row["mean"]),
                             "half_width": float(row["half_width"])})
        return rows

    def markdown(self) -> str:
        """The tables as people read them."""
        return self._file("tables.md").read_text(encoding="utf-8")


def sweep(file: PathLike, out: PathLike, jobs: Optional[int] = None, threads: Optional[int] = None) -> Sweep:
    """Runs a sweep file; cells that are done are not run again, so a stopped sweep continues.

    Args:
        file: YAML, docs/guide/sweeps.md.
        out: the sweep's folder.
        jobs: cells at a time; None: every core.
        threads: of each cell; None: 1.

    Raises:
        CommandError: a cell failed, or the file is wrong.
    """
    words: List[Any] = ["sweep", file, "--out", out, "--quiet"]
    if jobs is not None:
        words += ["--jobs", jobs]
    if threads is not None:
        words += ["--threads", threads]
    command(*words)
    return Sweep(out)
