"""Tables: files, frames and arrays whose columns become units, each of the kind that its cells ask for."""

try:
    import pyarrow as _  # noqa: F401 (said once, and for all that reads tables)
except ModuleNotFoundError as missing:
    raise ModuleNotFoundError(
        "Tables need Arrow, which is not installed: pip install 'memcomp-lightning[tables]'.", name="pyarrow"
    ) from missing

from memcomp_lightning.data.tables.schema import TableSchema
from memcomp_lightning.data.tables.table import Table, TableData, data_of, read_rows

__all__ = ["Table", "TableData", "TableSchema", "data_of", "read_rows"]
