#!/usr/bin/env python3
"""The floors of the house: which file may include what, who names plugins, and what the text of sources may hold.

rules_test.py ROOT [OBJECTS]: OBJECTS lists the object files of the kernels that exist once per instruction set.
"""

import functools
import pathlib
import posixpath
import re
import subprocess
import sys
import unittest

ROOT = pathlib.Path(sys.argv[1])
OBJECTS = sys.argv[2] if len(sys.argv) > 2 else None
SOURCES = (".h", ".cpp", ".cu", ".cuh")

# A folder and those that it may include. Folders inside a folder stand on its floor, but for those that are named.
GROUND = {"core", "compute"}
SCENE = GROUND | {"config", "formats", "scene/classes", "scene"}
LOADING = SCENE | {"scene/survey", "scene/loading"}
MODEL = SCENE | {"plugin", "model/losses", "model/optim", "model"}
EXECUTION = MODEL | {"execution/ranks", "execution"}
SETTINGS = EXECUTION | {"scene/survey", "scene/loading", "labels", "model/optim", "config/settings"}
TRAIN = SETTINGS | {"eval", "train"}
FLOORS = {
    "core": {"core"},
    "execution/ranks": {"core", "execution/ranks"},
    "compute": GROUND,
    "config": GROUND | {"config"},
    "formats": GROUND | {"config", "formats"},
    "scene/classes": GROUND | {"config", "formats", "scene/classes"},
    "scene": SCENE,
    "scene/survey": SCENE | {"scene/survey"},
    "scene/loading": LOADING,
    "plugin": SCENE | {"plugin"},
    "labels": LOADING | {"plugin", "labels"},
    "model/losses": SCENE | {"plugin", "model/losses"},
    "model/optim": GROUND | {"config", "model/optim"},
    "model": MODEL,
    "execution": EXECUTION,
    "cuda": EXECUTION | {"cuda"},
    "eval": EXECUTION | {"scene/survey", "scene/loading", "labels", "eval"},
    "surface": EXECUTION | {"scene/survey", "scene/loading", "labels", "eval", "surface"},
    "config/settings": SETTINGS,
    "train": TRAIN,
    "eval/report": TRAIN | {"eval/report"},
    "surface/fuse": TRAIN | {"surface", "surface/fuse"},
    "surface/objects": TRAIN | {"surface", "surface/objects"},
    "surface/mesh": SETTINGS | {"eval", "surface", "surface/mesh"},
    "labels/serve": TRAIN | {"surface", "labels/serve"},
    "testkit": set(),  # includes all of them
}
# Libraries with exactly one user, and those that may not enter a header.
ONLY = {
    "yaml-cpp/": "framework/config/compose.cpp",
    "yaml.h": "framework/config/compose.cpp",
    "mpi.h": "framework/execution/ranks/mpi/mpi_ranks.cpp",
    "nccl.h": "framework/cuda/nccl/nccl.cpp",
    "OpenImageIO/": "framework/formats/image_formats.cpp",
    "tiny_obj_loader.h": "plugins/datasets/obj_room/mesh_io.cpp",
    "omp.h": "framework/compute/parallel.cpp",
}
NOT_IN_HEADERS = ("Eigen/", "nlohmann/", "CLI/", "fmt/", "embree")
PLUGINS = ("encoders/", "fields/", "samplers/", "datasets/", "label_readers/", "degradations/", "groupings/", "fused/",
           "plugins/")
SDK = {"core", "compute", "plugin"}
OF_SCENES = {"formats", "scene/classes", "scene", "scene/survey", "scene/loading"}


def files_under(folder, endings=SOURCES):
    """The text of every file under the project's `folder` whose name has one of the endings, by path."""
    found = (path for path in sorted((ROOT / folder).rglob("*")) if path.name.endswith(endings) and path.is_file())
    return {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in found}


@functools.cache
def all_sources():
    folders = ("framework", "plugins", "app", "tests")
    return {path: text for folder in folders for path, text in files_under(folder).items()}


