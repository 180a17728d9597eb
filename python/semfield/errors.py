"""Exceptions of Semfield. Every message names what, where and why; `findings` lists each problem."""

from __future__ import annotations

from typing import List, NamedTuple, Sequence, Tuple


class Finding(NamedTuple):
    """One problem of an input."""

    where: str  #: file:line:column, frame or key; may be empty
    message: str  #: what is wrong, with the value found
    remedy: str  #: one next step; may be empty
    code: str  #: the name of the cause, such as ``config.key.unknown``


class Error(Exception):
    """Base of all exceptions of Semfield.

    Attributes:
        findings: every problem, at least one.
        remedy: one next step; may be empty.
        context: what was being done, outermost first.
        code: the stable name of the cause, such as ``config.key.unknown``; of several findings that of the first.
        exit_code: the code with which the program `semfield` would end.
    """

    def __init__(
        self,
        text: str,
        findings: Sequence[Tuple[str, str, str, str]] = (),
        remedy: str = "",
        context: Sequence[str] = (),
        exit_code: int = 1,
        code: str = "plugin.python.raised",
    ) -> None:
        super().__init__(text)
        self.findings: List[Finding] = [Finding(*f) for f in findings] or [Finding("", text, remedy, code)]
        self.remedy = remedy
        self.context: List[str] = list(context)
        self.exit_code = exit_code
        self.code = code


class UsageError(Error, ValueError):
    """The arguments of a call do not fit."""


class ConfigError(Error, ValueError):
    """A configuration is wrong; `findings` has every key that is."""


class DataError(Error, ValueError):
    """A scene, a label or a checkpoint is wrong."""


class InputError(Error, FileNotFoundError):
    """A file or a folder is missing."""


class UnavailableError(Error):
    """A plugin, a device or a library is missing."""


class WriteError(Error, OSError):
    """Something could not be written."""

    def __str__(self) -> str:  # OSError has a form of its own
        return str(self.args[0]) if self.args else ""
