#!/usr/bin/env python3
"""What pages and messages point at exists: citations, folders, verbs and their options, exit codes, keys that `--set`
takes; configurations are read. docs_check.py looks at links and words.

SEMFIELD_DOCS names the folder with the pages that the build makes."""

import re
import shutil

from program import *

BUILT = pathlib.Path(os.environ["SEMFIELD_DOCS"])
# Where a plugin of each kind stands in a configuration.
SLOTS = {
    "Encoders": "passes.N.position passes.N.direction passes.N.semantic.position heads.N.branch.position",
    "Fields": "passes.N.field passes.N.semantic.field heads.N.branch.field", "Samplers": "passes.N.sampler",
    "Datasets": "scene", "Heads": "heads.N", "Losses": "losses.N", "Label readers": "scene.labels.from",
    "Degradations": "scene.labels.degrade.N", "Groupings": "objects.method",
}
SECTIONS = "scene|semantics|rendering|passes|train|runtime|report|fuse|propagate|limits"


@functools.cache
def page(path):
    return ((SOURCE / path) if (SOURCE / path).exists() else BUILT / path).read_text(encoding="utf-8")


@functools.cache
def all_pages():
    found = [*SOURCE.glob("*.md"), *(path for folder in ("docs", "plugins", "scenes", "tests", "studies")
                                     for path in (SOURCE / folder).rglob("*.md"))]
    return sorted(path.relative_to(SOURCE).as_posix() for path in found)


def blocks():
    """Page, what stands behind the fence, and text of every block."""
    for path in all_pages():
        parts = re.split(r"^```(.*)\n", page(path), flags=re.M)
        assert len(parts) % 4 == 1, f"{path}: a fenced block has no end"
        for info, text in zip(parts[1::4], parts[2::4]):
            yield path, info, text


def found_in_tree(pattern):
    """What the pattern captures in the texts of the tree, with a file each that has it."""
    folders = "framework plugins app tests studies scripts configs docs cmake scenes".split()
    files = [path for folder in folders for path in (SOURCE / folder).rglob("*")] + list(SOURCE.glob("*"))
    return {text: path for path in files
            if path.suffix in (".h", ".cpp", ".cu", ".py", ".md", ".yaml", ".cmake", ".txt", "") and path.is_file()
            for text in re.findall(pattern, path.read_text(encoding="utf-8", errors="replace"))}


