"""Bare Debian systems in folders (chroots), and what README's commands and packages do in them."""
import fcntl
import os
import pathlib
import re
import shlex
import shutil
import subprocess
import time

from . import common

# What is mounted here is seen by this call alone, and gone with its last process.
INSIDE = """
set -e
system=$1 ccache=$2
mount --make-rprivate /
mount -t proc proc "$system/proc"
mount --rbind /dev "$system/dev"
mount --bind -o ro /sys "$system/sys"
if [ -n "$ccache" ]; then mkdir -p "$system/ccache" && mount --bind "$ccache" "$system/ccache"; fi
exec env -i HOME=/root PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin \\
  ${ccache:+CCACHE_DIR=/ccache} ${http_proxy:+http_proxy="$http_proxy"} ${https_proxy:+https_proxy="$https_proxy"} \\
  chroot "$system" /bin/sh -c "cd /root && $3"
"""
NO_QUESTIONS = "DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends"
# Not of the system: what people keep, apt's and dpkg's books, and logs.
UNWATCHED = ("root home proc sys dev run tmp var/tmp var/lib/apt var/lib/dpkg var/cache var/log").split()
# Warnings are errors, as in continuous integration. A clean folder; the compiler's cache may help.
BUILD = """rm -rf build/package && cmake --preset package -DCMAKE_CXX_FLAGS=-Werror &&
cmake --build --preset package --parallel "$(nproc)" &&
cpack --config build/package/CPackConfig.cmake -B build/package/packages"""


def need(program, packages):
    if not shutil.which(program):
        common.run("sh", "-c", f"apt-get update -qq && {NO_QUESTIONS} {packages}")


class Systems:
    def __init__(self, folder, mirror, ccache):
        if os.geteuid() != 0:
            raise common.Failed("chroots need root; run it as root")
        need("debootstrap", "debootstrap")
        self.mirror = mirror or (common.run(
            "apt-get", "indextargets", "--format", "$(REPO_URI)", "Created-By: Packages", "Origin: Debian",
            "Label: Debian").splitlines() or [None])[0]
        if self.mirror is None:
            raise common.Failed("apt names no Debian mirror; run apt-get update, or name one with --mirror")
        # The way to the mirror that this machine's apt takes.
        proxies = common.run("apt-config", "shell", "http_proxy", "Acquire::http::Proxy", "https_proxy",
                             "Acquire::https::Proxy")
        self.environment = {**os.environ, **dict(word.split("=", 1) for word in shlex.split(proxies))}
        self.folder = folder.resolve()
        self.ccache = ccache and pathlib.Path(ccache).resolve()
        for folder in filter(None, (self.folder, self.ccache)):
            folder.mkdir(parents=True, exist_ok=True)
        self.lock = open(self.folder / "lock", "w", encoding="utf-8")
        try:
            fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise common.Failed(f"another run works in {self.folder}") from None

    def begin_log(self, suite):
        self.log = self.folder / f"{suite}.log"
        self.log.write_text("")
        return self.log

    def make(self, suite, name):
        """The bare system `name`, which is made where it is not there."""
        system, part = self.folder / name, self.folder / f"{name}.part"
        if not system.is_dir():
            common.say(f"{suite}: making a bare system from {self.mirror}")
            shutil.rmtree(part, ignore_errors=True)
            common.run("debootstrap", "--variant=minbase", suite, part, self.mirror, env=self.environment)
            apt = common.run("apt-config", "dump", "Acquire")
            kept = re.findall(r"^Acquire::(?:https?|check).*\n", apt, re.I | re.M)
            (part / "etc/apt/apt.conf.d/90machine").write_text("".join(kept))
            # A system that is thrown away need not survive a power cut.
            (part / "etc/dpkg/dpkg.cfg.d/90machine").write_text("force-unsafe-io\n")
            part.rename(system)
        for name in ("resolv.conf", "hosts"):
            shutil.copy(f"/etc/{name}", system / "etc")
        return system

    def remove(self, system):
        common.run("rm", "-rf", "--one-file-system", system)

    def copy(self, system, name):
        """A copy of a system under another name, in place of an older one."""
        self.remove(self.folder / name)
        common.run("cp", "-a", system, self.folder / name)
        return self.folder / name

    def inside(self, system, command):
        """Exit code of the command in the system; what it prints goes to the end of the log."""
        with open(self.log, "a", encoding="utf-8") as file:
            words = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "bash", "-c", INSIDE, "inside", system,
                     self.ccache or "", command]
            more = {"stdin": subprocess.DEVNULL, "stdout": file, "stderr": file}
            return subprocess.run(words, env=self.environment, **more).returncode