def includes_of(text):
    """Line and target of each include."""
    return [(text.count("\n", 0, at.start(1)) + 1, at[1])
            for at in re.finditer(r'^[ \t]*#[ \t]*include[^"<\n]*["<]([^">\n]*)[">]', text, re.M)]


def folder_of(path):
    """The folder of the framework whose floor `path` stands on: one inside a folder where it has a floor of its own."""
    inner = "/".join(path.split("/")[:2])
    return inner if path.count("/") > 1 and inner in FLOORS else path.split("/")[0]


def forbidden_library(path, target):
    for library, user in ONLY.items():
        if target.startswith(library) and path != user:
            return f"only {user} may include {library}"
    if path == "app/app_context.h" and target.startswith("nlohmann/"):
        return ""  # what every --json prints; no plugin sees the program's headers
    if target.startswith(NOT_IN_HEADERS) and path.endswith(".h"):
        return f"{target} may be included by .cpp files only"
    if target.startswith(("cuda", "cublas")) and not path.endswith((".cu", ".cuh")) and "cuda" not in path:
        return "CUDA headers belong to CUDA files"
    return ""


def forbidden_in_framework(path, target):
    folder, other = folder_of(path), folder_of(target)
    if target.startswith(PLUGINS):
        return "the framework includes no plugin"
    if target.startswith(("app/", "tests/")):
        return "the framework includes neither the application nor tests"
    if folder not in FLOORS:
        return f"framework/{folder} stands on no floor of the table"
    if folder == "model/losses" and other == "cuda" and path.endswith("_cuda.cu"):
        return ""  # kernels of a loss lie in its folder
    if folder != "testkit" and other in FLOORS and other not in FLOORS[folder]:
        return f"{folder} may not include {other}"
    return ""


def forbidden_in_plugin(inside, target):
    """`inside` = "encoders/hash_grid/hash_grid.h"."""
    kind, other = inside.split("/")[0], folder_of(target)
    if target.startswith("/".join(inside.split("/")[:2]) + "/"):
        return ""
    if target.startswith(PLUGINS):
        return "" if kind == "fused" and target.endswith("_math.h") else "a plugin includes no other plugin"
    if other not in FLOORS or "/" not in target or other in SDK or target == "config/params.h":
        return ""
    of_labels = kind in ("label_readers", "degradations")
    if (other in OF_SCENES or target == "config/config_tree.h") and (kind == "datasets" or of_labels):
        return ""
    if other == "labels" and of_labels or other == "cuda" and inside.endswith((".cu", ".cuh")):
        return ""
    if kind == "fused" and target == "model/encoded_field.h":
        return ""
    more = " and the folders of scenes, config/config_tree.h" if kind == "datasets" or of_labels else ""
    return f"a plugin sees core, compute, config/params.h, plugin{more} alone"


def why_forbidden(path, target):
    """"" when the file at `path` may include `target`, else the rule that forbids it."""
    why = forbidden_library(path, target)
    # A test in the folder of a plugin or a term of the loss may use the testkit and whatever else it needs to feed it.
    if why or path.endswith(("_test.cpp", "_sample.cpp")) or "/tests/" in path:
        return why
    top, _, rest = path.partition("/")
    if top == "framework":
        return forbidden_in_framework(rest, target)
    if top == "plugins":
        return forbidden_in_plugin(rest, target)
    if top == "app" and target.startswith(PLUGINS):
        return "the application knows plugins by their names in the registry alone"
    return "the application does not use the testkit" if top == "app" and target.startswith("testkit/") else ""


