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


def add_systems(parser):
    parser.add_argument("--folder", default=f"/var/tmp/semfield_{parser.prog.split()[-1]}",
                        help="where systems and logs lie (default: %(default)s)")
    parser.add_argument("--mirror", metavar="URL", help="of Debian's packages (default: that of this machine's apt)")
    parser.add_argument("--ccache", metavar="FOLDER", help="the compiler's cache in the systems (default: none)")


def need(program, packages):
    if not shutil.which(program):
        common.run("sh", "-c", f"apt-get update -qq && {NO_QUESTIONS} {packages}")


class Systems:
    def __init__(self, options):
        if os.geteuid() != 0:
            raise common.Failed("chroots need root; run it as root")
        need("debootstrap", "debootstrap")
        self.mirror = options.mirror or (common.run(
            "apt-get", "indextargets", "--format", "$(REPO_URI)", "Created-By: Packages", "Origin: Debian",
            "Label: Debian").splitlines() or [None])[0]
        if self.mirror is None:
            raise common.Failed("apt names no Debian mirror; run apt-get update, or name one with --mirror")
        # The way to the mirror that this machine's apt takes.
        proxies = common.run("apt-config", "shell", "http_proxy", "Acquire::http::Proxy", "https_proxy",
                             "Acquire::https::Proxy")
        self.environment = {**os.environ, **dict(word.split("=", 1) for word in shlex.split(proxies))}
        self.folder = pathlib.Path(options.folder).resolve()
        self.ccache = options.ccache and pathlib.Path(options.ccache).resolve()
        for folder in filter(None, (self.folder, self.ccache)):
            folder.mkdir(parents=True, exist_ok=True)
        self.lock = open(self.folder / "lock", "w", encoding="utf-8")
        try:
            fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise common.Failed(f"another run works in {self.folder}") from None

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

    def inside(self, system, command, log):
        """Exit code of the command in the system; what it prints goes to the end of `log`."""
        with open(log, "a", encoding="utf-8") as file:
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


def bare(words):
    """Shows that README's two commands work on bare machines: makes bare Debian systems, clones the checkout's HEAD
into each and runs ./scripts/demo and ./scripts/test there. As root, on Debian.

The last line of each suite names exit code, tests and warnings of the compiler. SUITE.log has what the steps printed,
and SUITE.STEP.log what the tools of its build did."""
    commands = {"build": "./scripts/setup", "demo": "./scripts/demo", "test": "./scripts/test"}
    parser = common.parser_of(bare)
    parser.add_argument("suites", nargs="*", metavar="SUITE", help="default: bookworm trixie")
    parser.add_argument("--steps", default="demo test", help="which of build, demo and test, in this order")
    parser.add_argument("--ctest", default="", metavar="ARGUMENTS", help='for ctest, e.g. --ctest="-R Isa"')
    parser.add_argument("--keep", action="store_true", help="leave systems and builds; the next run starts from there")
    add_systems(parser)
    options = parser.parse_args(words)
    for step in options.steps.split():
        if step not in commands:
            parser.error(f"--steps: '{step}' is none of {', '.join(commands)}")
    systems, worst = Systems(options), 0
    for suite in options.suites or ["bookworm", "trixie"]:
        log, code, warnings, begin = systems.folder / f"{suite}.log", 0, 0, time.monotonic()
        if not options.keep:
            systems.remove(systems.folder / suite)
        log.write_text("")
        system = systems.make(suite, suite)
        clone_head(system)
        for step in options.steps.split():
            command = f"{commands[step]} {options.ctest if step == 'test' else ''}"
            common.say(f"{suite}: {command}; what it prints: {log}")
            code = systems.inside(system, f"cd semfield && {command}", log)
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
        if not options.keep:
            systems.remove(system)
        print(f"bare: {suite} exit={code} tests={tests} failed={failed} skipped={text.count('***Skipped')} "
              f"warnings={warnings} minutes={(time.monotonic() - begin) / 60:.0f}", flush=True)
        worst = max(worst, code != 0)
    return int(worst)


