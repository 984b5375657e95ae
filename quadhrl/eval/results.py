"""The folder of a comparison: finished rollouts as CSV, and the configuration that they belong to."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
from pathlib import Path
from typing import Any

from quadhrl.errors import InputError
from quadhrl.eval.rollouts import Episode

__all__ = ["ResultsFolder"]

_FIELDS = {field.name: field.type for field in dataclasses.fields(Episode)}
_READ = {"str": str, "int": int, "float": float}


class ResultsFolder:
    """Creates the folder, or reopens it: every rollout in it counts as done.

    Args:
        path: the folder.
        configuration: what all of its rollouts have in common, as JSON-like values; written to ``configuration.json``. What
            the folder's own does not mention yet is added to it.

    Raises:
        InputError: it holds results of another configuration, or something else, or it cannot be written.
    """

    def __init__(self, path: Path, configuration: dict[str, Any]) -> None:
        self.path, self._file = path, path / "episodes.csv"
        settings = path / "configuration.json"
        try:
            if settings.exists():
                found = json.loads(settings.read_text())
                _check_same(path, found, json.loads(json.dumps(configuration)))
                configuration = found | configuration
            elif path.exists() and (not path.is_dir() or any(path.iterdir())):
                raise InputError("--out", str(path), "it holds something else; choose a new folder")
            path.mkdir(parents=True, exist_ok=True)
            settings.write_text(json.dumps(configuration, indent=2) + "\n")
        except ValueError as error:
            if isinstance(error, InputError):
                raise
            raise InputError("--out", str(settings), "the file is damaged; choose a new folder") from error
        except OSError as error:
            raise InputError("--out", str(path), f"cannot write there ({error.strerror}); choose another") from error
        self.episodes: list[Episode] = self._read()
        """Finished rollouts, in the order in which they ended."""

    def add(self, episode: Episode) -> None:
        """Keep a finished rollout, on disk at once.

        Raises:
            InputError: the disk is full.
        """
        self.episodes.append(episode)
        try:
            with self._file.open("a", newline="") as file:
                writer = csv.writer(file)
                if file.tell() == 0:
                    writer.writerow(_FIELDS)
                writer.writerow(dataclasses.astuple(episode))
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            remedy = f"cannot write it ({error.strerror}); free some space and run the same command again to carry on"
            raise InputError("--out", str(self._file), remedy) from error

    def sort(self) -> None:
        """Bring rollouts and file into an order that does not depend on which ended first."""
        self.episodes.sort(key=lambda e: (e.method, -e.infill, e.height_range, e.rollout))
        self._write()

    def _write(self) -> None:
        sorted_file = self._file.with_suffix(".tmp")
        with sorted_file.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(_FIELDS)
            writer.writerows(dataclasses.astuple(episode) for episode in self.episodes)
        sorted_file.replace(self._file)

    def _read(self) -> list[Episode]:
        """The rollouts in the file; a last line that was cut short by a kill is dropped from it."""
        if not self._file.exists():
            return []
        with self._file.open(newline="") as file:
            rows = list(csv.reader(file))
        if not rows or rows[0] != list(_FIELDS):
            raise InputError("--out", str(self._file), "its columns are of another version; choose a new folder")
        episodes, whole = [], self._file.read_text().endswith("\n")
        for number, row in enumerate(rows[1:], 2):
            try:
                values = [_READ[str(kind)](x) for kind, x in zip(_FIELDS.values(), row, strict=True)]
                episodes.append(Episode(*values))
            except ValueError as error:
                if number == len(rows) and not whole:
                    break
                raise InputError("--out", f"{self._file}:{number}", "the line is damaged; delete it") from error
        if not whole:  # the cut line may have parsed; it is run again
            del episodes[len(rows) - 2 :]
            self.episodes = episodes
            self._write()
        return episodes


def _check_same(path: Path, found: dict[str, Any], wanted: dict[str, Any]) -> None:
    for name in found.keys() & wanted.keys():
        if found[name] != wanted[name]:
            remedy = f"it holds results with {name} = {found[name]!r}, not {wanted[name]!r}; choose a new folder"
            raise InputError("--out", str(path), remedy)
