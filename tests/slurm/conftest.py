"""A real Slurm of one node on loopback, for the tests in this folder: Debian's packages, no systemd, own files.

They need root on a Debian-like system without a Slurm of its own, and are asked for with WARMLENS_TEST_SLURM=1
(.ci/run), to make scans and the posterior; `make test-slurm` makes all of it there, and injects faults.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import psutil
import pytest

from warmlens.artifacts.names import CHUNKED

from ..workflow.conftest import Project, finished_campaign

BIN = Path(sys.executable).parent
PACKAGES = ("slurm-wlm", "slurm-wlm-basic-plugins", "munge")
# The executor plugin drops SLURM_CONF before its `srun`, which then looks here.
SYSTEM_CONF = Path("/etc/slurm/slurm.conf")
PARTITION = "test"
TARGET = "results/tiny/abc.h5"
PATIENCE = 900.0  # seconds for anything to end
FROM_NOTHING = "WARMLENS_TEST_FAULTS" in os.environ

CONFIGURATION = """\
ClusterName=warmlens-tests
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmdUser=root
SlurmctldPort={controller_port}
SlurmdPort={node_port}
CommunicationParameters=NoInAddrAny,NoCtldInAddrAny
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/controller
SlurmdSpoolDir={folder}/node
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
# neither cgroups nor an accounting database
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
JobCompType=jobcomp/filetxt
JobCompLoc={folder}/finished.log
MpiDefault=none
ReturnToService=2
# squeue must still know a job after its end: the executor plugin asks it
MinJobAge=300
SchedulerType=sched/backfill
SchedulerParameters=batch_sched_delay=0,sched_interval=1,bf_interval=2
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
# what can never start is refused, not queued for ever
EnforcePartLimits=ALL
KillWait=5
NodeName={host} NodeAddr=127.0.0.1 CPUs={cpus} CoresPerSocket={cpus} RealMemory={memory_mb}
PartitionName={partition} Nodes={host} Default=YES MaxTime=1-00:00:00 State=UP
"""


@dataclass
class Cluster:
    """A running Slurm; its files and logs lie in `folder`."""

    folder: Path
    daemons: list[subprocess.Popen[bytes]] = field(default_factory=list)

    @property
    def environment(self) -> dict[str, str]:
        """What a user's shell on this cluster has: its Slurm, and the environment with warmlens activated."""
        path = f"{BIN}{os.pathsep}{os.environ['PATH']}"
        return {**os.environ, "SLURM_CONF": str(self.folder / "slurm.conf"), "PATH": path, "NO_COLOR": "1"}

    def start(self) -> None:
        for name in ("controller", "node"):
            (self.folder / name).mkdir()
        key = self.folder / "munge.key"
        key.write_bytes(secrets.token_bytes(1024))
        key.chmod(0o400)
        host = socket.gethostname().partition(".")[0]
        ports = _free_ports(2)
        configuration = CONFIGURATION.format(
            folder=self.folder,
            host=host,
            controller_port=ports[0],
            node_port=ports[1],
            cpus=os.cpu_count(),
            memory_mb=int(0.8 * os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**20),
            partition=PARTITION,
        )
        (self.folder / "slurm.conf").write_text(configuration)
        SYSTEM_CONF.parent.mkdir(exist_ok=True)
        SYSTEM_CONF.symlink_to(self.folder / "slurm.conf")
        munge = [f"--{name}={self.folder}/munge.{name.partition('-')[0]}" for name in ("key-file", "socket")]
        munge += [f"--{name}-file={self.folder}/munged.{name}" for name in ("pid", "log", "seed")]
        self._daemon("munged", "--foreground", "--force", *munge)
        self.wait_for((self.folder / "munge.socket").exists, "munged")
        self._daemon("slurmctld", "-D", "-c")
        self._daemon("slurmd", "-D")
        self.wait_for(lambda: self.command("sinfo", "-h", "-o", "%T", check=False).strip() == "idle", "slurmd")

    def stop(self) -> None:
        if len(self.daemons) > 1:  # the controller has run
            self.command("scancel", "--full", f"--user={os.getuid()}", check=False)
            with contextlib.suppress(AssertionError):  # then the jobs are killed with the node
                self.wait_for(lambda: not self.queue(), "the last job to end")
        for daemon in reversed(self.daemons):
            daemon.terminate()
        for daemon in reversed(self.daemons):
            with contextlib.suppress(subprocess.TimeoutExpired):
                daemon.wait(timeout=20.0)
            daemon.kill()
        if SYSTEM_CONF.is_symlink() and SYSTEM_CONF.readlink() == self.folder / "slurm.conf":
            SYSTEM_CONF.unlink()

    def command(self, *words: str, check: bool = True) -> str:
        """Output of a Slurm command."""
        done = subprocess.run(words, capture_output=True, text=True, check=False, env=self.environment, timeout=60)
        if check and done.returncode:
            raise AssertionError(f"{' '.join(words)} failed:\n{done.stdout}\n{done.stderr}")
        return done.stdout

    def end_of(self, job: str) -> str:
        """Final state of a job that is waited for, as COMPLETED, FAILED, CANCELLED or TIMEOUT."""
        deadline = time.monotonic() + PATIENCE
        while (state := self.state(job)) in ("PENDING", "CONFIGURING", "RUNNING", "COMPLETING"):
            assert time.monotonic() < deadline, f"job {job} is still {state}"
            time.sleep(0.5)
        return state

    def processes(self, job: str) -> list[psutil.Process]:
        """What runs in a job."""
        found = psutil.process_iter(["environ"])
        return [process for process in found if (process.info["environ"] or {}).get("SLURM_JOB_ID") == job]

    def queue(self) -> list[str]:
        """Numbers of the jobs that wait, run or end."""
        return self.command("squeue", "-h", "-o", "%i", check=False).split()

    def state(self, job: str) -> str:
        """State of a job, as RUNNING or TIMEOUT."""
        found = re.search(r"JobState=(\w+)", self.command("scontrol", "show", "job", job))
        assert found, f"Slurm knows no job {job}"
        return found[1]

    def finished(self) -> list[str]:
        """A line for every job that has ended, as Slurm wrote it."""
        log = self.folder / "finished.log"
        return log.read_text().splitlines() if log.exists() else []

    def _daemon(self, *words: str) -> None:
        log = (self.folder / f"{words[0]}.out").open("wb")
        self.daemons.append(subprocess.Popen(words, stdout=log, stderr=log, env=self.environment))

    def wait_for(self, ready: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + 30.0
        while not ready():
            dead = [str(daemon.args) for daemon in self.daemons if daemon.poll() is not None]
            if dead or time.monotonic() > deadline:
                logs = "\n".join(path.read_text()[-2000:] for path in self.folder.glob("*.out"))
                raise AssertionError(f"waited for {what}; ended: {dead}\n{logs}")
            time.sleep(0.1)


@dataclass(frozen=True)
class Campaign:
    """A project whose posterior is computed on the cluster."""

    cluster: Cluster
    project: Project

    @property
    def arguments(self) -> list[str]:
        overlays = sorted(path.name for path in self.project.folder.glob("overlay-*.yaml"))
        return [TARGET, "--configfile", *overlays]

    def submit(self, *options: str) -> str:
        """Number of the job that runs the whole campaign in one allocation of two cores."""
        size = [
            "--cpus-per-task=2",
            "--mem-per-cpu=3G",
            f"--partition={PARTITION}",
            f"--chdir={self.project.folder}",
        ]
        script = self.project.folder / "workflow/slurm/campaign.sbatch"
        submit = ["sbatch", "--parsable", "--time=30", *size, *options, str(script), *self.arguments]
        return self.cluster.command(*submit).strip()

    def log(self, job: str) -> str:
        """What the campaign said in its allocation."""
        return (self.project.folder / f"warmlens-{job}.log").read_text()

    def run_in_one_allocation(self) -> str:
        job = self.submit()
        assert self.cluster.end_of(job) == "COMPLETED", self.log(job)
        return self.log(job)

    def executor(self, *options: str) -> list[str]:
        """Command that submits the campaign's jobs; this cluster has no accounting, nor much to wait for."""
        return [
            *(str(BIN / "snakemake"), *self.arguments, "--workflow-profile", "workflow/profiles/slurm"),
            *("--slurm-status-command", "squeue"),
            *("--slurm-init-seconds-before-status-checks", "2", "--seconds-between-status-checks", "2"),
            *("--default-resources", f"slurm_partition={PARTITION}", "mem_mb=3000", "runtime=60"),
            *options,
        ]

    def start_with_executor(self, *options: str) -> subprocess.Popen[bytes]:
        """The submitting Snakemake, at work; it writes to `executor.log`."""
        with (self.project.folder / "executor.log").open("ab") as log:
            return subprocess.Popen(
                self.executor(*options),
                cwd=self.project.folder,
                stdout=log,
                stderr=log,
                env=self.cluster.environment,
                start_new_session=True,
            )

    def run_with_executor(self, *options: str) -> str:
        process = self.start_with_executor(*options)
        try:
            code = process.wait(timeout=PATIENCE)
        finally:
            process.kill()
        log = (self.project.folder / "executor.log").read_text()
        assert code == 0, log
        return log

    def worker(self, stage: str) -> psutil.Process:
        """A running process of a stage, as soon as there is one."""
        deadline = time.monotonic() + PATIENCE / 3.0
        while time.monotonic() < deadline:
            for process in psutil.process_iter(["cmdline", "cwd"]):
                words = process.info["cmdline"] or []
                if words[1:4] == [str(BIN / "warmlens"), "stage", stage] and process.info["cwd"] == str(
                    self.project.folder
                ):
                    return process
            time.sleep(0.05)
        raise AssertionError(f"no {stage} was seen running")


def _free_ports(number: int) -> list[int]:
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(number)]
        for item in sockets:
            item.bind(("127.0.0.1", 0))
        return [item.getsockname()[1] for item in sockets]


