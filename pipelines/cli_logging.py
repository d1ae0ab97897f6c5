"""What the program says on stderr while it works: the only place that puts handlers and levels on loggers."""

from __future__ import annotations

import logging
import sys
from typing import Any


class _CurrentStderr(logging.StreamHandler[Any]):
    """Writes to whatever stderr is now: progress bars put themselves in its place while they show."""

    def emit(self, record: logging.LogRecord) -> None:
        # Not setStream: that flushes the old stream, which may be closed by now. Every emit has flushed already.
        self.stream = sys.stderr
        super().emit(record)


def set_up_logging(quiet: bool, verbose: bool, about: str = "") -> None:
    """Errors only, warnings, or everything, to stderr. about: the clip that lines are about, of several."""
    level = logging.ERROR if quiet else logging.INFO if verbose else logging.WARNING
    handler = _CurrentStderr()
    shown = "".join(c if c.isprintable() else "?" for c in about).replace("%", "%%")
    handler.setFormatter(
        logging.Formatter(f"%(levelname)s {shown}{': ' if shown else ''}%(name)s: %(message)s")
    )
    root = logging.getLogger()
    for old in [h for h in root.handlers if isinstance(h, _CurrentStderr)]:
        root.removeHandler(old)
    root.addHandler(handler)
    for package in ("mosaic", "calib", "pipelines"):
        logging.getLogger(package).setLevel(level)
