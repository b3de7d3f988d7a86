"""Tables: files, frames and arrays whose columns become units, each of the kind that its cells ask for."""

from memcomp_lightning.data.tables.schema import TableSchema
from memcomp_lightning.data.tables.table import Table, TableData, data_of, read_rows

__all__ = ["Table", "TableData", "TableSchema", "data_of", "read_rows"]