def clone_head(system):
    """HEAD of this checkout, in the system's /root/semfield."""
    to = system / "root" / "semfield"
    if not to.is_dir():
        common.run("git", "clone", "-q", "--no-hardlinks", "--no-checkout", common.ROOT, to)
    common.run("git", "-C", to, "fetch", "-q", common.ROOT, "HEAD")
    common.run("git", "-C", to, "checkout", "-q", "--force", "--detach", "FETCH_HEAD")


STEPS = {"build": "./scripts/setup", "demo": "./scripts/demo", "test": "./scripts/test"}


def bare(*suites: "default: bookworm trixie", steps: "which, in this order" = ("demo", "test"),
         ctest: 'for ctest, e.g. --ctest="-R Isa"' = "",
         keep: "leave systems and builds; the next run starts from there" = False,
         folder: "of systems and logs" = pathlib.Path("/var/tmp/semfield_bare"), mirror=None, ccache=None):
    """Shows that README's two commands work on bare machines: makes bare Debian systems, clones the checkout's HEAD
into each and runs ./scripts/demo and ./scripts/test there. As root, on Debian.

The last line of each suite names exit code, tests and warnings of the compiler. SUITE.log has what the steps printed,
and SUITE.STEP.log what the tools of its build did."""
    systems = Systems(folder, mirror, ccache)
    for suite in suites or ("bookworm", "trixie"):
        code, warnings, begin = 0, 0, time.monotonic()
        if not keep:
            systems.remove(systems.folder / suite)
        log = systems.begin_log(suite)
        system = systems.make(suite, suite)
        clone_head(system)
        for step in steps:
            command = f"{STEPS[step]} {ctest if step == 'test' else ''}"
            common.say(f"{suite}: {command}; what it prints: {log}")
            code = systems.inside(system, f"cd semfield && {command}")
            tools = system / "root/semfield/build/setup.log"
            built = tools.read_text(errors="replace") if tools.exists() else ""
            (systems.folder / f"{suite}.{step}.log").write_text(built)
            warnings += len(re.findall(r"(?::\d+|ld): warning:", built))
            if code != 0:
                break
        text = log.read_text(errors="replace")
        if code != 0:
            common.say("\n" + "\n".join(text.splitlines()[-30:]))
        # ctest says "99% tests passed, 2 tests failed out of 1300".
        counts = re.findall(r"^\d+% tests passed, (\d+) tests? failed out of (\d+)", text, re.M)
        failed, tests = counts[-1] if counts else (0, 0)
        if not keep:
            systems.remove(system)
        print(f"bare: {suite} exit={code} tests={tests} failed={failed} skipped={text.count('***Skipped')} "
              f"warnings={warnings} minutes={(time.monotonic() - begin) / 60:.0f}", flush=True)
        common.check(code == 0, f"{suite}: see {log}")


def build_packages(systems, suite):
    """On this machine if it has the suite, else of HEAD in a system of that suite, with its compiler and Python."""
    if f"VERSION_CODENAME={suite}\n" in pathlib.Path("/etc/os-release").read_text():
        common.run("bash", "-c", BUILD, cwd=common.ROOT)
        return common.ROOT / "build/package/packages"
    builder = systems.make(suite, f"{suite}.builder")
    clone_head(builder)
    more = re.search('SEMFIELD_MORE_PACKAGES="[^"]*', (common.ROOT / "scripts" / "test").read_text())[0]
    more += ' dpkg-dev file"'
    if systems.inside(builder, f"cd semfield && {more} SEMFIELD_PRESET=package ./scripts/setup && {BUILD}") != 0:
        raise common.Failed("the packages cannot be built")
    return builder / "root/semfield/build/package/packages"


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


def files_of(system):
    words = " -o ".join(f"-path ./{path}" for path in UNWATCHED)
    found = common.run("sh", "-c", rf"find . -xdev \( {words} \) -prune -o -print", cwd=system)
    return set(found.splitlines())


