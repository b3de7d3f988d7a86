"""Files are written whole, and what a killed process had begun is taken away by the next."""

import os
import platform
import subprocess
import sys
from pathlib import Path

from memcomp_lightning import files

BEGUN = """
import os, signal, sys
from pathlib import Path
from memcomp_lightning.files import written_whole

with written_whole(Path(sys.argv[1])) as partial:
    partial.write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_process_had_begun_is_taken_away(tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-c", BEGUN, tmp_path / "a.json"], check=False)
    (begun,) = tmp_path.iterdir()
    assert begun.read_text() == "half"
    machine = platform.node().partition(".")[0]
    of_others = [f".a.json.{machine}.{os.getppid()}.partial", f".a.json.{machine}2.1.partial", ".a.partial", "a.b"]
    for name in of_others:
        (tmp_path / name).touch()
    files.write_json(tmp_path / "b.json", {})
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["b.json", *of_others])
