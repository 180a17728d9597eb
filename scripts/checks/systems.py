"""Bare Debian systems, and what README's commands and packages do in them. mmdebstrap makes a system and removes it."""
import os
import pathlib
import re
import shutil
import subprocess
import time

from . import common

# On this machine, in the system's folder: the script sees HEAD in semfield, what it is given in `in`, and what it
# leaves in `out` is kept.
HOOK = """set -e; cd "$1"
git clone -q --no-hardlinks "$CHECKOUT" root/semfield
mkdir root/out ccache && cp -a "$GIVEN" root/in
[ -z "$CCACHE" ] || mount --bind "$CCACHE" ccache
code=0
env -i HOME=/root PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin ${CCACHE:+CCACHE_DIR=/ccache} \\
  ${http_proxy:+http_proxy="$http_proxy"} ${https_proxy:+https_proxy="$https_proxy"} chroot . sh -c "$SCRIPT" || code=$?
[ -z "$CCACHE" ] || umount ccache
cp -a root/out/. "$KEPT" && echo "exit=$code" """
NO_QUESTIONS = "DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends"
# Warnings are errors, as in continuous integration. A clean folder; the compiler's cache may help.
BUILD = """rm -rf build/package && cmake --preset package -DCMAKE_CXX_FLAGS=-Werror &&
cmake --build --preset package --parallel "$(nproc)" &&
cpack --config build/package/CPackConfig.cmake -B build/package/packages"""


def need(program, packages):
    if not shutil.which(program):
        common.run("sh", "-c", f"apt-get update -qq && {NO_QUESTIONS} {packages}")


class Systems:
    """Runs scripts of the shell in bare systems of a suite; what they print and leave is in a folder."""

    def __init__(self, suite, folder, mirror, ccache):
        if os.geteuid() != 0:
            raise common.Failed("chroots need root; run it as root")
        need("mmdebstrap", "mmdebstrap")
        self.suite, self.mirror, self.folder = suite, [mirror] if mirror else [], folder.resolve()
        self.ccache = str(pathlib.Path(ccache).resolve()) if ccache else ""
        self.log, self.kept = self.folder / f"{suite}.log", self.folder / f"{suite}.out"
        for path in filter(None, (self.folder, self.ccache)):
            pathlib.Path(path).mkdir(parents=True, exist_ok=True)

    def run(self, script, given=None):
        """Exit code of the script in /root, and what it printed; `given` is a folder."""
        shutil.rmtree(self.kept, ignore_errors=True)
        self.kept.mkdir()
        common.say(f"{self.suite}: what it prints: {self.log}")
        # The way to the mirror that this machine's apt takes. What is thrown away need not survive a power cut.
        apt = re.findall(r"^Acquire::(?:https?|check).*", common.run("apt-config", "dump", "Acquire"), re.I | re.M)
        words = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc", "mmdebstrap", "--mode=root",
                 "--variant=minbase", "--dpkgopt=force-unsafe-io", *(f"--aptopt={line}" for line in apt),
                 f"--customize-hook={HOOK}", self.suite, "/dev/null", *self.mirror]
        environment = {**os.environ, "CHECKOUT": str(common.ROOT), "GIVEN": str(given or self.kept),
                       "CCACHE": self.ccache, "KEPT": str(self.kept), "SCRIPT": f"cd /root && {script}"}
        with open(self.log, "w", encoding="utf-8") as file:
            subprocess.run(words, env=environment, stdin=subprocess.DEVNULL, stdout=file, stderr=file)
        text = self.log.read_text(errors="replace")
        codes = re.findall(r"^exit=(\d+)$", text, re.M)
        if not codes:
            raise common.Failed(f"{self.suite}: no bare system: {text[-800:]}")
        return int(codes[-1]), text


