#!/usr/bin/env python3
"""Finds places where g++ 12 destroys a member twice: nested_aggregates.py ROOT [FOLDER...].

An aggregate whose member is an aggregate too, with something to destroy, and a later initialiser that throws: g++ 12.2 destroys that member, and then each
of its own members once more (double free). It happens for braces without a type and for members that are left out, not for `Inner{...}` or a value that was
there before. So a call may stand behind such a member only where the member's initialiser names its type.
"""

import pathlib
import re
import sys

OWNERS = re.compile(r"\b(string|vector|map|set|multimap|unordered_map|deque|function|unique_ptr|shared_ptr|path|any|thread|jthread|Json|json|ordered_json)\b(?!\s*[*&])")
# Calls that throw nothing, or only when memory is used up.
CALM = re.compile(r"\b(std::move|std::forward|std::ssize|std::size|static_cast<[^()]*>|sizeof|data|size|begin|end|empty|front|back|c_str|get|value|span|std::span|View<[^()]*>|"
                  r"std::span<[^()]*>|std::min|std::max|std::pow|std::sqrt|std::cos|std::sin|std::exp|std::log|std::abs|std::exchange|std::nullopt)\s*$")


def blanked(text):
    """The same length without comments and texts."""
    def blank(match):
        word = match.group()
        keep = '"' if word[0] in 'R"' else "'" if word[0] == "'" else " "
        return keep + re.sub(r"[^\n]", "_" if keep != " " else " ", word[1:-1]) + keep
    return re.sub(r'//[^\n]*|/\*.*?\*/|R"(\w*)\(.*?\)\1"|"(?:\\.|[^"\\\n])*"|(?<![0-9A-Fa-f])\'(?:\\.|[^\'\\\n])+\'', blank, text, flags=re.S)


def closing(text, at):
    """The place of the bracket that closes the one at `at`."""
    depth = 0
    for i in range(at, len(text)):
        if text[i] in "({[":
            depth += 1
        elif text[i] in ")}]":
            depth -= 1
            if depth == 0:
                return i
    return len(text) - 1


def parts(text, separator):
    """Cut at separators outside brackets; the angle brackets of templates are brackets where names stand before them."""
    out, begin, depth = [], 0, 0
    for i, c in enumerate(text):
        if c in "({[" or (c == "<" and re.search(r"\w$", text[:i]) and not text[i - 1:i + 1].startswith(" ")):
            depth += 1
        elif c in ")}]" or (c == ">" and depth > 0 and text[i - 1] not in "-= "):
            depth -= 1
        elif c == separator and depth == 0:
            out.append(text[begin:i])
            begin = i + 1
    out.append(text[begin:])
    return [one.strip() for one in out]


class Struct:
    def __init__(self, name, path, body):
        self.name, self.path, self.members = name, path, []  # of members: type, name
        self.aggregate = not re.search(r"\bprivate:|\bprotected:|\bvirtual\b|(?<![\w~:.])(?:explicit\s+)?" + name + r"\s*\((?!\))", body) and \
            not re.search(r"(?<![\w~])" + name + r"\s*\(\s*\)\s*[{:;=]", body)
        flat = self.flattened(body)
        for line in flat.split(";"):
            line = re.sub(r"\b(public|mutable|const)\b:?", " ", line).strip()
            if not line or re.match(r"(using|friend|static|enum|template|struct|class|typedef|constexpr)\b", line) or line.endswith(")"):
                continue
            declared = re.sub(r"\s*(=.*|\{.*)$", "", parts(line, ",")[0], flags=re.S)
            found = re.match(r"(.+?)[\s&*]+(\w+)(\[.*\])?$", declared, flags=re.S)
            if not found or "(" in re.sub(r"<.*>", "", declared):
                continue
            pointed = re.search(r"[&*]\s*\w+(\[.*\])?$", declared) is not None
            names = [found.group(2)] + [re.match(r"\w+", one).group() for one in parts(line, ",")[1:] if re.match(r"\w+", one)]
            for name_ in names:
                self.members.append(("int" if pointed else found.group(1), name_))

    @staticmethod
    def flattened(body):
        """Members at the top; bodies of functions and nested types are left out."""
        out, i = "", 0
        while i < len(body):
            if body[i] == "{":
                end = closing(body, i)
                head = re.split(r"[;}]", out)[-1]
                if re.search(r"\)\s*(const|noexcept|override|final|\s)*(:[^;]*|->[^;]*)?$", head) or re.search(r"\b(struct|class|enum|union)\b[^;]*$", head):
                    out = out[:len(out) - len(head)] + ";"
                else:
                    out += "{}"
                i = end + 1
                continue
            out += body[i]
            i += 1
        return out


def structs_of(files):
    known = {}
    for path, text in files.items():
        for found in re.finditer(r"\b(struct|class)\s+(\w+)\s*(final\s*)?(:[^;{]*)?\{", text):
            body = text[found.end():closing(text, found.end() - 1)]
            one = Struct(found.group(2), path, body)
            if found.group(1) == "class" or found.group(4):
                one.aggregate = one.aggregate and found.group(1) == "struct"
            known.setdefault(one.name, []).append(one)
    return known


