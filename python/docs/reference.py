"""Writes the page of the Python module from its docstrings: reference.py FILE, with the module in PYTHONPATH. The CMake target docs_pages calls it."""

from __future__ import annotations

import inspect
import re
import sys
from typing import Any, Iterator, List, Tuple

import semfield as sf

GROUPS: List[Tuple[str, List[str]]] = [
    ("Runs", ["open", "resume", "load", "train", "resolved", "Run", "Training", "Labels"]),
    ("What calls give back", ["Step", "View", "Points", "Score", "Outcome", "Objects", "Object"]),
    ("Scenes", ["Scene", "Camera", "Frame", "ClassEntry"]),
    ("Plugins", ["encoder", "head", "loss", "dataset", "param", "Tensor", "Encoder", "Head", "Loss", "Dataset", "load_plugin", "plugins"]),
    ("The program", ["command", "tune"]),
    ("Errors", ["Error", "Finding", "UsageError", "ConfigError", "DataError", "InputError", "UnavailableError", "WriteError",
                "CommandError"]),
]
HEAD = """# The Python module

From the docstrings: `help(semfield.Run)` prints the same. The guide is [Python](../guide/python.md).

"""


def text_of(doc: str) -> str:
    """A docstring as Markdown: its sections become lists."""
    text = re.sub(r"^Args:$", "Arguments:", inspect.cleandoc(doc).replace("``", "`"), flags=re.M)
    text = re.sub(r"^(Arguments|Attributes|Returns|Yields|Raises):\n", r"\1:\n\n", text, flags=re.M)
    return re.sub(r"^    (?! )", "", re.sub(r"^    ([\w, *]+): ", r"- `\1`: ", text, flags=re.M), flags=re.M).rstrip()


def signature_of(thing: Any) -> str:
    words = str(inspect.signature(thing))
    for long, short in ((r"(: |-> )'([^']*)'", r"\1\2"), (r"np\.ndarray\[Any, Any\]", "ndarray"), (r"\bself(, )?", ""), (r" -> None$", "")):
        words = re.sub(long, short, words)
    if len(words) < 90:
        return words
    inside, after = words[1:].rsplit(")", 1)
    parts = re.split(r", (?=\*+\w*|\w+[:=])", inside)  # commas within brackets are no ends
    return "(\n" + "".join(f"    {part},\n" for part in parts) + ")" + after


def members_of(cls: type) -> Iterator[Tuple[str, str]]:
    """Heading and docstring of every public method and property, in the order of the source."""
    for name, value in ((name, value) for owner in cls.__mro__ for name, value in vars(owner).items()):
        if name.startswith("_"):
            continue
        if isinstance(value, property):
            yield name + ("" if inspect.isbuiltin(value.fget) else signature_of(value.fget)[2:]), value.__doc__ or ""
        elif isinstance(value, (staticmethod, classmethod)) or inspect.isfunction(value):
            yield name + signature_of(getattr(cls, name)), getattr(cls, name).__doc__ or ""
        elif callable(value) and getattr(value, "__doc__", None):  # of the extension
            yield f"{name}()", value.__doc__.split("\n\n")[-1]


def heading_of(name: str, thing: Any) -> str:
    if inspect.isclass(thing):
        if thing in (sf.Run, sf.Training, sf.Labels, sf.Score) or issubclass(thing, (sf.Encoder, sf.Dataset, sf.Error)):
            return name  # nobody makes them by hand
        return name + signature_of(thing).split(" -> ")[0]
    try:
        return name + signature_of(thing)
    except ValueError:  # of the extension: in its docstring
        return str(thing.__doc__).split("\n")[0].replace("numpy.ndarray", "ndarray").replace("semfield._core.", "")


def entry(name: str, thing: Any) -> str:
    heading, doc = heading_of(name, thing), thing.__doc__ or ""
    shown = "" if heading == name else f"```text\n{heading}\n```\n\n"
    parts = [f"### {name}\n\n{shown}{text_of(doc.split(chr(10) * 2, 1)[-1] if inspect.isbuiltin(thing) else doc)}\n"]
    if inspect.isclass(thing) and not issubclass(thing, sf.Error):
        for heading, doc in members_of(thing):
            word = re.split(r"\W", heading)[0]
            parts.append(f"#### {name}.{word}\n\n```text\n{heading}\n```\n\n{text_of(doc)}\n")
    return "\n".join(parts)


if __name__ == "__main__":
    listed = {name for _, names in GROUPS for name in names}
    public = {name for name in sf.__all__ if name not in ("errors", "__version__")}
    if listed != public:
        raise SystemExit(f"reference.py: GROUPS and semfield.__all__ differ in {sorted(listed ^ public)}")
    page = HEAD + "\n".join(f"## {title}\n\n" + "\n".join(entry(name, getattr(sf, name)) for name in names) for title, names in GROUPS)
    with open(sys.argv[1], "w", encoding="utf-8") as file:
        file.write(page)
