import os
import resource
import signal
import subprocess
import sys
import textwrap

import pytest

from darswin.utils import files
from darswin.utils.files import locked, remove_partial_files, replace_file


def python(code):
    """A process that runs the code."""
    command = [sys.executable, "-c", textwrap.dedent(code)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_the_new_file_takes_the_place_of_the_old(tmp_path):
    path = tmp_path / "new" / "a.txt"
    for content in ("one", b"two"):
        replace_file(path, content)
        assert path.read_text() == (content if content == "one" else "two")
    assert os.listdir(path.parent) == ["a.txt"]
    (tmp_path / "plain").write_text("")
    assert path.stat().st_mode == (tmp_path / "plain").stat().st_mode
    with pytest.raises(OSError, match=r"cannot write the file.*new"):
        replace_file(tmp_path / "new", b"x")
    assert sorted(os.listdir(tmp_path)) == ["new", "plain"]


@pytest.mark.slow
def test_what_a_kill_left_is_removed(tmp_path):
    done = python(f"""
        import os
        from darswin.utils.files import replace_file
        os.fsync = lambda file: os._exit(9)
        replace_file({str(tmp_path / "a.ckpt")!r}, b"half")
    """)
    (left,) = tmp_path.iterdir()
    assert done.returncode == 9 and left.name.startswith(".a.ckpt.")
    (tmp_path / ".hidden").write_text("")
    remove_partial_files(tmp_path)
    assert os.listdir(tmp_path) == [".hidden"]


@pytest.mark.slow
def test_a_full_disk_leaves_the_old_file_alone(tmp_path):
    """A limit on file sizes stands for the full disk: writing fails in the same place."""
    path = tmp_path / "last.ckpt"
    path.write_text("old")
    done = python(f"""
        import resource, signal
        from darswin.utils.files import replace_file
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, {resource.RLIM_INFINITY}))
        replace_file({str(path)!r}, bytes(400_000))
    """)
    assert done.returncode == 1
    assert "last.ckpt" in done.stderr.splitlines()[-1] and "OSError" in done.stderr
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["last.ckpt"]


HOLD = """
import os, runpy, sys, time
with runpy.run_path(sys.argv[1])["locked"](sys.argv[2]):
    if os.fork():
        print(flush=True)
    time.sleep(60)
"""


@pytest.mark.slow
def test_a_kill_frees_a_lock_while_forks_live_on(tmp_path):
    path = tmp_path / "new" / "lock"
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, files.__file__, path],
        stdout=subprocess.PIPE,
        start_new_session=True,
    )
    try:
        holder.stdout.readline()
        with pytest.raises(BlockingIOError, match="another process"), locked(path):
            pass
        holder.kill()
        holder.wait()
        with locked(path):
            pass
    finally:
        os.killpg(holder.pid, signal.SIGKILL)
        holder.stdout.close()