def test_python(systems, suite, system):
    """Figures of the tests of the Python module, in a copy of the system, since their tools leave traces."""
    tests = systems.copy(system, f"{suite}.tests")
    for name in ("tests/python", "examples", "scenes", "configs", "docs", "python/docs"):
        shutil.copytree(common.ROOT / name, tests / "root" / "checkout" / name)
    code = systems.inside(tests, f"{NO_QUESTIONS} python3-pytest python3-nbconvert python3-ipykernel mypy")
    common.check(code == 0, "the tools of the tests cannot be installed")
    # A shell in the background ignores SIGINT, and so would the tests of Ctrl-C.
    code = systems.inside(tests, "cd checkout && SEMFIELD_TEST_INSTALLED=1 SEMFIELD_PROGRAM=/usr/bin/semfield "
                                 "PYTHONDONTWRITEBYTECODE=1 env --default-signal=INT "
                                 "python3 -m pytest -rs -p no:cacheprovider tests/python")
    common.check(code == 0, "tests of the Python module fail")
    systems.remove(tests)
    text = systems.log.read_text(errors="replace")
    number = lambda pattern: sum(map(int, re.findall(pattern, text, re.M)))
    collected, passed = number(r"collected (\d+) item"), number(r"^=+ .*?(\d+) passed.* =+$")
    # A skip is no pass; one without a CUDA device is none of the packages' fault either.
    no_device = number(r"^SKIPPED \[(\d+)\] .*no CUDA device")
    common.check(passed + no_device == collected > 0,
                 f"of {collected} tests of the Python module {passed} pass, and {no_device} have no CUDA device")
    return {"python_tests": collected, "passed": passed}


def package(suite: "of Debian" = "bookworm", *, packages: "FOLDER of packages to check; none are built" = None,
            folder: "of systems and logs" = pathlib.Path("/var/tmp/semfield_package"), mirror=None, ccache=None):
    """Shows that the Debian packages work: builds them, looks at them with lintian, installs them by apt alone in a
bare Debian system, runs `semfield demo` there in an empty folder without a network, imports the Python module and runs
its tests, purges the packages, and compares the files of the system with those before. As root, on Debian.

Another suite than this machine's builds its packages in a system of its own. What the steps print is in
FOLDER/SUITE.log."""
    systems = Systems(folder, mirror, ccache)
    log = systems.begin_log(suite)
    files = sorted(pathlib.Path(packages or build_packages(systems, suite)).resolve().glob("*.deb"))
    figures = {"deb": len(files), "lintian_errors": lintian(files)}
    system = systems.copy(systems.make(suite, f"{suite}.base"), suite)
    (system / "root/packages").mkdir()
    for file in files:
        shutil.copy(file, system / "root/packages")

    def succeeds(command, fault):
        return common.check(systems.inside(system, command) == 0, f"{fault}; what the steps printed: {log}")

    succeeds("apt-get update && useradd -m guest", "apt-get update or useradd fails")
    systems.inside(system, r"dpkg-query -W -f '${Package}\n' | sort >/root/packages.before")
    before = files_of(system)
    if succeeds(f"{NO_QUESTIONS} ./packages/*.deb", "the packages cannot be installed"):
        # As a user without rights, in an empty folder, without a network: the shipped files are only read.
        succeeds("cd /home/guest && mkdir empty && chown guest empty && cd empty && unshare --net setpriv --reuid=guest "
                 "--regid=guest --clear-groups env HOME=/home/guest semfield demo", "the demo fails")
        found = re.findall(r"^demo: miou_present=([0-9.]+) ", log.read_text(errors="replace"), re.M)
        figures["demo_miou"] = float(found[-1]) if found else 0
        common.check(0.6 < figures["demo_miou"] < 1, "the demo has no mIoU above 0.6")
        succeeds("python3 -c 'import semfield; print(semfield.__file__)'", "import semfield fails")
        figures.update(test_python(systems, suite, system))
        # With all that came with them: autoremove would keep what a package of the bare system suggests or takes as
        # one of two (apt of Debian 13).
        succeeds("apt-get purge -y $(dpkg-query -W -f '${Package}\\n' | sort | comm -13 /root/packages.before -)",
                 "apt-get purge fails")
        after = files_of(system)
        common.check(not after - before, f"the removal leaves: {sorted(after - before)[:20]}")
        common.check(not before - after, f"the removal took what was there before: {sorted(before - after)[:20]}")
    systems.remove(system)
    return figures