class Pages(ProgramCase):
    def verbs_of(self, help):
        return re.findall(r"\n  ([a-z-]+) ", help.partition("\nVerbs:")[2])

    @functools.cache
    def help(self, *words):
        return self.ok([*words, "--help"]).out

    def whole_help(self, verb):
        """Of a verb and of the words below it."""
        return self.help(verb) + "".join(self.help(verb, word) for word in self.verbs_of(self.help(verb)))

    def test_every_citation_resolves_and_every_entry_is_cited(self):
        entries = set(re.findall(r"@[a-z]+\{([A-Za-z0-9]+),", page("docs/reference/references.bib")))
        # Keys cited as [Zhi21], [Zhi21 Eq. 3] or [Zhi21, Sec. 2].
        cited = found_in_tree(r"\[([A-Z][A-Za-z]{2,}[0-9]{1,4})(?=[\],; :])")
        self.assertGreaterEqual(len(cited), 12)
        self.assertEqual({key: path for key, path in cited.items() if key not in entries}, {})
        self.assertEqual(entries - cited.keys(), set(), "nothing cites them")

    def test_sources_name_documents_that_exist(self):
        """What sources, configurations, scripts and messages call docs/... is there."""
        named = found_in_tree(r"(?:^|[^A-Za-z0-9_/.-])(docs/[A-Za-z0-9_/.-]*[A-Za-z0-9_])")
        self.assertGreaterEqual(len(named), 15)
        self.assertEqual({name: path for name, path in named.items()
                          if not (SOURCE / name).exists() and not (BUILT / name).exists()}, {})

    def test_every_folder_of_the_framework_has_its_place(self):
        folders = [path.name for path in (SOURCE / "framework").iterdir() if path.is_dir()]
        self.assertGreaterEqual(len(folders), 8)
        for name in folders:
            self.has(page("ARCHITECTURE.md"), f"\n  {name}/ ", f"\n| `{name}` |")  # the tree, the table of floors

    def test_tables_are_put_where_a_page_has_their_mark(self):
        """The built pages have every plugin's table and no mark where one belongs."""
        mark = re.compile(r"\n<!-- (parameters|sections|table [^>]*|sources) -->\n")
        self.has(page("docs/reference/plugins.md"), "### `hash_grid`")
        self.has((BUILT / "plugins/encoders/hash_grid/README.md").read_text(), "| `levels` | int |")
        self.has((BUILT / "docs/reference/configuration.md").read_text(), "### `train`")
        marked = [path for path in all_pages() if mark.search(page(path))]
        self.assertGreaterEqual(len(marked), 20)
        self.assertEqual([path for path in marked if mark.search((BUILT / path).read_text())], [])

    def test_every_function_of_a_verb_is_listed_and_every_verb_has_its_function(self):
        """Every function verb_NAME of app/verbs, "config_check", and every verb of the help written that way."""
        functions = {verb for path in (SOURCE / "app/verbs").glob("*.cpp")
                     for verb in re.findall(r"\nVerb verb_(\w+)\(\) \{", path.read_text())}
        verbs = self.verbs_of(self.help())
        words = [f"{verb}_{word}" for verb in verbs for word in self.verbs_of(self.help(verb))]
        self.assertEqual({name.replace("-", "_") for name in verbs + words}, functions)

    def test_every_verb_and_option_has_a_sentence(self):
        """One without leaves its line of the help with blanks at the end."""
        verbs = self.verbs_of(self.help())
        self.assertGreaterEqual(len(verbs), 15)
        for verb in verbs:
            self.assertEqual(re.findall(r"\n(  \S[^\n]*) (?=\n)", self.whole_help(verb)), [], verb)

    def test_exit_codes_are_those_of_the_program(self):
        listed = re.findall(r"\n\| ([0-9]+)[, |]", page("docs/reference/command_line.md"))
        have = re.findall(r"\n  [a-z_]+ = ([0-9]+),", page("framework/core/error.h"))
        self.assertEqual(set(listed), {*have, "0", "130"})

    def test_shell_blocks_use_real_options(self):
        """Every command line in a shell block of a page names a verb and options that exist."""
        checked = 0
        for path, info, text in blocks():
            for line in re.findall(r"^semfield [^\n#]*", text, re.M) if info == "sh" else ():
                verb = line.split()[1]
                if verb.startswith("-"):
                    self.has(self.help(), verb)
                    continue
                help = self.whole_help(verb) + self.help()
                self.assertIn(f"Usage: semfield {verb}", help, f"{path}: {line}")
                for option in re.findall("--[a-z][a-z-]*", line):
                    checked += 1
                    self.assertIn(f"{option} ", help, f"{path}: {line}")
        self.assertGreaterEqual(checked, 5)

    def test_every_yaml_block_is_read(self):
        """One marked `yaml` is a whole configuration, saved in configs/ as it or the text around it says."""
        shutil.copytree(SOURCE / "configs", self.dir / "configs", copy_function=shutil.copyfile)
        whole = [(path, text) for path, info, text in blocks()
                 if info == "yaml" or info.startswith("yaml file=configs/")]
        self.assertGreaterEqual(len(whole), 4)
        for path, text in whole:
            with self.subTest(path):
                self.ok(["config", "check", self.write("configs/block.yaml", text)])


