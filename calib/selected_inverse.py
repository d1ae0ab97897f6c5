"""The parts of a covariance that error bars need, without the whole inverse: linear in the number of frames.

Frames in time order are joined to near ones only, so the pose part of the normal matrix is block-banded once the few
frames with long links (keyframes that are revisited) are put into the border beside the shared parameters. Diagonal
blocks come from a two-way block recursion, products from one sparse factorisation. Source: calibration.md 6.6.
"""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse.csgraph import reverse_cuthill_mckee

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
MAX_BAND = 96  # frames: a block of the recursion is that wide, its cost a frame grows with the square
MAX_HUBS = 96


def inverse_diagonal_blocks(A: sp.csc_array, band: int) -> Array:
    """4 x 4 diagonal blocks (n, 4, 4) of A^-1 for a block-banded positive matrix, links up to `band` blocks apart.

    Two-way block recursion (calibration.md 6.6), O(n band^2). Raises numpy.linalg.LinAlgError when singular.
    """
    n = A.shape[0] // 4
    size = 4 * band
    starts = list(range(0, 4 * n, size))
    stops = [min(s + size, 4 * n) for s in starts]
    A = A.tocsr()
    T: list[tuple[Array, bool]] = []  # Cholesky factors
    X: list[Array] = []
    for k, (s, e) in enumerate(zip(starts, stops, strict=True)):
        block = A[s:e, s:e].toarray()
        if k:
            U = A[starts[k - 1] : s, s:e].toarray()
            gain = cho_solve(T[-1], U, check_finite=False)
            X.append(gain)
            block = block - U.T @ gain
        T.append(cho_factor(block, lower=True, check_finite=False))
    out = np.zeros((n, 4, 4))
    P: Array = np.zeros((0, 0))
    for k in range(len(starts) - 1, -1, -1):
        inverse = cho_solve(T[k], np.eye(stops[k] - starts[k]), check_finite=False)
        P = np.asarray(inverse if k == len(starts) - 1 else inverse + X[k] @ P @ X[k].T)
        frames = np.arange((stops[k] - starts[k]) // 4)
        out[starts[k] // 4 + frames] = P.reshape(len(frames), 4, len(frames), 4)[frames, :, frames]
    return out


class Ordering(NamedTuple):
    """inner: frames (rows) in the order of the recursion; hubs: frames in the border; band of the links among inner."""

    inner: IntArray
    hubs: IntArray
    band: int


def order_frames(ia: IntArray, ib: IntArray, n: int) -> Ordering:
    """An order of n frames with links ia - ib (E,) that makes the band narrow, a few hubs taken out.

    Time order first; the frames with most links beyond MAX_BAND become hubs. Where that is not enough (frames looked at
    again and again) the reverse Cuthill-McKee order, if it is narrower.
    """
    hubs: list[int] = []
    inside = np.ones(n, bool)
    while len(hubs) < MAX_HUBS:
        long = inside[ia] & inside[ib] & (np.abs(ia - ib) > MAX_BAND)
        if not long.any():
            break
        count = np.bincount(np.concatenate([ia[long], ib[long]]), minlength=n)
        hubs.append(int(np.argmax(count)))
        inside[hubs[-1]] = False
    inner = np.flatnonzero(inside)
    position = np.full(n, -1)
    position[inner] = np.arange(len(inner))
    kept = inside[ia] & inside[ib]
    pa, pb = position[ia[kept]], position[ib[kept]]
    band = int(np.abs(pa - pb).max(initial=1))
    if band > MAX_BAND:
        links = sp.csr_array((np.ones(len(pa)), (pa, pb)), shape=(len(inner),) * 2)
        order = reverse_cuthill_mckee(sp.csr_matrix(links + links.T), symmetric_mode=True).astype(int)
        place = np.empty(len(order), int)
        place[order] = np.arange(len(order))
        narrow = int(np.abs(place[pa] - place[pb]).max(initial=1))
        if narrow < band:
            inner, band = inner[order], narrow
    return Ordering(inner, np.array(sorted(hubs), int), max(band, 1))


class SelectedCovariance:
    """Parts of M^-1 of the bordered normal matrix M = full + mean_weight u u^T, u = 1 on every log f.

    full: sparse (4 n + s, 4 n + s), s shared parameters last; active (4 n + s,) False = held (zero rows in the result);
    ia, ib (E,) frames that edges join. Raises numpy.linalg.LinAlgError when singular.
    """

    def __init__(
        self,
        full: sp.csc_array,
        active: NDArray[np.bool_],
        n: int,
        ia: IntArray,
        ib: IntArray,
        mean_weight: float,
    ) -> None:
        self.n, self.size, self.active = n, len(active), active
        order = order_frames(ia, ib, n)
        self.inner_frames, self.hubs = order.inner, order.hubs
        # Held unknowns stay as rows of the identity, so that every frame keeps its four.
        keep = sp.diags_array(active.astype(float))
        full = (keep @ full @ keep + sp.diags_array((~active).astype(float))).tocsr()
        self.inner = (4 * order.inner[:, None] + np.arange(4)).ravel()
        shared = np.arange(4 * n, self.size)
        self.border = np.concatenate([(4 * order.hubs[:, None] + np.arange(4)).ravel(), shared]).astype(int)
        A = full[self.inner][:, self.inner].tocsc()
        u = np.zeros(self.size)
        u[0 : 4 * n : 4] = active[0 : 4 * n : 4]
        B = np.hstack([full[self.inner][:, self.border].toarray(), u[self.inner, None]])
        k = len(self.border)
        D = np.zeros((k + 1, k + 1))
        D[:k, :k] = full[self.border][:, self.border].toarray()
        D[:k, k] = D[k, :k] = u[self.border]
        # The mean-log-f prior is rank one: as a bordered variable it keeps A sparse.
        D[k, k] = -1 / mean_weight
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                self.factor = spla.splu(
                    A, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
                )
        except (RuntimeError, Warning) as error:
            raise np.linalg.LinAlgError(str(error)) from error
        self.Y, self.B = self.factor.solve(B), B
        self.S_inv = np.linalg.inv(D - B.T @ self.Y)
        self.blocks_inner = inverse_diagonal_blocks(A, order.band)

    def product(self, vector: Array) -> Array:
        """M^-1 v (size,) of a vector (size,); held unknowns are 0."""
        v = np.where(self.active, vector, 0.0)
        z = self.factor.solve(v[self.inner])
        s = self.S_inv @ (np.append(v[self.border], 0.0) - self.B.T @ z)
        out = np.zeros(self.size)
        out[self.inner], out[self.border] = z - self.Y @ s, s[:-1]
        return np.where(self.active, out, 0.0)

    def frame_blocks(self) -> Array:
        """4 x 4 diagonal blocks (n, 4, 4), zero rows and columns for held unknowns."""
        out = np.zeros((self.n, 4, 4))
        Y = self.Y.reshape(len(self.inner_frames), 4, -1)
        out[self.inner_frames] = self.blocks_inner + Y @ self.S_inv @ np.swapaxes(Y, 1, 2)
        for j, frame in enumerate(self.hubs):
            out[frame] = self.S_inv[4 * j : 4 * j + 4, 4 * j : 4 * j + 4]
        held = ~self.active[: 4 * self.n].reshape(self.n, 4)
        return np.where(held[:, :, None] | held[:, None, :], 0.0, out)

    def shared_variances(self) -> Array:
        """Variances of the shared parameters, 0 for held ones."""
        k = self.size - 4 * self.n
        variance = np.diagonal(self.S_inv)[len(self.border) - k : len(self.border)]
        return np.where(self.active[4 * self.n :], variance, 0.0)


class DenseCovariance:
    """The same face over a whole inverse (size, size), for small graphs."""

    def __init__(self, matrix: Array, n: int) -> None:
        self.matrix, self.n = matrix, n

    def product(self, vector: Array) -> Array:
        """M^-1 v (size,)."""
        return np.asarray(self.matrix @ vector)

    def frame_blocks(self) -> Array:
        """4 x 4 diagonal blocks (n, 4, 4)."""
        k = np.arange(self.n)
        return self.matrix[: 4 * self.n, : 4 * self.n].reshape(self.n, 4, self.n, 4)[k, :, k]

    def shared_variances(self) -> Array:
        """Variances of the shared parameters."""
        return np.diagonal(self.matrix)[4 * self.n :]