class Includes(unittest.TestCase):
    def test_every_file_keeps_to_its_floor(self):
        for folder, at_least in (("framework", 100), ("plugins", 50), ("app", 1), ("tests", 20)):
            files = files_under(folder).items()
            found = [(path, line, target) for path, text in files for line, target in includes_of(text)]
            self.assertGreaterEqual(len(found), at_least, f"hardly any include was read under {folder}")
            for path, line, target in found:
                with self.subTest(f"{path}:{line} includes {target}"):
                    self.assertEqual(why_forbidden(path, target), "")

    def test_known_violations_are_forbidden(self):
        """One of each kind."""
        for path, target in (("framework/core/files.cpp", "compute/parallel.h"),
                             ("framework/scene/camera.cpp", "tiny_obj_loader.h"),
                             ("framework/plugin/encoder.h", "Eigen/Core"),
                             ("framework/execution/pipeline.cpp", "encoders/hash_grid/hash_grid.h"),
                             ("framework/model/losses/depth/depth.cpp", "cuda/kernels/device_code.cuh"),
                             ("framework/train/trainer.cpp", "testkit/laws.h"),
                             ("framework/surprise/new.cpp", "core/view.h"),
                             ("plugins/encoders/hash_grid/hash_grid.cpp", "encoders/frequency/frequency_math.h"),
                             ("plugins/encoders/hash_grid/hash_grid.cpp", "scene/scene.h"),
                             ("plugins/encoders/hash_grid/hash_grid_kernels.h", "cuda_runtime.h"),
                             ("plugins/losses/mine/mine.cpp", "model/losses/depth/depth.h"),
                             ("app/main.cpp", "encoders/hash_grid/hash_grid.h")):
            with self.subTest(path=path, target=target):
                self.assertNotEqual(why_forbidden(path, target), "")

    def test_includes_are_read_from_text(self):
        text = '// #include "no.h"\n#include <a/b.h>\n  #  include "c.h"\nint x;\n#define X "y"\n'
        self.assertEqual(includes_of(text), [(2, "a/b.h"), (3, "c.h")])


# Framework and program name no plugin: what a plugin is and takes comes from its interface.

# English words too: they count where they stand for the plugin, as the whole of a text or behind `type:`.
WORDS = {"frequency", "identity", "importance", "packed", "propagation", "stratified"}


def lines_naming(text, plugin):
    """Lines of `text` that name the plugin."""
    alone = rf"(?<!\w){plugin}(?!\w)"
    name = rf"(?<=[\"']){plugin}(?=[\"'])|(?<=type[:=]) *{plugin}(?!\w)" if plugin in WORDS else alone
    if "_" in plugin:
        name += rf"|(?<!\w){''.join(part.capitalize() for part in plugin.split('_'))}(?!\w)"
    return [text.count("\n", 0, at.start()) + 1 for at in re.finditer(name, text, re.A)]


class PluginNames(unittest.TestCase):
    def test_framework_and_program_name_no_plugin(self):
        # A label reader is named as the file format, which others write; so are the layouts that `pack` writes. COLMAP is a
        # program too, which these run.
        names = [path.name for path in (ROOT / "plugins").glob("*/*")
                 if path.is_dir() and path.parent.name not in ("label_readers", "fused")]
        files = {**files_under("framework"), **files_under("app")}
        self.assertGreater(len(names), 8)
        self.assertGreater(len(files), 200)
        for path, text in files.items():
            may_name = {"colmap"} if path.startswith(("framework/scene/loading/capture/", "framework/scene/loading/colmap_")) else \
                {"packed", "replica"} if path in ("app/verbs/scenes.cpp", "app/command_line.cpp") else \
                {"hash_grid", "occupancy_grid"} if path == "app/verbs/about.cpp" else set()  # examples of `plugins show`
            for name in names:
                for line in [] if name in may_name else lines_naming(text, name):
                    with self.subTest():
                        self.fail(f"{path}:{line} names the plugin '{name}'")

    def test_a_name_is_found_in_texts_comments_and_classes(self):
        self.assertEqual(lines_naming('a\nb "tiny_mlp" c', "tiny_mlp"), [2])
        self.assertEqual(len(lines_naming("// fitted to tiny_mlp, TinyMlp", "tiny_mlp")), 2)
        self.assertEqual(lines_naming("my_tiny_mlps, tiny_mlp_x", "tiny_mlp"), [])
        self.assertEqual(len(lines_naming("{type: packed} 'packed' \"packed\" type=packed", "packed")), 4)
        self.assertEqual(lines_naming("rows are packed; packed(x)", "packed"), [])


