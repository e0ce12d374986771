"""The sparse pattern of a space's tangent, and where the entries of elements and faces go in it.

It depends on topology and held nodes only. Meshes of one topology share it (`pattern_of` caches the last ones), and
with it the linear solver's symbolic analysis.
"""

import hashlib
from collections import OrderedDict

import numpy as np
import scipy.sparse as sp
import warp as wp

from synth.simulate.linear import Factor, direct_factor
from synth.simulate.space import Space


class SparsityPattern:
    """Upper triangle (CSR) over the free unknowns: 3 displacements per node, then the pressures.

    Attributes:
        free: (k,) unknowns that are not held.
        indptr, indices: (k + 1,), (nnz,) int32.
        element_pairs, face_pairs: (np, 2) int32, local nodes a <= b.
        block_slot: (m, np, 9) entry of each displacement block, a Warp array of int32 on the CPU as all slots; nnz
            stands for "nowhere".
        coupling_slot: (m, 4 nn, 3), pressure_slot: (m, 4, 4); without a pressure field (m, 0, 3) and (m, 0, 0).
        face_slot: (f, np', 9).
        face_unknowns: (f, 3 ns) number among the free unknowns, or -1.
    """

    def __init__(self, space: Space, mixed: bool) -> None:
        n = len(space.points)
        held = np.concatenate([space.held.ravel(), np.zeros(space.pressures if mixed else 0, dtype=bool)])
        self.free = np.flatnonzero(~held)
        number = np.full(len(held), -1, dtype=np.int64)
        number[self.free] = np.arange(len(self.free))

        moves = number[(3 * space.nodes[:, :, None].astype(np.int64) + np.arange(3))]
        pressures = number[3 * n + space.pressure_nodes.astype(np.int64)] if mixed else None
        self._couple(moves, pressures)
        self.element_pairs = _pairs(space.nodes.shape[1])
        self.block_slot = self._blocks(moves, self.element_pairs)
        count = len(space.nodes)
        if pressures is None:
            self.coupling_slot, self.pressure_slot = _on_cpu(np.zeros((count, 0, 3))), _on_cpu(np.zeros((count, 0, 0)))
        else:
            row, column = moves[:, :, None, :], pressures[:, None, :, None]
            self.coupling_slot = _on_cpu(self._slots(*np.broadcast_arrays(row, column)).reshape(count, -1, 3))
            row, column = np.broadcast_arrays(pressures[:, :, None], pressures[:, None, :])
            self.pressure_slot = _on_cpu(np.where(row <= column, self._slots(row, column), self.size))
        faces = number[(3 * space.faces[:, :, None].astype(np.int64) + np.arange(3))]
        self.face_pairs = _pairs(space.faces.shape[1])
        self.face_slot = self._blocks(faces, self.face_pairs)
        self.face_unknowns = faces.reshape(len(faces), -1)
        self._factors: dict[bool, Factor] = {}
        del self._keys

    @property
    def size(self) -> int:
        return len(self.indices)

    def factor(self, single: bool = True) -> Factor:
        """A factor of this pattern, in single or double precision; analysed once."""
        if single not in self._factors:
            self._factors[single] = direct_factor(self.indptr, self.indices, single)
        return self._factors[single]

    def _couple(self, moves: np.ndarray, pressures: np.ndarray | None) -> None:
        local = moves.reshape(len(moves), -1)
        if pressures is not None:
            local = np.concatenate([local, pressures], axis=1)
        element, place = np.nonzero(local >= 0)
        shape = (len(local), len(self.free))
        incidence = sp.csr_matrix((np.ones(len(element), dtype=np.int32), (element, local[element, place])), shape)
        coupled = sp.triu(incidence.T @ incidence, format="csr")
        coupled.sort_indices()
        self.indptr, self.indices = coupled.indptr.astype(np.int32), coupled.indices.astype(np.int32)
        self._keys = np.repeat(np.arange(len(self.free)), np.diff(self.indptr)) * len(self.free) + self.indices

    def _slots(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """int32 places of entries in either order of row and column; nowhere where one of them is held."""
        first, last = np.minimum(row, column), np.maximum(row, column)
        place = np.searchsorted(self._keys, first * len(self.free) + last)
        return np.where(first >= 0, place, self.size).astype(np.int32)

    def _blocks(self, moves: np.ndarray, pairs: np.ndarray) -> wp.array:
        row, column = moves[:, pairs[:, 0], :, None], moves[:, pairs[:, 1], None, :]
        row, column = np.broadcast_arrays(row, column)
        slots = self._slots(row, column)
        own = (pairs[:, 0] == pairs[:, 1])[None, :, None, None]
        return _on_cpu(np.where(own & (row > column), self.size, slots).reshape(len(moves), len(pairs), 9))


def _on_cpu(slots: np.ndarray) -> wp.array:
    return wp.array(slots, dtype=wp.int32, device="cpu")


def _pairs(count: int) -> np.ndarray:
    return np.array([(a, b) for a in range(count) for b in range(a, count)], dtype=np.int32)


_CACHED: OrderedDict[str, SparsityPattern] = OrderedDict()
_MAX_CACHED, _MAX_ENTRIES = 8, 4_000_000
"""Most patterns that are cached, and most entries of them all, which bounds memory."""


def pattern_of(space: Space, mixed: bool) -> SparsityPattern:
    """The pattern of a space, from the last few if one of them has its topology."""
    digest = hashlib.sha256(bytes([mixed]))
    for array in (space.nodes, space.pressure_nodes, space.held, space.faces):
        digest.update(np.ascontiguousarray(array).tobytes())
    key = digest.hexdigest()
    if key not in _CACHED:
        _CACHED[key] = SparsityPattern(space, mixed)
        while len(_CACHED) > 1 and (len(_CACHED) > _MAX_CACHED or sum(p.size for p in _CACHED.values()) > _MAX_ENTRIES):
            _CACHED.popitem(last=False)
    _CACHED.move_to_end(key)
    return _CACHED[key]
