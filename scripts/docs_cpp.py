"""The page of the C++ interface for plugins and programs, from the comments of its headers. A declaration is on the page if a `///` comment is above it or a
`///<` one behind it, and it is not private."""
import os
import re

GROUPS = [
    ("For plugins", ["plugin/module.h", "plugin/encoder.h", "plugin/field.h", "plugin/mlp/field.h", "plugin/sampler.h", "plugin/head/head.h", "plugin/loss.h",
                     "plugin/channels.h", "plugin/dataset.h", "plugin/grouping.h", "plugin/registry.h", "plugin/kernels.h", "loading/posed_photographs.h",
                     "labels/label_files.h", "config/params.h", "core/view.h", "core/error.h", "core/rng.h"]),
    ("For programs", ["session/training.h", "run/run_loop.h", "run/run_session.h", "run/train_run.h", "eval/field_points.h", "scene/camera.h"]),
]
HEAD = """# C++ interface

From the comments of the headers, which are installed below `include/semfield`. The [plugin quick start](../guide/plugin_quick_start.md) and
[training from C++](../guide/driving_training.md) show their use; what stays from version to version is in [promises](compatibility.md#promises).
"""
SCOPE = re.compile(r"^(?:template <[^>]*>\s*)?(?:class|struct|enum class) (\w+)(?: final)?\s*(?::[^;]*)?\{?")
TYPE = ("class ", "struct ", "enum ", "template")


def declaration_at(lines, i):
    """The text of a declaration from line i to its end, on one line, without its body."""
    text = ""
    for line in lines[i:i + 12]:
        text += " " + line.split("///<")[0].split(" // ")[0].strip()
        if text.count("(") <= text.count(")") and re.search(r"[;{]\s*$|\) (?:const )?(?:noexcept )?(?:override )?\{.*\}$", text):
            break
        if text.rstrip().endswith(",") and "(" not in text:
            break
    text = re.sub(r"^(?:virtual|explicit|inline constexpr|inline|static constexpr|static) ", "", re.sub(r"\s+", " ", text.strip()))
    end = r"\s*(?:\{.*|;|,|: \w+_?\{?\(?.*)$" if text.startswith(TYPE) else r"\s*(?:\{\}?.*|;|,)$"
    return re.sub(end, "", re.sub(r" = 0;$", ";", text))


def entries_of(text):
    """(scope, declaration, what it says) of a header."""
    lines, out, doc, scope, visible = text.split("\n"), [], [], "", True
    for i, line in enumerate(lines):
        bare = line.strip()
        if re.match(r"(public|protected|private):", bare):
            visible = not bare.startswith("private")
        if line.startswith("}"):
            scope, visible = "", True
        if bare.startswith("///"):
            doc.append(bare.lstrip("/ "))
            continue
        opened = SCOPE.match(line) or (SCOPE.match(lines[i + 1]) if line.startswith("template <") and i + 1 < len(lines) else None)
        behind = bare.split("///<", 1)[1].strip() if "///<" in bare else ""
        for more in lines[i + 1:] if behind else ():
            if not more.strip().startswith("///<"):
                break
            behind += " " + more.strip()[4:].strip()
        said = " ".join(doc) or behind
        if said and visible and bare and not bare.startswith(("//", "#", "template <")):
            out.append((scope, declaration_at(lines, i), said))
        if bare and not bare.startswith("template <"):
            doc = []
        if opened and not line.rstrip().endswith(";"):
            scope, visible = opened[1], not line.startswith("class") or visible
    return out


def page(root):
    out = HEAD
    for group, headers in GROUPS:
        out += f"\n## {group}\n"
        for header in headers:
            with open(os.path.join(root, "framework", header), encoding="utf-8") as file:
                text = file.read()
            first = re.match(r"((?://[^/].*\n)+)", text)
            about = " ".join(line[2:].strip() for line in first[1].split("\n")) if first else ""
            out += f"\n### {header}\n\n{about.strip()}\n\n| declaration | what it is |\n|---|---|\n"
            for scope, declaration, said in entries_of(text):
                name = f"{scope}: " if scope and not declaration.startswith(("class ", "struct ", "template <class Real> class")) else ""
                cells = [cell.replace("|", "\\|") for cell in (name + declaration, said)]
                out += f"| `{cells[0]}` | {cells[1]} |\n"
    return out