class Packages:
    """Builds, installs, uses and purges the packages; what is wrong is said and counted."""

    def __init__(self, systems, suite):
        self.systems, self.suite, self.log = systems, suite, systems.folder / f"{suite}.log"
        self.log.write_text("")
        self.figures, self.wrongs = {}, 0

    def check(self, good, text):
        if not good:
            self.wrongs += 1
            common.say(f"WRONG: {text}")
        return good

    def inside(self, command, system=None):
        return self.systems.inside(system or self.system, command, self.log) == 0

    def printed(self):
        return self.log.read_text(errors="replace")

    def build(self):
        """On this machine if it has the suite, else of HEAD in a system of that suite, with its compiler and Python."""
        if f"VERSION_CODENAME={self.suite}\n" in pathlib.Path("/etc/os-release").read_text():
            common.run("bash", "-c", BUILD, cwd=common.ROOT)
            return common.ROOT / "build/package/packages"
        builder = self.systems.make(self.suite, f"{self.suite}.builder")
        clone_head(builder)
        more = re.search('SEMFIELD_MORE_PACKAGES="[^"]*', (common.ROOT / "scripts" / "test").read_text())[0]
        more += ' dpkg-dev file"'
        if not self.inside(f"cd semfield && {more} SEMFIELD_PRESET=package ./scripts/setup && {BUILD}", builder):
            raise common.Failed("the packages cannot be built")
        return builder / "root/semfield/build/package/packages"

    def lintian(self, files):
        names = {common.run("dpkg-deb", "-f", file, "Package").strip() for file in files}
        self.figures["deb"] = len(files)
        for name in ("semfield", "libsemfield-dev", "python3-semfield"):
            self.check(name in names, f"there is no package {name}")
        words = ["lintian", "--allow-root", "--tag-display-limit", "0", *files]
        found = subprocess.run(words, capture_output=True, text=True).stdout
        common.say("lintian: " + found)
        self.figures["lintian_errors"] = len(re.findall("^E:", found, re.M))
        self.check(self.figures["lintian_errors"] == 0, "lintian names errors")

    def listing(self):
        """Files of the system."""
        words = " -o ".join(f"-path ./{path}" for path in UNWATCHED)
        found = common.run("sh", "-c", rf"find . -xdev \( {words} \) -prune -o -print", cwd=self.system)
        return set(found.splitlines())

    def demo(self):
        """As a user without rights, in an empty folder, without a network: the shipped files are only read."""
        self.inside("cd /home/guest && mkdir empty && chown guest empty && cd empty && unshare --net setpriv "
                    "--reuid=guest --regid=guest --clear-groups env HOME=/home/guest semfield demo")
        found = re.findall(r"^demo: miou_present=([0-9.]+) ", self.printed(), re.M)
        self.figures["demo_miou"] = float(found[-1]) if found else None
        self.check(found and 0.6 < float(found[-1]) < 1, f"the demo has no mIoU above 0.6: {found}")

    def python(self):
        self.check(self.inside("python3 -c 'import semfield; print(semfield.__file__)'"), "import semfield fails")
        # In a copy of the system, since the tools of the tests leave traces of their own.
        tests = self.systems.copy(self.system, f"{self.suite}.tests")
        checkout = tests / "root" / "checkout"
        for name in ("tests/python", "examples", "scenes", "configs", "docs", "python/docs"):
            shutil.copytree(common.ROOT / name, checkout / name)
        self.check(self.inside(f"{NO_QUESTIONS} python3-pytest python3-nbconvert python3-ipykernel mypy", tests),
                   "the tools of the tests cannot be installed")
        # A shell in the background ignores SIGINT, and so would the tests of Ctrl-C.
        self.check(self.inside("cd checkout && SEMFIELD_TEST_INSTALLED=1 SEMFIELD_PROGRAM=/usr/bin/semfield "
                               "PYTHONDONTWRITEBYTECODE=1 env --default-signal=INT "
                               "python3 -m pytest -rs -p no:cacheprovider tests/python", tests),
                   "tests of the Python module fail")
        self.systems.remove(tests)
        text = self.printed()
        number = lambda pattern: sum(map(int, re.findall(pattern, text, re.M)))
        collected, passed = number(r"collected (\d+) item"), number(r"^=+ .*?(\d+) passed.* =+$")
        self.figures.update(python_tests=collected, passed=passed)
        # A skip is no pass; one without a CUDA device is none of the packages' fault either.
        no_device = number(r"^SKIPPED \[(\d+)\] .*no CUDA device")
        self.check(passed + no_device == collected > 0,
                   f"of {collected} tests of the Python module {passed} pass, and {no_device} have no CUDA device")

    def install(self, files):
        base = self.systems.make(self.suite, f"{self.suite}.base")
        self.system = self.systems.copy(base, self.suite)
        (self.system / "root/packages").mkdir()
        for file in files:
            shutil.copy(file, self.system / "root/packages")
        self.check(self.inside("apt-get update && useradd -m guest"), "apt-get update or useradd fails")
        self.inside(r"dpkg-query -W -f '${Package}\n' | sort >/root/packages.before")
        before = self.listing()
        if self.check(self.inside(f"{NO_QUESTIONS} ./packages/*.deb"), "the packages cannot be installed"):
            self.demo()
            self.python()
            # With all that came with them: autoremove would keep what a package of the bare system suggests or takes as
            # one of two (apt of Debian 13).
            self.check(self.inside("apt-get purge -y $(dpkg-query -W -f '${Package}\\n' | sort | "
                                   "comm -13 /root/packages.before -)"), "apt-get purge fails")
            after = self.listing()
            self.check(not after - before, f"the removal leaves: {sorted(after - before)[:20]}")
            self.check(not before - after, f"the removal took what was there before: {sorted(before - after)[:20]}")
        self.systems.remove(self.system)

    def links(self):
        done = subprocess.run([common.ROOT / "scripts" / "docs_check"], capture_output=True, text=True)
        found = re.findall(r"^docs: .*links_broken=(\d+) ", done.stdout, re.M)
        self.figures["links_broken"] = int(found[-1]) if found else None
        self.check(done.returncode == 0 and found == ["0"],
                   f"links of the documents: {done.stdout[-800:]}{done.stderr[-800:]}")