def bare(*suites: "default: bookworm trixie", steps: "which, in this order" = ("demo", "test"),
         ctest: 'for ctest, e.g. --ctest="-R Isa"' = "", folder: "of logs" = pathlib.Path("/var/tmp/semfield_bare"),
         mirror=None, ccache=None):
    """Shows that README's two commands work on bare machines: makes bare Debian systems, clones the checkout's HEAD
into each and runs ./scripts/demo and ./scripts/test there. As root, on Debian.

The last line of each suite names exit code, tests and warnings of the compiler. SUITE.log has what the steps printed,
and SUITE.out what the tools of the build did."""
    commands = {"demo": "./scripts/demo", "test": f"./scripts/test {ctest}"}
    for suite in suites or ("bookworm", "trixie"):
        systems, begin = Systems(suite, folder, mirror, ccache), time.monotonic()
        kept = "; code=$?; cp build/setup.log ../out/{}.log; [ $code = 0 ] || exit $code"
        code, text = systems.run("cd semfield; " + "; ".join(commands[step] + kept.format(step) for step in steps))
        warnings = sum(len(re.findall(r"(?::\d+|ld): warning:", file.read_text(errors="replace")))
                       for file in systems.kept.iterdir())
        if not common.check(code == 0, f"{suite}: see {systems.log}"):
            common.say("\n" + "\n".join(text.splitlines()[-30:]))
        # ctest says "99% tests passed, 2 tests failed out of 1300".
        counts = re.findall(r"^\d+% tests passed, (\d+) tests? failed out of (\d+)", text, re.M)
        failed, tests = counts[-1] if counts else (0, 0)
        print(f"bare: {suite} exit={code} tests={tests} failed={failed} skipped={text.count('***Skipped')} "
              f"warnings={warnings} minutes={(time.monotonic() - begin) / 60:.0f}", flush=True)


def build_packages(systems):
    """On this machine if it has the suite, else of HEAD in a system of that suite, with its compiler and Python."""
    if f"VERSION_CODENAME={systems.suite}\n" in pathlib.Path("/etc/os-release").read_text():
        common.run("bash", "-c", BUILD, cwd=common.ROOT)
        return common.ROOT / "build/package/packages"
    more = re.search('SEMFIELD_MORE_PACKAGES="[^"]*', (common.ROOT / "scripts" / "test").read_text())[0]
    more += ' dpkg-dev file"'
    code, _ = systems.run(f"cd semfield && {more} SEMFIELD_PRESET=package ./scripts/setup && {BUILD} && "
                          "cp build/package/packages/*.deb ../out")
    if code != 0:
        raise common.Failed(f"the packages cannot be built: {systems.log}")
    out = systems.folder / f"{systems.suite}.packages"
    shutil.rmtree(out, ignore_errors=True)
    return systems.kept.rename(out)


def lintian(files):
    """Number of errors that it names."""
    need("lintian", "dpkg-dev lintian")
    names = {common.run("dpkg-deb", "-f", file, "Package").strip() for file in files}
    for name in ("semfield", "libsemfield-dev", "python3-semfield"):
        common.check(name in names, f"there is no package {name}")
    words = ["lintian", "--allow-root", "--tag-display-limit", "0", *files]
    found = subprocess.run(words, capture_output=True, text=True).stdout
    common.say("lintian: " + found)
    return len(re.findall("^E:", found, re.M))


# What is said of a step that fails, and its shell. What is not of the system is not listed: what people keep, apt's and
# dpkg's books, and logs. The demo runs as a user without rights, in an empty folder, without a network: the shipped
# files are only read. What is purged is all that came with the packages: autoremove would keep what a package of the
# bare system suggests or takes as one of two (apt of Debian 13). A shell in the background ignores SIGINT, and so would
# tests of Ctrl-C. Every installed Debian has /etc/hosts; where none is, netbase of Debian 13 makes one, which a purge leaves.
FILES = r"find / -xdev \( " + " -o ".join(
    f"-path /{path}" for path in ("root home proc sys dev run tmp ccache var/tmp var/lib/apt var/lib/dpkg var/cache "
                                  "var/log").split()) + r" \) -prune -o -print | sort"
