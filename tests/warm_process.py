"""A process that has imported the heavy libraries, and makes a copy of itself for every command.

Starting Python and importing torch takes seconds; a copy of a process that has done so takes milliseconds. Each command
still has a process, a working folder and an environment of its own. Tests of starting itself use real new processes.
"""

import atexit
import gc
import json
import os
import runpy
import subprocess
import sys
import tempfile
import threading
import traceback
import types
import warnings
from functools import cache
from pathlib import Path

HEAVY = (
    "torch.utils.data", "numba", "h5py", "gymnasium", "stable_baselines3", "huggingface_hub", "matplotlib.pyplot",
    "typer", "rich.console", "scipy.optimize", "PIL.Image", "yaml", "safetensors.torch", "tqdm",
    "navrep_data.cli.main",
)  # fmt: skip


class WarmProcess:
    """Use as a context manager; :meth:`run` is what `subprocess.run` is with captured text and no input.

    `env` decides what happens at import, so it is that of all commands. What `cold` names each command imports itself:
    a library that reads at import what differs between commands.
    """

    def __init__(self, env=None, cold=()):
        self.env = {**os.environ, **(env or {})}
        self.cold = cold

    def __enter__(self):
        self.process = subprocess.Popen(
            [sys.executable, __file__, *self.cold], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env={**self.env, "MPLBACKEND": "Agg"},
        )  # fmt: skip
        return self

    def __exit__(self, *_):
        self.process.stdin.close()
        self.process.wait()
        self.process.stdout.close()

    def start(self, arguments, cwd=None, env=None):
        """Start ``navrep-data ARGUMENTS``, a program after ``-c``, or a file whose name ends in ``.py``.

        `env` replaces the environment; what is read at import (of huggingface_hub, say) has been read by then. One
        command runs at a time: the next one starts when :meth:`Command.wait` has returned.
        """
        folder = tempfile.TemporaryDirectory()
        request = {
            "arguments": [str(a) for a in arguments],
            "cwd": str(cwd or Path.cwd()),
            "env": env,
            "folder": folder.name,
        }
        self.process.stdin.write(json.dumps(request) + "\n")
        self.process.stdin.flush()
        return Command(arguments, int(self.process.stdout.readline()), self.process.stdout, folder)

    def run(self, arguments, cwd=None, env=None):
        """Start a command, and wait until it has ended."""
        return self.start(arguments, cwd, env).wait()


class Command:
    """A command that runs."""

    def __init__(self, arguments, pid, answers, folder):
        self.arguments, self.pid, self.answers, self.folder = arguments, pid, answers, folder

    def send_signal(self, number):
        os.kill(self.pid, number)

    def wait(self):
        """Return the `subprocess.CompletedProcess`."""
        code = int(self.answers.readline())
        with self.folder as folder:
            out, err = (Path(folder, name).read_text() for name in ("out", "err"))
        return subprocess.CompletedProcess(self.arguments, code, out, err)


@cache
def shared():
    """Return one for all tests of this process, for its whole life."""
    return WarmProcess().__enter__()  # it ends when its input does


def _become(request):
    """In a copy: be a new process that runs the request. Returns its exit status."""
    os.chdir(request["cwd"])
    if request["env"] is not None:
        os.environ.clear()
        os.environ.update(request["env"])
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    for number, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(Path(request["folder"], name), os.O_WRONLY | os.O_CREAT), number)
    # these hold what belonged to the process copied from
    sys.stdin, sys.stdout, sys.stderr = (open(k, "w" if k else "r") for k in range(3))  # noqa: SIM115
    arguments = request["arguments"]
    try:
        if arguments[:1] == ["-c"]:
            sys.argv[:] = ["-c"]
            sys.path[0] = ""
            warnings.simplefilter("error")
            sys.modules["__main__"] = main = types.ModuleType("__main__")
            exec(compile(arguments[1], "<string>", "exec"), vars(main))  # noqa: S102
        elif arguments and arguments[0].endswith(".py"):
            sys.argv[:] = arguments
            sys.path[0] = str(Path(arguments[0]).parent)
            runpy.run_path(arguments[0], run_name="__main__")
        else:
            sys.argv[:] = ["navrep-data", *arguments]
            runpy.run_module("navrep_data", run_name="__main__", alter_sys=True)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def _end(code):
    """End as a process does, without taking all modules apart: of libraries this large that takes seconds."""
    try:
        threading._shutdown()
        atexit._run_exitfuncs()
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
    finally:
        os._exit(code)


def _serve(cold):
    for name in HEAVY:
        if name not in cold:
            __import__(name)
    # typer imports more when it has something to parse
    sys.modules["typer"].main.get_command(sys.modules["navrep_data.cli.main"].app).make_context("", ["info"])
    gc.freeze()  # a copy that collects garbage would touch, and so copy, all of this
    for line in sys.stdin:
        pid = os.fork()
        if pid == 0:
            _end(_become(json.loads(line)))
        print(pid, flush=True)
        _, status = os.waitpid(pid, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


if __name__ == "__main__":
    _serve(sys.argv[1:])
    _end(0)
