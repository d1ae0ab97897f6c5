"""Large pictures whose memory can be given back while they are not touched."""

from __future__ import annotations

import mmap
import os
import tempfile
from typing import Any

import numpy as np
from numpy.typing import NDArray


class Canvas:
    """Arrays in memory while they fit into a budget, else in an unlinked file of the scratch folder.

    A shared file map counts as resident while its pages are mapped: release() unmaps them, the data stay.
    """

    def __init__(self, folder: str | os.PathLike[str], memory_bytes: int) -> None:
        self._folder, self._left, self._maps = folder, memory_bytes, list[mmap.mmap]()

    def zeros(self, shape: tuple[int, ...], dtype: type[np.generic] = np.uint8) -> NDArray[Any]:
        """An array of zeros. Raises OSError where the disk has no room for it."""
        n_bytes = int(np.prod(shape)) * np.dtype(dtype).itemsize
        if n_bytes <= self._left:
            self._left -= n_bytes
            return np.zeros(shape, dtype)
        with tempfile.TemporaryFile(prefix="panorama-", dir=self._folder) as file:
            # Not a sparse file: on a full disk this raises, where writing to a page without a block would kill.
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, n_bytes)
            else:
                file.truncate(n_bytes)
            pages = mmap.mmap(file.fileno(), n_bytes)
        self._maps.append(pages)
        return np.frombuffer(pages, dtype).reshape(shape)

    def release(self) -> None:
        for pages in self._maps:
            pages.flush()
            if hasattr(mmap, "MADV_DONTNEED"):  # Linux; elsewhere the system takes pages back by itself
                pages.madvise(mmap.MADV_DONTNEED)
