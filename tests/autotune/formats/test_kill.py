"""A process that is killed while it writes leaves the file that was, or the new one, and never half of it."""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from autotune.formats.atomic import write_atomic
from autotune.formats.canonical import dump_json
from autotune.formats.controller import controller_tree, read_controller, write_controller
from autotune.formats.yaml12 import dump_yaml
from tests.autotune.formats.samples import make_controller
from tests.autotune.tuning.cases import FAST_PROBLEM_YAML, small_controller, write_plant

pytestmark = pytest.mark.skipif(os.name != "posix", reason="SIGKILL")

OLD, NEW = make_controller(("x",)), make_controller(("x", "y", "z"))
# Writes the two contents in turn for ever; prints a line before the first so that the test knows when it has begun.
_FOR_EVER = """
import sys
from pathlib import Path
from autotune.formats.atomic import write_atomic
target, contents = Path(sys.argv[1]), [Path(name).read_text(encoding="utf-8") for name in sys.argv[2:]]
print("begun", flush=True)
while True:
    for content in contents:
        write_atomic(target, content)
"""
# Runs the command line and kills itself at one call of the operating system among those that write a file.
_AT_A_CALL = """
import os, signal, sys
name, count = sys.argv[1], int(sys.argv[2])
real = getattr(os, name)
def counted(*arguments, **options):
    global count
    count -= 1
    if count == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return real(*arguments, **options)
setattr(os, name, counted)
from autotune.cli.main import main
sys.exit(main(sys.argv[3:]))
"""


def test_killed_at_random_moments_the_file_is_always_whole(tmp_path: Path, repository: Path) -> None:
    texts = [dump_yaml(controller_tree(each)) for each in (OLD, NEW)]
    sources = [tmp_path / "old.txt", tmp_path / "new.txt"]
    for source, text in zip(sources, texts, strict=True):
        source.write_text(text, encoding="utf-8")
    target, rng, found = tmp_path / "out" / "controller.yaml", random.Random(7), set()
    target.parent.mkdir()
    for _ in range(8):
        command = [sys.executable, "-c", _FOR_EVER, str(target), *map(str, sources)]
        with subprocess.Popen(command, cwd=repository, stdout=subprocess.PIPE) as writer:
            assert writer.stdout is not None
            assert writer.stdout.readline() == b"begun\n"
            time.sleep(rng.uniform(0.0, 0.03))
            writer.kill()
        if target.exists():
            found.add(target.read_text(encoding="utf-8"))
    assert found <= set(texts)
    assert found
    # What the last kill left beside the target is hidden, and the next run sweeps it.
    assert all(path.name.startswith(".autotune-") for path in target.parent.iterdir() if path != target)
    write_atomic(target, texts[0])
    assert list(target.parent.iterdir()) == [target]


@pytest.mark.parametrize(("call", "count"), [("open", 1), ("fsync", 1), ("replace", 1), ("fsync", 2)])
def test_an_export_killed_at_each_step_of_writing(tmp_path: Path, repository: Path, call: str, count: int) -> None:
    source, out = tmp_path / "controller.yaml", tmp_path / "out.json"
    new_controller = small_controller()
    write_controller(source, new_controller)
    before = source.read_bytes()
    old, new = (dump_json(controller_tree(each)) for each in (OLD, new_controller))
    out.write_text(old, encoding="utf-8")
    arguments = ["export", str(source), "--target", "json", "-o", str(out)]
    done = subprocess.run(
        [sys.executable, "-c", _AT_A_CALL, call, str(count), *arguments],
        cwd=repository,
        capture_output=True,
        check=False,
    )
    assert done.returncode == -signal.SIGKILL, done.stderr
    assert source.read_bytes() == before
    # The folder is flushed after the new name stands: only then is it the new file.
    after_the_step = (call, count) == ("fsync", 2)
    assert out.read_text(encoding="utf-8") == (new if after_the_step else old)
    assert read_controller(out).controller == (new_controller if after_the_step else OLD)


def test_an_optimize_killed_in_the_middle_leaves_the_old_controller(tmp_path: Path, repository: Path) -> None:
    write_plant(tmp_path)
    (tmp_path / "problem.yaml").write_text(FAST_PROBLEM_YAML, encoding="utf-8")
    out = tmp_path / "controller.yaml"
    write_controller(out, OLD)
    command = [sys.executable, "-m", "autotune", "optimize", str(tmp_path / "identified.yaml")]
    command += ["--problem", str(tmp_path / "problem.yaml"), "-o", str(out)]
    for after_s in (0.4, 1.6):
        with subprocess.Popen(command, cwd=repository, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as worker:
            time.sleep(after_s)
            worker.kill()
        # On a machine that is through by then it is the new one, whole.
        read = read_controller(out).controller
        assert read == OLD or worker.returncode == 0