class Keys(ProgramCase):
    """Every key that a message or a page names is one that `--set` takes; an index of a list is N:
    "passes.N.sampler.samples"."""

    @classmethod
    def setUpClass(cls):
        # By convention every dataset of files has these, or those that can say so.
        cls.keys = {*"scene.root scene.file scene.classes scene.type scene.unknown_labels scene.masks".split(),
                    "scene.least_confidence", "train.schedule.legs"}
        cls.datasets = collections.defaultdict(set)
        cls.keys |= {*"name base_dir plugins include overrides passes passes.N passes.N.name passes.N.like heads losses".split()}
        for _, section, params in cls.tables("configuration.md"):
            cls.add(section.replace("[]", ".N"), params, cls.keys)
        for kind, name, params in cls.tables("plugins.md"):
            for slot in SLOTS[kind].split():
                cls.add(slot, [("type", "text"), *params], cls.datasets[name] if slot == "scene" else cls.keys)
        cls.keys |= set.intersection(*cls.datasets.values())
        cls.everywhere = cls.keys.union(*cls.datasets.values())
        # Codes look like keys; the build writes this page from the sources.
        cls.codes = set(re.findall(r"\n\| `([a-z0-9_.]+)` \|", page("docs/reference/codes.md")))

    @classmethod
    def tables(cls, name):
        """Heading, name and parameters with their types, of each table that the build writes into a page."""
        text = (BUILT / "docs/reference" / name).read_text(encoding="utf-8")
        for part in re.split(r"^## ", text, flags=re.M):
            for one in re.split(r"^### `", part, flags=re.M)[1:]:
                yield part.partition("\n")[0], one.partition("`")[0], re.findall(r"^\| `(\w+)` \| ([a-z ]+) \|", one, re.M)

    @classmethod
    def add(cls, path, params, to):
        words = path.split(".")
        to |= {".".join(words[:i + 1]) for i in range(len(words))}
        for name, type in params:
            to |= {f"{path}.{name}"} | ({f"{path}.{name}.N"} if type.startswith("list") else set())
        if path.startswith("passes.N.semantic") and not path.startswith("passes.N.semantic.N"):  # or a list of them
            cls.add(path.replace("semantic", "semantic.N"), params, to)

    @functools.cache
    def literals(self):
        """Place, dataset whose keys count besides the framework's, and text."""
        found = []
        for path in (path for top in ("app", "framework", "plugins") for path in (SOURCE / top).rglob("*.*")):
            if path.suffix not in (".cpp", ".h") or path.name.endswith(("_test.cpp", "_sample.cpp")):
                continue
            for number, line in enumerate(path.read_text().splitlines(), 1):
                if "#include" not in line:
                    texts = re.findall(r'"((?:[^"\\]|\\.)*)"', line.partition("// ")[0])
                    found += ((f"{path}:{number}", path.parent.name, text) for text in texts)
        return found

    def known(self, key, dataset):
        return key in self.keys or key in self.datasets.get(dataset, ())

    def test_every_key_of_a_message_is_one_that_set_takes(self):
        self.assertGreater(len(self.codes), 300)
        self.assertEqual(self.codes & self.everywhere, set(), "a code is a key, too")
        key = re.compile(rf"(?<![a-zA-Z0-9_./<-])((?:{SECTIONS}|labels)\.[a-z_N0-9]+(?:\.[a-z_N0-9]+)*)(?![/a-z])")
        file = re.compile(r".*\.(json|html|h|yaml|yml|csv|tsv|sfpack|png|zip)")
        seen = 0
        for place, dataset, text in self.literals():
            # A setting of the program's own is not for a reader.
            if re.fullmatch(r"[a-z_.0-9]+=\S*", text) or text in self.codes:
                continue
            for name in key.findall(text):
                name = re.sub(r"\.[0-9]+|\.main", ".N", name)  # a pass by its number or its usual name
                if not file.fullmatch(name):
                    seen += 1
                    self.assertTrue(self.known(name, dataset), f"{place}: no key '{name}': {text}")
        self.assertGreater(seen, 50, "messages name keys")

    def test_every_literal_that_looks_like_a_code_is_listed(self):
        """cmake/make_pages.py finds codes by what is before them: what looks like one of their areas is a code, a key
        or a file."""
        areas = {code.partition(".")[0] for code in self.codes}
        for place, dataset, text in self.literals():
            if (re.fullmatch(r"[a-z0-9_]+(\.[a-z0-9_]+){1,3}", text) and text.partition(".")[0] in areas
                    and text not in self.codes and not re.fullmatch(r".*\.(yaml|yml|csv|html|json|zip|ply|glb|npz)", text)):
                self.assertTrue(self.known(text, dataset), f"{place}: {text}")

    def test_no_remedy_names_a_key_of_the_scene_without_its_path(self):
        bare = {key.rpartition(".")[2] for key in self.everywhere if key.startswith("scene.")}
        for place, _, text in self.literals():
            for name in re.findall(r"(?:set|give|raise|lower|drop|change|check) ([a-z]+(?:_[a-z]+)+)\b", text):
                self.assertFalse(name in bare, f"{place}: '{name}' without its path: {text}")

    def test_every_key_of_a_page_is_one_that_set_takes(self):
        """Code spans that begin with a section's name: `passes.0.sampler.samples`, `scene.split: paper`."""
        seen = 0
        for path in all_pages():
            if path in ("CHANGELOG.md", "docs/decisions.md"):  # have keys of earlier versions
                continue
            for key in re.findall(rf"`((?:{SECTIONS}|losses)(?:\.[A-Za-z_N0-9]+)+)(?:[=:][^`]*)?`", page(path)):
                key = re.sub(r"^passes\.[a-z_0-9]+", "passes.N", re.sub(r"\.[0-9]+(?=\.|$)", ".N", key))
                if re.fullmatch(r".*\.(json|html|h|cpp|yaml|md|csv|py|npz)", key) or key in self.codes:
                    continue
                seen += 1
                self.assertTrue(key in self.everywhere, f"{path}: no key '{key}'")
        self.assertGreater(seen, 100, "pages name keys")


if __name__ == "__main__":
    main()