def _is_left_over() -> bool:
    """Whether the system's configuration is the link of a test run that was killed."""
    if not SYSTEM_CONF.is_symlink():
        return False
    if not SYSTEM_CONF.exists():
        return True
    running = SYSTEM_CONF.resolve().with_name("slurmctld.pid")
    is_ours = SYSTEM_CONF.read_text().startswith(CONFIGURATION.partition("\n")[0])
    return is_ours and not (running.exists() and psutil.pid_exists(int(running.read_text())))


def _install() -> None:
    if os.environ.get("WARMLENS_TEST_SLURM") != "1":
        pytest.skip("starts a real Slurm; run `make test-slurm` as root")
    pytest.importorskip("snakemake_executor_plugin_slurm", reason="needs pip install 'warmlens[slurm]'")
    if os.geteuid() != 0:
        pytest.skip("Slurm's daemons need root")
    if _is_left_over():
        SYSTEM_CONF.unlink()
    if SYSTEM_CONF.exists():
        pytest.skip(f"{SYSTEM_CONF} exists: this machine has a Slurm already, which is left alone")
    if shutil.which("slurmctld") and shutil.which("slurmd") and shutil.which("munged"):
        return
    if shutil.which("apt-get") is None:
        pytest.skip("Slurm is not installed, and there is no apt-get to install it with")
    install = ["apt-get", "install", "-qq", "--no-install-recommends", *PACKAGES]
    for words in (["apt-get", "update", "-qq"], install):
        done = subprocess.run(
            words,
            capture_output=True,
            text=True,
            check=False,
            env={**os.environ, "DEBIAN_FRONTEND": "noninteractive"},
        )
        if done.returncode:
            raise AssertionError(f"{' '.join(words)} failed:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}")


