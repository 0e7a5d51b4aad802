"""`./dev` on machines of every kind, with stand-ins for Python and the installer: no downloads."""

import fcntl
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[2]
TOOLS = (
    *("bash", "cat", "cksum", "cut", "dirname", "env", "flock"),
    *("getconf", "mkdir", "rm", "sleep", "tail", "uname"),
)

# Creates what ./dev expects of a virtual environment and notes every call.
INSTALLER = """#!/usr/bin/env bash
echo "$@" >>{log}
[[ $1 == venv || ! -e {failing} ]] || {{ echo "no route to host"; exit 1; }}
if [[ $1 == venv ]]; then
    venv=${{@: -1}}
    mkdir -p "$venv/bin"
    printf '#!/bin/sh\\n[ "$2" = pip ] && echo "pip $*" >>{log} || exec {python} "$@"\\n' \\
        >"$venv/bin/python"
    printf '#!/bin/sh\\necho "$PWD|$*|$RMW_IMPLEMENTATION|$PYTHONPATH"\\n' >"$venv/bin/geoorbit"
    {chmod} +x "$venv"/bin/*
fi
"""


@dataclass
class Machine:
    """A checkout whose path has a space, and a PATH that holds only what the test puts there."""

    folder: Path

    @property
    def checkout(self) -> Path:
        return self.folder / "my checkout"

    def add_command(self, name: str, text: str) -> None:
        path = self.folder / "bin" / name
        path.write_text(text)
        path.chmod(0o755)

    def add_python(self, name: str, version: str = "3.12") -> None:
        """A Python of some version, as far as ./dev can tell."""
        self.add_command(
            name,
            '#!/bin/sh\ncase "$*" in\n'
            f"-VV | -V) echo 'Python {version}' ;;\n"
            f"*sys.executable*) echo {self.folder}/bin/{name} ;;\n"
            "*ensurepip*) exit 1 ;;\n"
            f"*) echo {version} ;;\nesac\n",
        )

    def add_installer(self) -> None:
        text = INSTALLER.format(
            log=self.log, failing=self.failing, python=sys.executable, chmod=shutil.which("chmod")
        )
        self.add_command("uv", text)

    @property
    def log(self) -> Path:
        return self.folder / "installer.log"

    @property
    def failing(self) -> Path:
        return self.folder / "installer_fails"

    def installations(self) -> int:
        """How often the pinned requirements were installed so far."""
        return self.log.read_text().count("lock.txt") if self.log.exists() else 0

    def dev(self, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [self.checkout / "dev", *arguments],
            cwd=self.folder,
            env={"PATH": str(self.folder / "bin"), **variables},
            capture_output=True,
            text=True,
            timeout=240,
        )


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    machine = Machine(tmp_path)
    (tmp_path / "bin").mkdir()
    for tool in TOOLS:
        if found := shutil.which(tool):
            (tmp_path / "bin" / tool).symlink_to(found)
    (machine.checkout / "requirements").mkdir(parents=True)
    for name in ("dev", "setup.py", "setup.cfg", "requirements/lock.txt", "requirements/torch.txt"):
        shutil.copy2(REPOSITORY / name, machine.checkout / name)
    return machine


def test_a_python_that_only_pretends_to_be_there_is_passed_over(machine: Machine) -> None:
    machine.add_command("python3.12", "#!/bin/sh\necho 'pyenv: no such version' >&2\nexit 127\n")
    machine.add_python("python3.11", "3.11")
    machine.add_installer()
    done = machine.dev("run", "--version")
    assert done.returncode == 0, done.stderr
    assert f"Making .venv with Python 3.11 ({machine.folder}/bin/python3.11)" in done.stderr


def test_a_machine_without_a_suitable_python_is_told_what_was_tried(machine: Machine) -> None:
    machine.add_python("python3", "3.9")
    done = machine.dev("test")
    assert done.returncode == 1
    assert "needs Python 3.11 or 3.12" in done.stderr
    assert "python3.12: not there or not running" in done.stderr
    assert "python3: 3.9" in done.stderr
    assert not (machine.checkout / ".venv").exists()


def test_a_python_without_venv_names_the_package_to_install(machine: Machine) -> None:
    machine.add_python("python3.12")
    done = machine.dev("check")
    assert done.returncode == 1
    assert "has no venv module" in done.stderr
    assert "sudo apt install" in done.stderr


def test_the_environment_is_made_once_and_again_when_the_requirements_change(
    machine: Machine,
) -> None:
    machine.add_python("python3.12")
    machine.add_installer()
    assert machine.dev("run").returncode == 0
    assert machine.dev("run").returncode == 0
    assert machine.installations() == 1
    assert "pip -m pip install" in machine.log.read_text(), "PyTorch needs pip, even beside uv"
    with (machine.checkout / "requirements" / "lock.txt").open("a") as lock:
        lock.write("another==1.0\n")
    assert machine.dev("run").returncode == 0
    assert machine.installations() == 2


def test_an_environment_that_is_current_waits_for_no_other_command(machine: Machine) -> None:
    machine.add_python("python3.12")
    machine.add_installer()
    assert machine.dev("run").returncode == 0
    folder = os.open(machine.checkout, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)  # as a command does that installs
        done = machine.dev("run")
    finally:
        os.close(folder)
    assert done.returncode == 0
    assert done.stderr == ""


def test_a_failed_installation_shows_its_log_and_is_not_taken_for_whole(machine: Machine) -> None:
    machine.add_python("python3.12")
    machine.add_installer()
    machine.dev("run")
    (machine.checkout / ".venv" / "requirements.stamp").unlink()
    machine.failing.touch()
    done = machine.dev("run")
    assert done.returncode != 0
    assert "no route to host" in done.stderr
    assert "could not install requirements/lock.txt" in done.stderr
    machine.failing.unlink()
    done = machine.dev("run")
    assert done.returncode == 0, done.stderr
    assert machine.installations() == 3


def test_run_keeps_the_callers_folder_and_arguments_and_drops_foreign_settings(
    machine: Machine,
) -> None:
    machine.add_python("python3.12")
    machine.add_installer()
    done = machine.dev(
        "run", "lanes", "--out", "a b", PYTHONPATH="/opt/ros/x", RMW_IMPLEMENTATION="rmw_other"
    )
    assert done.stdout == f"{machine.folder}|lanes --out a b||\n"


def test_an_unknown_command_lists_the_known_ones(machine: Machine) -> None:
    done = machine.dev("tset")
    assert done.returncode == 1
    assert "no command 'tset'" in done.stderr
    for command in ("demo", "test", "check", "bench", "run"):
        assert f"  {command} " in done.stderr


def test_the_script_runs_from_a_clone() -> None:
    assert os.access(REPOSITORY / "dev", os.X_OK)
    assert os.access(REPOSITORY / ".ci" / "run", os.X_OK)