PACKAGES = r"dpkg-query -W -f '${Package}\n' | sort"
INSTALLED = [
    ("apt-get update or useradd fails", "echo 127.0.0.1 localhost >>/etc/hosts && apt-get update && useradd -m guest"),
    ("the packages cannot be installed",
     f"{PACKAGES} >packages.before; {FILES} >out/before; {NO_QUESTIONS} ./in/*.deb"),
    ("the demo fails",
     "(cd /home/guest && mkdir empty && chown guest empty && cd empty && unshare --net setpriv --reuid=guest "
     "--regid=guest --clear-groups env HOME=/home/guest semfield demo)"),
    ("import semfield fails", "python3 -c 'import semfield; print(semfield.__file__)'"),
    ("apt-get purge fails", f"apt-get purge -y $({PACKAGES} | comm -13 packages.before -)"),
    ("its files cannot be listed", f"{FILES} >out/after"),
    ("the tools of the tests cannot be installed",
     f"{NO_QUESTIONS} ./in/*.deb python3-pytest python3-nbconvert python3-ipykernel mypy"),
    ("tests of the Python module fail",
     "mkdir checkout && (cd semfield && cp -r --parents -t ../checkout tests/python tests/program.py examples scenes configs docs "
     "python/docs) && rm -r semfield && cd checkout && SEMFIELD_TEST_INSTALLED=1 SEMFIELD_PROGRAM=/usr/bin/semfield "
     "PYTHONDONTWRITEBYTECODE=1 env --default-signal=INT python3 -m pytest -rs -p no:cacheprovider tests/python"),
]


def package(suite: "of Debian" = "bookworm", *, packages: "FOLDER of packages to check; none are built" = None,
            folder: "of logs" = pathlib.Path("/var/tmp/semfield_package"), mirror=None, ccache=None):
    """Shows that the Debian packages work: builds them, looks at them with lintian, installs them by apt alone in a
bare Debian system, runs `semfield demo` there in an empty folder without a network, imports the Python module, purges
the packages, compares the files of the system with those before, and runs the tests of the module. As root, on Debian.

Another suite than this machine's builds its packages in a system of its own. What the steps print is in
FOLDER/SUITE.log."""
    systems = Systems(suite, folder, mirror, ccache)
    files = sorted(pathlib.Path(packages or build_packages(systems)).resolve().glob("*.deb"))
    figures = {"deb": len(files), "lintian_errors": lintian(files)}
    steps = [f"{{ {command}; }} || echo 'WRONG: {fault}'" for fault, command in INSTALLED]
    with common.work_folder() as given:
        for file in files:
            shutil.copy(file, given)
        _, text = systems.run("\n".join(steps), given)
    for fault in re.findall("^WRONG: (.*)", text, re.M):
        common.check(False, f"{fault}; what the steps printed: {systems.log}")
    found = re.findall(r"^demo: miou_present=([0-9.]+) ", text, re.M)
    figures["demo_miou"] = float(found[-1]) if found else 0
    common.check(0.6 < figures["demo_miou"] < 1, "the demo has no mIoU above 0.6")
    before, after = (set((systems.kept / name).read_text().splitlines()) for name in ("before", "after"))
    common.check(not after - before, f"the removal leaves: {sorted(after - before)[:20]}")
    common.check(not before - after, f"the removal took what was there before: {sorted(before - after)[:20]}")
    number = lambda pattern: sum(map(int, re.findall(pattern, text, re.M)))
    collected, passed = number(r"collected (\d+) item"), number(r"^=+ .*?(\d+) passed.* =+$")
    # A skip is no pass; one without a CUDA device is none of the packages' fault either.
    no_device = number(r"^SKIPPED \[(\d+)\] .*no CUDA device")
    common.check(passed + no_device == collected > 0,
                 f"of {collected} tests of the Python module {passed} pass, and {no_device} have no CUDA device")
    return {**figures, "python_tests": collected, "passed": passed}
