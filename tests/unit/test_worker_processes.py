"""Work in several processes: all of it is done, what it says is heard, and it ends with who asked for it."""

import os
import signal
import time
from pathlib import Path

import pytest

from memcomp_lightning.errors import LostError
from memcomp_lightning.processes import processes, say


def squared(number):
    say(f"squaring {number}", os.getpid())
    return number**2


def never_done(folder):
    (Path(folder) / f"{os.getpid()}").touch()
    time.sleep(3600)


def test_all_work_is_done_elsewhere_and_what_it_says_is_heard():
    heard = []
    with processes(2, lambda text, process: heard.append((text, process))) as do:
        assert sorted(do(squared, range(5))) == [0, 1, 4, 9, 16]
    assert {text for text, _ in heard} == {f"squaring {n}" for n in range(5)}
    assert os.getpid() not in {process for _, process in heard}


def killed(_):
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_process_that_is_killed_is_told():
    with (
        pytest.raises(LostError, match=r"ended from outside.* What is finished is kept\."),
        processes(2, print) as do,
    ):
        list(do(killed, range(3)))


def test_an_error_between_two_results_ends_work_that_would_never_end(tmp_path):
    def interrupted():
        with processes(2, print) as do:
            do(never_done, [tmp_path] * 3)
            while len(list(tmp_path.iterdir())) < 2:
                time.sleep(0.01)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    for path in tmp_path.iterdir():
        with pytest.raises(ProcessLookupError):
            os.kill(int(path.name), 0)