# A file that calls the standard library includes the header, or includes one of ours that does: which headers bring
# others along differs from library to library, and from version to version.
CALLS = {
    "algorithm": "sort( stable_sort( nth_element( partial_sort( any_of( all_of( none_of( find_if( count( count_if( "
                 "clamp( reverse( unique( remove_if( lower_bound( upper_bound( max_element( min_element( minmax_element( "
                 "transform( rotate( equal( fill( fill_n( copy( copy_n( binary_search( is_sorted( "
                 "ranges::sort( max({ min({ find(",
    "numeric": "accumulate( iota( inner_product( partial_sum( midpoint( gcd(",
    "cmath": "sqrt( exp( log( log2( pow( floor( ceil( lround( isfinite( isnan( fma(",
    "cstring": "memcpy( memset( memcmp( memmove( strlen( strcmp( strerror(",
    "cstdlib": "getenv( system( malloc( free( strtod( strtol( _Exit(",
    "cstdio": "printf( fprintf( snprintf( fopen( fclose( fputs( rename(",
    "limits": "numeric_limits<",
    "functional": "function<",
    "memory": "unique_ptr< shared_ptr< make_unique< make_shared<",
    "atomic": "atomic<",
    "mutex": "mutex lock_guard< unique_lock<",
}


@functools.cache
def included_by(path):
    """What a file includes, itself or through files of ours."""
    found, files = set(), all_sources()
    for _, target in includes_of(files[path]):
        roots = (posixpath.dirname(path) + "/", "framework/", "plugins/", "")
        ours = [root + target for root in roots if root + target in files]
        found.update(ours or [target])
        for one in ours:
            found |= included_by(one)
    return found


class StandardHeaders(unittest.TestCase):
    def test_are_included_by_those_who_call_them(self):
        self.assertGreater(len(all_sources()), 300)
        calls = {header: re.compile("std::(?:" + "|".join(re.escape(one) for one in words.split()) + ")")
                 for header, words in CALLS.items()}
        for path, text in all_sources().items():
            for header, call in calls.items():
                at = call.search(text)
                if at and header not in included_by(path):
                    with self.subTest():
                        self.fail(f"{path} has {at[0]} and no #include <{header}>")


# Rules on the text of sources: the CUDA switch, fast math, state.

# Flags that let the compiler believe that there is no NaN: they would delete every finite check.
FAST_MATH = re.compile("|".join(map(re.escape, (
    "-ffast-math", "-Ofast", "-funsafe-math", "-fassociative-math", "-freciprocal-math", "-ffinite-math-only",
    "-fno-honor-nans", "-fno-honor-infinities", "-fno-signed-zeros", "-ffp-model=fast", "-fp-model fast", "/fp:fast",
    "use_fast_math", "-cl-fast-relaxed-math", 'optimize("fast-math'))))
# Lines that give a process or a thread something that changes: thread_local, variables g_... and t_..., and statics of
# functions that are no constants.
STATE = re.compile(r"^(\s*(static )?thread_local\b.*"
                   r"|(static |volatile )?[A-Za-z_][\w:<>, ]*[ &*]+[gt]_\w+(\{.*|;.*| = .*)"
                   r"|\s*static (?!const\b|constexpr\b|inline\b|thread_local\b)[\w:<>, ]+[ &*]+(const )?\w+"
                   r"(;| =|\{).*)$", re.M)


