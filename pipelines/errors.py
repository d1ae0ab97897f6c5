"""Mistakes of the user, as one line each: what it is about, the cause, the cure. And the exit codes.

Anything that is not one of these is a bug of ours and keeps its traceback.
"""

from __future__ import annotations

EXIT_OK = 0
EXIT_SHOTS_FAILED = 1
EXIT_USAGE = 2
EXIT_INTERRUPTED = 130


class UserError(Exception):
    """Something that the user can put right.

    what: the file, option or tool it is about. cause: what is wrong with it. cure: what to do about it.
    """

    kind = "error"

    def __init__(self, what: object, cause: str, cure: str) -> None:
        super().__init__(what, cause, cure)
        self.what = str(what)
        self.cause = cause
        self.cure = cure

    def __str__(self) -> str:
        # One line whatever is in a file name: a newline there must not break the "one line" promise.
        line = f"{self.what}: {self.cause}; {self.cure}"
        return "".join(c if c.isprintable() else repr(c)[1:-1] for c in line)

    def as_dict(self) -> dict[str, str]:
        """The same as a JSON-ready mapping."""
        return {"kind": self.kind, "what": self.what, "cause": self.cause, "cure": self.cure}


class InputError(UserError):
    """A clip, or another file that is read, cannot be used."""

    kind = "input"


class ConfigError(UserError):
    """A setting is unknown, or its value is not possible."""

    kind = "config"


class OutputError(UserError):
    """The output folder cannot be written, or somebody else is writing it."""

    kind = "output"


class MissingToolError(UserError):
    """Something optional that was asked for is not installed."""

    kind = "missing tool"
