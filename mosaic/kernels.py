"""The kernel interface of the estimator and its two implementations, chosen by name.

A kernel is a module with `sample`, `linearise`, `robust_weights`, `robust_scale`, `inlier_scale`, `tukey_cost`,
`accumulate`, the same by cells (`linearise_cells`, `accumulate_cells`, `cell_steps`, `cell_scores`, `cell_moments`)
and `shifted_residuals`, of equal signature and meaning: `kernel_numba` (compiled, CPU video path) and `kernel_torch`
(torch / kornia, the reference).
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any, Literal

KernelName = Literal["numba", "torch"]


@cache
def load(name: KernelName) -> Any:
    """The kernel module of that name, imported on first use (torch takes seconds). ValueError: unknown name."""
    if name not in ("numba", "torch"):
        raise ValueError(f"kernel must be 'numba' or 'torch', got {name!r}")
    return import_module(f"mosaic.kernel_{name}")