class SourceRules(unittest.TestCase):
    def test_words_of_few_files(self):
        # One file of the suite names the flags because it searches for them in the commands of a build.
        for word, files in ((re.compile("__CUDACC__"), ["framework/core/view.h"]),
                            (re.compile("#pragma omp"), ["framework/compute/parallel.cpp"]),
                            (FAST_MATH, ["tests/numerics/backend_cases.cpp"])):
            self.assertEqual([path for path, text in all_sources().items() if word.search(text)], files, word.pattern)

    def test_a_header_opens_with_a_sentence(self):
        headers = {path: text for path, text in all_sources().items() if path.endswith(".h")}
        self.assertEqual([path for path, text in headers.items() if not text.startswith("//")], [])

    def test_state_of_the_process_is_listed(self):
        page = (ROOT / "docs/reference/inside.md").read_text(encoding="utf-8")
        section = page.split("## State of the process")[1].split("\n## ")[0]
        rows = (row.split(" | ")[0] for row in section.splitlines() if row.startswith("| `"))
        listed = {name for row in rows for name in re.findall(r"`(\w+/\w+\.\w+)`", row)}
        found = {"/".join(path.split("/")[-2:]): at[0] for path, text in all_sources().items()
                 if not path.startswith("tests/") and not path.endswith("_test.cpp") and "/tests/" not in path
                 for at in STATE.finditer(text)}
        self.assertEqual(listed, set(found), found)

    def test_state_is_recognised(self):
        for line in ("Workspace g_scratch;", "thread_local bool t_inside = false;", "  static bool on = true;",
                     "  static Library* const only = new Library;", "volatile std::sig_atomic_t g_save = 0;",
                     "  static Teams& all = *new Teams;", "thread_local KeptBlocks* blocks_of_call = nullptr;",
                     "  static std::map<int, int> cache;"):
            self.assertRegex(line, STATE)
        for line in ("  static const int quota = cpu_quota();", "  static constexpr int kBits = 3;",
                     "  static std::string file_name(std::int64_t step);", "  g_save = 1;",
                     "  static void add(Sums& sums) {", "  const double g_at = f(1);"):
            self.assertNotRegex(line, STATE)

    def test_no_build_file_asks_for_fast_math(self):
        endings = ("CMakeLists.txt", ".cmake", ".cmake.in", ".json", ".yml", ".yaml", ".sh")
        files = {path: text for folder in ("cmake", "framework", "plugins", "app", "tests", "scripts", ".ci")
                 for path, text in files_under(folder, endings).items()}
        for script in ("scripts/setup", "scripts/test", "scripts/demo", "CMakeLists.txt", "CMakePresets.json"):
            files[script] = (ROOT / script).read_text(encoding="utf-8")
        self.assertGreater(len(files), 10)
        self.assertEqual([path for path, text in files.items() if FAST_MATH.search(text)], [])
        for flags in ("add_compile_options(-O3 -ffast-math)", '"CMAKE_CUDA_FLAGS": "--use_fast_math"'):
            self.assertRegex(flags, FAST_MATH)
        self.assertNotRegex("-O3 -ffp-contract=off -fno-math-errno", FAST_MATH)


@unittest.skipIf(OBJECTS is None, "this build has kernels for one instruction set")
class KernelSymbols(unittest.TestCase):
    def test_no_function_is_shared_between_instruction_sets(self):
        """A function that a kernel file shares with others (an inline one that was not inlined, an instantiated
        template of the standard library) is kept once by the linker, perhaps the copy of an instruction set that the CPU lacks:
        the program would die on machines that no developer has."""
        objects, symbols = [one for one in pathlib.Path(OBJECTS).read_text().splitlines() if one], 0
        for one in objects:
            words = ["nm", "--demangle", "--defined-only", one]
            said = subprocess.run(words, capture_output=True, text=True, check=True)
            lines = [line for line in said.stdout.splitlines() if len(line) >= 20]
            symbols += len(lines)
            # "0000000000000000 W name": W are shared functions, u shared variables (V, types, hold no code).
            self.assertEqual([line for line in lines if line[17] in "Wu" and "semfield::isa_" not in line], [], one)
        self.assertGreater(len(objects), 0)
        self.assertGreater(symbols, len(objects))


if __name__ == "__main__":
    unittest.main(argv=sys.argv[:1])