@pytest.fixture(scope="session")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A running Slurm, installed if need be; it is taken down whatever happens."""
    _install()
    running = Cluster(tmp_path_factory.mktemp("slurm"))
    try:
        running.start()
        yield running
    finally:
        running.stop()


@pytest.fixture(scope="session")
def local(cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Project:
    """The campaign run on this machine, without Slurm; read it, do not change it."""
    return finished_campaign(tmp_path_factory)


@pytest.fixture
def half_done(cluster: Cluster, local: Project, tmp_path: Path) -> Campaign:
    """A campaign with lens and scan operator, and no sample; without faults only half the scans lack."""
    subprocess.run(["cp", "-a", f"{local.folder}/.", str(tmp_path)], check=True)
    project = Project(tmp_path)
    stages, chunks = (CHUNKED, "chunk-*") if FROM_NOTHING else (("scans", "summaries"), "chunk-0000007-*")
    for stage in stages:
        for path in (project.results / stage).glob(chunks):
            path.unlink()
    (project.folder / TARGET).unlink()
    return Campaign(cluster, project)


@pytest.fixture
def campaign(half_done: Campaign) -> Campaign:
    """A campaign of which nothing is there, or as much as `half_done`."""
    if FROM_NOTHING:
        shutil.rmtree(half_done.project.results)
        shutil.rmtree(half_done.project.folder / ".snakemake")
    return half_done