def package(words):
    """Shows that the Debian packages work: builds them, looks at them with lintian, installs them by apt alone in a
bare Debian system, runs `semfield demo` there in an empty folder without a network, imports the Python module and runs
its tests, purges the packages, and compares the files of the system with those before. As root, on Debian.

Another suite than this machine's builds its packages in a system of its own. What the steps print is in
FOLDER/SUITE.log. The last line is `package: deb=... lintian_errors=... demo_miou=... python_tests=... passed=...
links_broken=...`."""
    parser = common.parser_of(package)
    parser.add_argument("suite", nargs="?", default="bookworm", metavar="SUITE", help="default: %(default)s")
    parser.add_argument("--packages", type=pathlib.Path, metavar="FOLDER", help="check those there; none are built")
    add_systems(parser)
    options = parser.parse_args(words)
    check = Packages(Systems(options), options.suite)
    try:
        need("lintian", "dpkg-dev lintian")
        files = sorted((options.packages or check.build()).resolve().glob("*.deb"))
        check.lintian(files)
        check.install(files)
        check.links()
    except (common.Failed, OSError) as failed:
        check.check(False, failed)
    if check.wrongs:
        common.say(f"{check.wrongs} things are wrong; what the steps printed: {check.log}")
    common.print_line("package", check.figures, {**dict.fromkeys(("deb", "lintian_errors"), "d"), "demo_miou": "",
                                                 **dict.fromkeys(("python_tests", "passed", "links_broken"), "d")})
    return 1 if check.wrongs else 0
