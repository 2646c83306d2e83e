"""Runs the scripts in processes forked from one that has loaded everything: seconds saved at every start.

As a program it is that process; it reads requests from standard input, one JSON object a line.
"""

import json
import os
import runpy
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
DEMO = (
    "experiment=demo data.resolution=16 data.num_train=3 data.num_val=1 data.num_test=1 trainer.max_seconds=null "
    "trainer.num_rays=32 trainer.target_samples=1024 trainer.log_every=1 ~trainer.callbacks.progress_bar "
    "field.resolutions=[8,16] sampler.grid.resolution=16 sampler.grid.num_slabs=4 +sampler.grid.num_probes=1024"
)
SMALL_DEMO = tuple(DEMO.split())


class Run:
    """A script that has been started.

    Args:
        name: of the script, without `.py`.
        arguments: of its command line.
        cwd: its working directory.
        user: as which it runs; None for the same.
        environment: variables beside those of this process.
    """

    _server: subprocess.Popen[str] | None = None

    def __init__(
        self, name: str, *arguments: object, cwd: Path, user: int | None = None,
        environment: Mapping[str, str] | None = None,
    ) -> None:  # fmt: skip
        self._folder = tempfile.TemporaryDirectory()
        Path(self._folder.name).chmod(0o777)
        request = {
            "script": str(ROOT / "scripts" / f"{name}.py"), "arguments": [str(a) for a in arguments], "cwd": str(cwd),
            "output": self._folder.name, "user": user, "environment": dict(environment or {}),
        }  # fmt: skip
        self.pid = int(self._ask(request))

    def wait(self) -> "subprocess.CompletedProcess[str]":
        """Its exit code (minus a signal's number) and what it wrote, once it has ended."""
        code = int(self._ask({"wait": self.pid}))
        out, err = (Path(self._folder.name, kind).read_text() for kind in ("stdout", "stderr"))
        self._folder.cleanup()
        return subprocess.CompletedProcess([], code, out, err)

    @classmethod
    def _ask(cls, request: dict[str, Any]) -> str:
        if cls._server is None or cls._server.poll() is not None:
            cls._server = subprocess.Popen(
                [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
        assert cls._server.stdin is not None
        assert cls._server.stdout is not None
        cls._server.stdin.write(json.dumps(request) + "\n")
        cls._server.stdin.flush()
        return cls._server.stdout.readline()


def run_script(name: str, *arguments: object, cwd: Path, **settings: Any) -> "subprocess.CompletedProcess[str]":
    """Run a script to its end."""
    return Run(name, *arguments, cwd=cwd, **settings).wait()


def fork(request: dict[str, Any]) -> int:
    """A child that runs the script as `python scripts/<name>.py <arguments>` would, in a process group of its own."""
    pid = os.fork()
    if pid:
        return pid
    code = 1
    try:
        os.setpgid(0, 0)
        for number, kind in ((1, "stdout"), (2, "stderr")):
            os.dup2(os.open(f"{request['output']}/{kind}", os.O_WRONLY | os.O_CREAT, 0o666), number)
        os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.chdir(request["cwd"])
        os.environ.update(request["environment"])
        sys.path += filter(None, request["environment"].get("PYTHONPATH", "").split(os.pathsep))
        if request["user"] is not None:
            os.setgid(request["user"])
            os.setuid(request["user"])
        sys.argv = [request["script"], *request["arguments"]]
        sys.path[0] = str(Path(request["script"]).parent)
        runpy.run_path(request["script"], run_name="__main__")
        code = 0
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:  # noqa: BLE001
        sys.excepthook(*sys.exc_info())
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def serve() -> None:
    sys.path[0] = str(ROOT / "tests")  # a child has its script's folder there
    from preload import load_everything

    load_everything()
    for line in sys.stdin:
        request = json.loads(line)
        if "wait" in request:
            answer = os.waitstatus_to_exitcode(os.waitpid(request["wait"], 0)[1])
        else:
            answer = fork(request)
        sys.stdout.write(f"{answer}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    serve()
