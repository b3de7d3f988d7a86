"""What a file of a network says of its inputs and outputs."""

from typing import Any

from memcomp_lightning import __version__
from memcomp_lightning.trained.export.plain import Plain
from memcomp_lightning.trained.run import Run


def header(run: Run, found: Plain) -> dict[str, Any]:
    """Names of the inputs and outputs, and the schema: how cells of a table become inputs."""
    return {
        "version": __version__,
        "inputs": found.inputs,
        "output": found.output,
        "outputs": found.outputs,
        "schema": None if run.schema is None else run.schema.as_json(),
    }
