"""The program `semfield` of this installation: verbs that Python has no call for."""

from __future__ import annotations

import json
import os
import pathlib
import re
import shutil
import signal
import subprocess
from typing import Any, List

from . import _core
from .errors import Error, UnavailableError


class CommandError(Error):
    """A verb that ended with another code than 0; `stderr` is what it said."""

    stderr: str = ""


def program() -> str:
    """Path of the program: SEMFIELD_PROGRAM, else the one of this build or installation, else that of PATH."""
    named = os.environ.get("SEMFIELD_PROGRAM")
    if named:
        return named
    here = pathlib.Path(_core.__file__).resolve()
    for above in list(here.parents)[:6]:
        found = above / "bin" / "semfield"
        if found.is_file() and os.access(found, os.X_OK):
            return str(found)
    on_path = shutil.which("semfield")
    if on_path is None:
        raise UnavailableError("the program semfield is neither next to the module nor in PATH",
                               remedy="install the package semfield, or set SEMFIELD_PROGRAM", exit_code=69,
                               code="python.program.missing")
    return on_path


def command(*words: Any, json_output: bool = False) -> Any:
    """Runs a verb, as in a terminal: ``command("mesh", "runs/a", "--format", "ply")``.

    Returns what it prints, as text; with `json_output` the object that ``--json`` makes it print.

    Raises:
        CommandError: it ended with another code than 0.
        KeyboardInterrupt: once the verb has ended in order, as it does after Ctrl-C in a terminal.
    """
    line: List[str] = [program(), *(os.fspath(w) if hasattr(w, "__fspath__") else str(w) for w in words)]
    if json_output:
        line.append("--json")
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, encoding="utf-8") as running:
        try:
            out, told = running.communicate()
        except KeyboardInterrupt:
            running.send_signal(signal.SIGINT)  # it ends in order: a training writes its checkpoint
            running.communicate()
            raise
    if running.returncode != 0:
        named = re.search(r"\[(\w+(?:\.\w+){1,3})\]\s*$", told)  # behind the sentence of the error
        error = CommandError(f"semfield {' '.join(line[1:])}: {told.strip() or out.strip()}", exit_code=running.returncode,
                             code=named.group(1) if named else "python.program.failed")
        error.stderr = told
        raise error
    return json.loads(out) if json_output else out
