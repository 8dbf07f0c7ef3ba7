"""A growable table of tensor columns whose rows are added and removed together."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import torch
from torch import Tensor

Columns = Mapping[str, tuple[tuple[int, ...], torch.dtype]]


class RowTable:
    """Columns with one row per item; room grows by a quarter, so that adding is cheap."""

    def __init__(self, columns: Columns, device: torch.device) -> None:
        self._device = device
        self._size = 0
        self._columns = {
            name: torch.zeros((0, *shape), dtype=dtype, device=device)
            for name, (shape, dtype) in columns.items()
        }

    def __len__(self) -> int:
        return self._size

    def __getitem__(self, name: str) -> Tensor:
        """The column as a view, [N, ...]; valid until rows are added or removed."""
        return self._columns[name][: self._size]

    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Add rows; columns that are not given start at zero."""
        count = len(next(iter(rows.values())))
        self._reserve(self._size + count)
        new = slice(self._size, self._size + count)
        self._size += count
        for name, column in self._columns.items():
            column[new] = rows[name].to(column) if name in rows else 0

    def keep(self, is_kept: Tensor) -> None:
        """Remove the rows where `is_kept` [N] is false; the last rows take their places."""
        size = int(is_kept.sum())
        holes = (~is_kept[:size]).nonzero()[:, 0]
        movers = size + is_kept[size:].nonzero()[:, 0]
        for column in self._columns.values():
            column[holes] = column[movers]
        self._size = size

    def copy(self, names: Collection[str]) -> RowTable:
        """A table of its own with those of the columns `names` that there are."""
        copied = RowTable({}, self._device)
        copied._columns = {n: self[n].clone() for n in self._columns if n in names}
        copied._size = self._size
        return copied

    def room(self) -> dict[str, Tensor]:
        """Memory for a `state` of this size and a bit more, its pages ready to be written."""
        rows = self._size * 21 // 20 + 4096
        return {
            name: torch.zeros((rows, *column.shape[1:]), dtype=column.dtype)
            for name, column in self._columns.items()
        }

    def state(self, room: Mapping[str, Tensor] | None = None) -> dict[str, Tensor]:
        """Every column, copied to the host: five times faster into `room`, where it fits."""
        return {
            name: self[name].cpu().clone()
            if room is None or len(room[name]) < self._size
            else room[name][: self._size].copy_(self[name])
            for name in self._columns
        }

    def restore(self, state: Mapping[str, Tensor]) -> None:
        """Replace all rows by those of `state()`."""
        self._size = 0
        self.append({name: state[name] for name in self._columns})

    def _reserve(self, size: int) -> None:
        capacity = len(next(iter(self._columns.values())))
        if size <= capacity:
            return
        room = max(size, capacity * 5 // 4 + 1024)
        for name, column in self._columns.items():
            larger = torch.zeros((room, *column.shape[1:]), dtype=column.dtype, device=self._device)
            larger[: self._size] = column[: self._size]
            self._columns[name] = larger