class Finder:
    def __init__(self, files):
        self.files, self.known = files, structs_of(files)

    def of(self, type_, path):
        """The struct that a type names, the one of the same file first."""
        name = re.sub(r"<.*", "", type_.strip(), flags=re.S).split("::")[-1].strip()
        here = self.known.get(name, [])
        return next((one for one in here if one.path == path), here[0] if here else None)

    def owns(self, type_, path, depth=0):
        """Something is destroyed with a value of the type."""
        if re.match(r"(std::)?(span|string_view|View|function_ref)\b", type_.strip()) or depth > 6:
            return False
        if OWNERS.search(type_):
            return True
        inner = re.match(r"(?:std::)?(optional|array|pair|tuple|variant)<(.*)>", type_.strip(), flags=re.S)
        if inner:
            return any(self.owns(one, path, depth + 1) for one in parts(inner.group(2), ","))
        one = self.of(type_, path)
        return one is not None and any(self.owns(member, one.path, depth + 1) for member, _ in one.members)

    def nested(self, type_, path):
        if "<" in type_ and re.match(r"(std::)?\w+<", type_.strip()) and self.of(type_, path) is None:
            return False
        one = self.of(type_, path)
        return one is not None and one.aggregate and self.owns(type_, path)

    @staticmethod
    def may_throw(text):
        text = re.sub(r"\[[^\[\]]*\]\s*(\([^()]*\))?\s*(mutable\s*)?(->\s*[\w:<>]+\s*)?\{.*\}", "", text, flags=re.S)  # a lambda is only made
        return any(not CALM.search(text[:at.start()]) and re.search(r"[\w>\])]\s*$", text[:at.start()]) for at in re.finditer(r"\(", text))

    def doubtful(self, struct, inside):
        """The member that may be destroyed twice, or None."""
        given = [one for one in parts(inside, ",") if one]
        named = {re.match(r"\.(\w+)", one).group(1): one for one in given if one.startswith(".")}
        values = []
        for k, (type_, name) in enumerate(struct.members):
            value = named.get(name) if named else given[k] if k < len(given) else None
            value = re.sub(r"^\.\w+\s*=?\s*", "", value) if value is not None else None
            values.append((type_, name, value))
        for k, (type_, name, value) in enumerate(values):
            inner = self.of(type_, struct.path) if value is not None and value.startswith("{") else None
            if inner is not None and inner.aggregate and inner is not struct and self.doubtful(inner, value[1:-1]):
                return name
            if self.nested(type_, struct.path) and (value is None or value.startswith("{")) and any(v and self.may_throw(v) for _, _, v in values[k + 1:]):
                return name
        return None

    def typed(self, text):
        """Braces whose type is seen: where they open, and the name of the type."""
        for found in re.finditer(r"\b([A-Z]\w*)(<[^;{}()]*?>)?(\s+\w+)?\s*=?\s*\{", text):
            before = text[:found.start()].rstrip()
            if not re.search(r"(\b(struct|class|enum|union|namespace)|->)$", before):
                yield found.end() - 1, found.group(1)
        for function in re.finditer(r"\b([A-Z]\w*)\s+[\w:]+\([^;{}]*\)\s*(const\s*)?(override\s*)?\{", text):
            body = text[function.end():closing(text, function.end() - 1)]
            for found in re.finditer(r"\breturn\s*\{", body):
                yield function.end() + found.end() - 1, function.group(1)
        for found in re.finditer(r"\b(\w+)(\.|->)push_back\(\{", text):
            list_ = re.search(r"\bvector<([A-Z]\w*)>\s*&?\s*" + found.group(1) + r"\b", text)
            if list_:
                yield found.end() - 1, list_.group(1)

    def findings(self):
        for path, text in self.files.items():
            for at, type_ in self.typed(text):
                struct = self.of(type_, path)
                inside = text[at + 1:closing(text, at)]
                if struct is None or not struct.aggregate or ";" in re.sub(r"\{.*\}", "", inside, flags=re.S):
                    continue
                name = self.doubtful(struct, inside)
                if name is not None:
                    yield path, text.count("\n", 0, at) + 1, f"{type_}: '{name}'"


KNOWN = """struct In { std::string a; int b = 0; };
struct Out { In in; int x, y; };
struct Far { Out out; int z; };
struct Made { Made(In, int); In in; };
"""
BROKEN = ["Out o{{s, 1}, 2, f()};", "Out o = {{}, 2, f(3)};", "return g(Out{{s, 1}, 2, f()});", "Out o{.x = f()};", "Out o{.in = {.b = 2}, .x = 1, .y = f()};",
          "Far far{.out = {{s, 1}, 2, f()}};", "Out make() { return {{s, 1}, 2, f()}; }", "void fill(std::vector<Out>& all) { all.push_back({{s, 1}, f(), 2}); }"]
SOUND = ["Out o{In{s, 1}, 2, f()};", "Out o{{s, f()}, 2, 3};", "Out o{in, 2, f()};", "Out o{.in = In{s}, .x = f()};", "In i{s, f()};", "Made m{{s, 1}, f()};",
         "Out o{{s, 1}, 2, x.size()};", "Out o{{s, 1}, 2, 3};"]


def check_itself():
    for sources, finds in ((BROKEN, 1), (SOUND, 0)):
        for source in sources:
            found = list(Finder({"a.cpp": blanked(KNOWN + source)}).findings())
            if len(found) != finds:
                sys.exit(f"nested_aggregates: {source} has {len(found)} findings, not {finds}")


def main():
    check_itself()
    root, folders = pathlib.Path(sys.argv[1]), sys.argv[2:] or ["framework", "app", "plugins", "python", "bench", "tests"]
    files = {str(path.relative_to(root)): blanked(path.read_text(encoding="utf-8")) for folder in folders for path in sorted((root / folder).rglob("*"))
             if path.suffix in (".h", ".cpp", ".cu", ".cuh")}
    found = list(Finder(files).findings())
    for path, line, what in found:
        print(f"{path}:{line}: {what} may be destroyed twice by g++ 12 when a later initialiser throws: name its type, or compute first")
    print(f"{len(files)} files, {len(found)} findings")
    return 1 if found or not files else 0


if __name__ == "__main__":
    sys.exit(main())
