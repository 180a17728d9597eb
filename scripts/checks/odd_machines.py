"""The suite as other machines would run it."""
import os
import pathlib
import re
import subprocess

from . import common

# Preloaded: programs believe in as many cores as SEMFIELD_ODD_CORES says.
SHIM = r"""
#include <sched.h>
#include <cstdlib>
extern "C" int sched_getaffinity(pid_t, size_t size, cpu_set_t* set) noexcept {
  const size_t cores = std::strtoul(std::getenv("SEMFIELD_ODD_CORES"), nullptr, 10);
  CPU_ZERO_S(size, set);
  for (size_t core = 0; core < cores; ++core) CPU_SET_S(core, size, set);
  return 0;
}
"""
# Loops of the shell while the suite runs.
BUSY = 'for i in 1 2 3; do (while :; do :; done) & done; "$@"; code=$?; kill $(jobs -p); exit $code'
# Of this user's build: these write into it, or call an interpreter that may lie in this user's home.
OF_THE_USER = "^(docs_.*|out_of_tree|drill|tables|site.*)$"


class Absent(Exception):
    """This machine cannot have the condition."""


def need(there, why):
    if not there:
        raise Absent(why)


def condition(name, work):
    """Words before and behind ctest, and the environment."""
    if name in ("one_core", "two_cores"):
        count = 1 if name == "one_core" else 2
        cores = sorted(os.sched_getaffinity(0))[:count]
        need(len(cores) == count, "this machine has one core")
        return ["taskset", "-c", ",".join(map(str, cores))], [], {}
    if name == "sixteen_cores":
        shim = str(work / "shim.so")
        common.run(os.environ.get("CXX", "c++"), "-O1", "-shared", "-fPIC", "-x", "c++", "-o", shim, "-", input=SHIM)
        return [], [], {"LD_PRELOAD": shim, "SEMFIELD_ODD_CORES": "16"}
    if name == "another_user":
        need(os.geteuid() == 0, "only root can become another user")
        return (["setpriv", "--reuid", "65534", "--regid", "65534", "--clear-groups"], ["-E", OF_THE_USER],
                {"HOME": str(work / "tmp" / name)})
    if name == "german_locale":
        need(re.search("^de_DE.utf-?8$", common.run("locale", "-a"), re.I | re.M),
             "no locale de_DE.UTF-8 here; localedef -i de_DE -f UTF-8 de_DE.UTF-8")
        return [], [], {"LC_ALL": "de_DE.UTF-8"}
    if name == "odd_temporary_names":
        return [], [], {"TMPDIR": str(work / "tmp" / "a b's")}
    if name == "memory_as_disk":
        need(common.run("stat", "-f", "-c", "%T", "/dev/shm").strip() == "tmpfs", "no tmpfs at /dev/shm")
        folder = common.run("mktemp", "-d", "/dev/shm/odd_machines.XXXXXX").strip()
        return ["sh", "-c", '"$@"; code=$?; rm -rf "$TMPDIR"; exit $code', name], [], {"TMPDIR": folder}
    if name == "busy":
        return ["bash", "-c", BUSY, name], [], {}
    if name.startswith("isa_"):
        isa = name.removeprefix("isa_")
        flags = re.search("^flags.*: (.*)", pathlib.Path("/proc/cpuinfo").read_text(), re.M)[1].split()
        need(isa == "generic" or {"avx512": "avx512f"}.get(isa, isa) in flags, f"this CPU lacks {isa}")
        return [], [], {"SEMFIELD_ISA": isa}
    return [], [], {}


def build_oddly(work):
    """A build of this checkout in a folder of an odd name."""
    copy = work / "tmp" / "a b's" / "semfield"
    copy.mkdir(parents=True)
    files = "git ls-files -z --cached --others --exclude-standard"
    common.run("sh", "-c", f'{files} | xargs -0 cp --parents -t "$0"', copy, cwd=common.ROOT)
    common.run("cmake", "--preset", "release", cwd=copy)
    common.run("cmake", "--build", "--preset", "release", cwd=copy)
    return copy / "build" / "release"


def suite(name, build, filters, work):
    """Exit code of ctest under the condition, and what it printed; in an empty folder for its own files, so that the
    build may be somebody else's."""
    before, behind, environment = condition(name, work)
    build = build_oddly(work) if name == "odd_checkout" else build
    folder = pathlib.Path(environment.get("TMPDIR", work / "tmp" / name))
    for path in (work / name, folder):
        path.mkdir(parents=True, exist_ok=True)
        path.chmod(0o777)
    (work / name / "CTestTestfile.cmake").write_text(f'subdirs("{build}")\n')
    words = [*before, "ctest", "--test-dir", work / name, "--output-on-failure", "--timeout", "3600",
             "--parallel", str(os.cpu_count()), *filters, *behind]
    environment = {**os.environ, "TMPDIR": str(folder), "TEST_TMPDIR": str(folder), **environment}
    done = subprocess.run(words, env=environment, capture_output=True, text=True, errors="replace")
    (work / f"{name}.log").write_text(done.stdout + done.stderr)
    return done.returncode, done.stdout


def odd_machines(words):
    """Runs the suite as other machines would: one core, sixteen, another user, another locale, odd temporary folders, a
busy machine, every instruction set. odd_checkout builds in a folder of an odd name, and so is asked for by name.

One line a condition, names of failed tests below it. The last line is `odd_machines: conditions=... failed=...
absent=...`."""
    parser = common.parser_of(odd_machines)
    parser.add_argument("conditions", nargs="*", metavar="CONDITION", help="default: all but odd_checkout")
    parser.add_argument("-R", dest="regex", metavar="REGEX", help="of tests, for ctest")
    parser.add_argument("--keep", metavar="FOLDER", help="leave the logs there")
    common.add_build(parser)
    options = parser.parse_args(words)
    build = options.build.resolve()
    if not (build / "CTestTestfile.cmake").exists():
        raise common.Failed(f"{build} is no build with tests; build it with ./scripts/test")
    isas = re.search("^SEMFIELD_ISA:[^=]*=(.+)$", (build / "CMakeCache.txt").read_text(), re.M)
    known = ["one_core", "two_cores", "sixteen_cores", "another_user", "german_locale", "odd_temporary_names",
             "memory_as_disk", "busy", *(f"isa_{isa}" for isa in (isas[1] if isas else "generic").split(";"))]
    if not set(options.conditions) <= {*known, "odd_checkout"}:
        parser.error(f"the conditions are {', '.join(known)}, odd_checkout")
    ran = failed = absent = 0
    with common.work_folder(options.keep) as work:
        work.chmod(0o755)
        for name in options.conditions or known:
            try:
                code, text = suite(name, build, ["-R", options.regex] if options.regex else [], work)
            except Absent as reason:
                absent += 1
                print(f"{name}: not run: {reason}", flush=True)
                continue
            except common.Failed as error:
                code, text = 1, str(error)
            ran, failed = ran + 1, failed + (code != 0)
            passed = re.search(r"tests passed.* out of (\d+)", text)
            faults = re.findall(r"^\t *(\d+ - .*)", text, re.M) or [text[-300:]]
            print(f"{name}: " + ("\n    ".join(["failed", *faults]) if code else f"{passed[1]} tests passed"),
                  flush=True)
    print(f"odd_machines: conditions={ran} failed={failed} absent={absent}")
    return 1 if failed else 0
