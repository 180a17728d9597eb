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
  CPU_ZERO_S(size, set);
  const size_t cores = std::strtoul(std::getenv("SEMFIELD_ODD_CORES"), nullptr, 10);
  for (size_t core = 0; core < cores; ++core) CPU_SET_S(core, size, set);
  return 0;
}
"""


class Absent(Exception):
    """This machine cannot have the condition."""


class Conditions:
    """A method per condition, which runs the suite and gives ctest's exit code; what it prints is in CONDITION.log."""

    def __init__(self, build, filters, work):
        self.build, self.filters, self.work = build, filters, work

    def suite(self, name, *command, build=None, folder=None, without=(), **environment):
        """ctest under a command, in an empty folder for its own files, so that the build may be somebody else's."""
        folder = folder or self.work / "tmp" / name
        for path in (self.work / name, folder):
            path.mkdir(parents=True, exist_ok=True)
            path.chmod(0o777)
        (self.work / name / "CTestTestfile.cmake").write_text(f'subdirs("{build or self.build}")\n')
        words = [*command, "ctest", "--test-dir", self.work / name, "--output-on-failure", "--timeout", "3600",
                 "--parallel", str(os.cpu_count()), *self.filters, *without]
        environment = {**os.environ, "TMPDIR": str(folder), "TEST_TMPDIR": str(folder), **environment}
        with open(self.work / f"{name}.log", "w", encoding="utf-8") as log:
            return subprocess.run(words, env=environment, stdout=log, stderr=log).returncode

    def cores(self, name, count):
        mine = sorted(os.sched_getaffinity(0))[:count]
        if len(mine) < count:
            raise Absent(f"this machine has {len(mine)} cores")
        return self.suite(name, "taskset", "-c", ",".join(map(str, mine)))

    def one_core(self):
        return self.cores("one_core", 1)

    def two_cores(self):
        return self.cores("two_cores", 2)

    def sixteen_cores(self):
        shim = self.work / "shim.so"
        common.run(os.environ.get("CXX", "c++"), "-std=c++20", "-O1", "-shared", "-fPIC", "-x", "c++", "-o", shim, "-",
                   input=SHIM)
        return self.suite("sixteen_cores", LD_PRELOAD=str(shim), SEMFIELD_ODD_CORES="16")

    def another_user(self):
        if os.geteuid() != 0:
            raise Absent("only root can become another user")
        # Of this user's build: these write into it, or call an interpreter that may lie in this user's home.
        own = "^(docs_.*|out_of_tree|drill|tables|mesh_picture|site.*)$"
        return self.suite("another_user", "setpriv", "--reuid", "65534", "--regid", "65534", "--clear-groups",
                          without=("-E", own), HOME=str(self.work / "tmp" / "another_user"))

    def german_locale(self):
        if not re.search("^de_DE.utf-?8$", common.run("locale", "-a"), re.I | re.M):
            raise Absent("no locale de_DE.UTF-8 here; localedef -i de_DE -f UTF-8 de_DE.UTF-8")
        return self.suite("german_locale", LC_ALL="de_DE.UTF-8")

    def odd_temporary_names(self):
        return self.suite("odd_temporary_names", folder=self.work / "tmp" / "a b's")

    def memory_as_disk(self):
        if common.run("stat", "-f", "-c", "%T", "/dev/shm").strip() != "tmpfs":
            raise Absent("no tmpfs at /dev/shm")
        folder = pathlib.Path(common.run("mktemp", "-d", "/dev/shm/odd_machines.XXXXXX").strip())
        try:
            return self.suite("memory_as_disk", folder=folder)
        finally:
            common.run("rm", "-rf", folder)

    def busy(self):
        loops = [subprocess.Popen(["sh", "-c", "while :; do :; done"]) for _ in range(3)]
        try:
            return self.suite("busy")
        finally:
            for loop in loops:
                loop.kill()

    def isa(self, name):
        flags = re.search("^flags.*: (.*)", pathlib.Path("/proc/cpuinfo").read_text(), re.M)[1].split()
        if name not in ("generic", *flags, *(["avx512"] if "avx512f" in flags else [])):
            raise Absent(f"this CPU lacks {name}")
        return self.suite(f"isa_{name}", SEMFIELD_ISA=name)

    def odd_checkout(self):
        copy = self.work / "tmp" / "a b's" / "semfield"
        copy.mkdir(parents=True)
        files = "git ls-files -z --cached --others --exclude-standard"
        common.run("sh", "-c", f'{files} | xargs -0 cp --parents -t "$0"', copy, cwd=common.ROOT)
        common.run("cmake", "--preset", "release", cwd=copy)
        common.run("cmake", "--build", "--preset", "release", cwd=copy)
        return self.suite("odd_checkout", build=copy / "build" / "release")


def odd_machines(words):
    """Runs the suite as other machines would: one core, sixteen, another user, another locale, odd temporary folders,
a busy machine, every instruction set. odd_checkout builds in a folder of an odd name, and so is asked for by name.

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
    isas = re.search("^SEMFIELD_ISA:[^=]*=(.*)$", (build / "CMakeCache.txt").read_text(), re.M)
    known = ["one_core", "two_cores", "sixteen_cores", "another_user", "german_locale", "odd_temporary_names",
             "memory_as_disk", "busy", *(f"isa_{isa}" for isa in (isas and isas[1] or "generic").split(";"))]
    for condition in options.conditions:
        if condition not in (*known, "odd_checkout"):
            parser.error(f"there is no condition {condition}; known: {', '.join(known)}, odd_checkout")
    ran = failed = absent = 0
    with common.work_folder(options.keep) as work:
        work.chmod(0o755)
        runs = Conditions(build, ("-R", options.regex) if options.regex else (), work)
        for condition in options.conditions or known:
            log, code = work / f"{condition}.log", 1
            try:
                isa = condition.removeprefix("isa_")
                code = runs.isa(isa) if isa != condition else getattr(runs, condition)()
            except Absent as reason:
                absent += 1
                print(f"{condition}: not run: {reason}", flush=True)
                continue
            except common.Failed as error:
                common.say(f"{condition}: {error}")
            ran, failed = ran + 1, failed + (code != 0)
            text = log.read_text(errors="replace") if log.exists() else ""
            passed = re.search(r"tests passed.* out of (\d+)", text)
            print(f"{condition}: " + (f"{passed[1]} tests passed" if code == 0 else "failed"), flush=True)
            for name in re.findall(r"^\t *(\d+ - .*)", text, re.M) if code else []:
                print(f"    {name}", flush=True)
    print(f"odd_machines: conditions={ran} failed={failed} absent={absent}")
    return 1 if failed else 0
