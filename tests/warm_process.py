"""A process that has imported the heavy libraries, and a copy of itself for every command.

Starting Python and importing torch takes seconds; a copy of a process that has done so takes milliseconds. Each command
still has a process, a working folder and an environment of its own. Tests of starting itself use real new processes.
"""

import json
import os
import runpy
import subprocess
import sys
import tempfile
import traceback
import types
import warnings
from functools import cache
from pathlib import Path

HEAVY = (
    "torch.utils.data", "numba", "h5py", "gymnasium", "stable_baselines3", "huggingface_hub", "matplotlib.pyplot",
    "typer", "rich.console", "scipy.optimize", "PIL.Image", "yaml", "safetensors.torch", "tqdm",
)  # fmt: skip


class WarmProcess:
    """Use as a context manager; :meth:`run` is what `subprocess.run` is with captured text and no input.

    `env` decides what happens at import, so it is that of all commands.
    """

    def __init__(self, env=None):
        self.env = {**os.environ, **(env or {})}

    def __enter__(self):
        self.process = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env={**self.env, "MPLBACKEND": "Agg"},
        )  # fmt: skip
        return self

    def __exit__(self, *_):
        self.process.stdin.close()
        self.process.wait()
        self.process.stdout.close()

    def run(self, arguments, cwd=None, env=None):
        """Run ``navrep-data ARGUMENTS`` or, where the first one is ``-c``, a program.

        `env` replaces the environment; what is read at import (of huggingface_hub, say) has been read by then.
        """
        with tempfile.TemporaryDirectory() as folder:
            request = {
                "arguments": [str(a) for a in arguments],
                "cwd": str(cwd or Path.cwd()),
                "env": env,
                "folder": folder,
            }
            self.process.stdin.write(json.dumps(request) + "\n")
            self.process.stdin.flush()
            code = int(self.process.stdout.readline())
            out, err = (Path(folder, name).read_text() for name in ("out", "err"))
        return subprocess.CompletedProcess(arguments, code, out, err)


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
        else:
            sys.argv[:] = ["navrep-data", *arguments]
            runpy.run_module("navrep_data", run_name="__main__", alter_sys=True)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
        return 1
    return 0


def _serve():
    for name in HEAVY:
        __import__(name)
    for line in sys.stdin:
        pid = os.fork()
        if pid == 0:
            sys.exit(_become(json.loads(line)))
        _, status = os.waitpid(pid, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


if __name__ == "__main__":
    _serve()
