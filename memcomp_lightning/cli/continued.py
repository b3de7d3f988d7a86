"""``continue=FOLDER``: the settings of a finished run, and what is typed in place of some of them."""

from collections.abc import Sequence
from pathlib import Path

from memcomp_lightning.cli.arguments import expanded, from_folder, unquoted
from memcomp_lightning.configuration.continued import finished
from memcomp_lightning.configuration.quoting import with_path
from memcomp_lightning.errors import UserError

_BEGINS = ("continue", "model.weights")
"""Settings that say where a run began."""


def with_settings_of_run(arguments: Sequence[str]) -> list[str]:
    """Put the settings of the run that ``continue=FOLDER`` names before what is typed.

    What is typed takes the place of a setting of the run, another option of a group that of all settings in it.
    A setting that the run chose by held-out images keeps the value that was chosen.

    Raises:
        UserError: It is no run, or has not finished.
    """
    names = [argument.partition("=")[2] for argument in arguments if argument.startswith("continue=")]
    if not names or unquoted(names[-1]) in ("null", "None") or any(a.startswith("resume=") for a in arguments):
        return list(arguments)
    name = unquoted(names[-1])
    if not name:
        raise UserError("continue= names no folder: write continue=FOLDER, the folder of a run of memcomp-train.")
    folder = finished(Path(expanded("continue", name)).absolute())
    typed = [argument for argument in arguments if not argument.startswith("continue=")]
    earlier = [from_folder(override, folder.typed_in) for override in folder.overrides or []]
    if choice := (folder.result or {}).get("choice"):
        chosen = [f"{choice['setting']}={choice['value']}", "choose=null"]
        earlier = [*(o for o in earlier if _name(o) not in map(_name, chosen)), *chosen]
    options, given = ({_name(o): o.partition("=")[2] for o in some} for some in (earlier, typed))
    own = given.get("hydra.run.dir")
    if own is not None and Path(unquoted(own)).resolve() == folder.path.resolve():
        raise UserError(
            f"continue={name}: a run that goes on has a folder of its own: choose another hydra.run.dir."
        )
    anew = tuple(f"{name}." for name, option in given.items() if "." not in name and options.get(name) != option)
    kept = [o for o in earlier if _name(o) not in {*given, *_BEGINS} and not _name(o).startswith(anew)]
    return [*kept, *typed, with_path("continue", folder.path)]


def _name(override: str) -> str:
    return override.lstrip("+~").partition("=")[0]
