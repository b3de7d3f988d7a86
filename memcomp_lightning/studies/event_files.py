"""TensorBoard's event files, which reports write where TensorBoard is installed."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter

log = logging.getLogger(__name__)


def write_event_file(folder: Path, write: Callable[["SummaryWriter"], None]) -> None:
    """Let ``write`` fill an event file of a folder; say so where TensorBoard is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ModuleNotFoundError:
        log.warning("TensorBoard is not installed: %s gets no event file. pip install tensorboard", folder)
        return
    with SummaryWriter(str(folder)) as writer:
        write(writer)
