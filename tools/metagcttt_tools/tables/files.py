"""CSV and parquet files as columns of numbers; whatever cannot be one is named."""

from collections.abc import Iterable
from pathlib import Path

from metagcttt_core.data import DatasetError
from metagcttt_core.data.bounds import check_memory
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv
import pyarrow.parquet as pq

_POINTER = b'version https://git-lfs'
_BYTES = 8  # of a number
_COPIES = 3  # the table, its numbers, and the rows made of them


def read_parquet(path: Path, columns: Iterable[str] | None = None) -> pa.Table:
    """A parquet file, or some of its columns.

    Raises:
        DatasetError: If it is missing, damaged, was never finished, or lacks a column.
    """
    try:
        # `partitioning` would make columns of folder names.
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            names = _checked(path, file.schema_arrow.names, columns)
            check_memory(_COPIES * _values(file.metadata, names) * _BYTES, str(path))
            return file.read(columns=names)
    except FileNotFoundError as error:
        raise DatasetError(f'{path}: no such file') from error
    # Damage anywhere in a file raises any of these.
    except (pa.ArrowException, OSError, MemoryError, OverflowError) as error:
        raise DatasetError(f'{path}: {_fault_of_parquet(path, error)}') from error


def read_csv(path: Path, delimiter: str, columns: Iterable[str]) -> pa.Table:
    """Some columns of a CSV file, whose first row has their names.

    Raises:
        DatasetError: If it is missing, no CSV, or lacks a column.
    """
    parsing = pa.csv.ParseOptions(delimiter=delimiter)
    try:
        with pa.csv.open_csv(path, parse_options=parsing) as file:
            names = _checked(path, file.schema.names, columns)
        return pa.csv.read_csv(
            path,
            parse_options=parsing,
            convert_options=pa.csv.ConvertOptions(include_columns=names),
        )
    except FileNotFoundError as error:
        raise DatasetError(f'{path}: no such file') from error
    except (pa.ArrowException, OSError, MemoryError) as error:
        raise DatasetError(f'{path}: cannot be read as CSV ({error})') from error


def numbers(table: pa.Table, name: str, where: str) -> np.ndarray:
    """A column as float64, (rows, values): one value, or as many as its lists have.

    Raises:
        DatasetError: If it holds no real numbers, or rows without a value or of other lengths.
    """
    column = table[name].combine_chunks()
    if column.null_count:
        row = pc.index(pc.is_null(column), True).as_py()
        raise DatasetError(f'{where}: {name} has no value in row {row}')
    if _is_list(column.type):
        lengths = pc.list_value_length(column)
        if len(lengths) and pc.min(lengths) != pc.max(lengths):
            row = pc.index(pc.not_equal(lengths, lengths[0]), True).as_py()
            raise DatasetError(
                f'{where}: {name} has {lengths[row]} values in row {row} and {lengths[0]} in the '
                'first'
            )
        width = lengths[0].as_py() if len(lengths) else 1
        if not width:
            raise DatasetError(f'{where}: {name} has no values, its lists are empty')
        column = column.flatten()
        if column.null_count:
            row = pc.index(pc.is_null(column), True).as_py() // width
            raise DatasetError(f'{where}: {name} has no value in row {row}')
    else:
        width = 1
    kind = column.type
    if not (pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind)):
        raise DatasetError(f'{where}: {name} must hold numbers, {_not_numbers(column)}')
    return column.to_numpy(zero_copy_only=False).astype(np.float64).reshape(len(table), width)


def _checked(path: Path, found: list[str], wanted: Iterable[str] | None) -> list[str]:
    names = list(dict.fromkeys(found if wanted is None else wanted))
    if repeated := [name for name in names if found.count(name) > 1]:
        raise DatasetError(f'{path}: has several columns named {repeated[0]!r}')
    if missing := [name for name in names if name not in found]:
        raise DatasetError(
            f'{path}: has no column {", ".join(map(repr, missing))} (there are: '
            f'{", ".join(map(repr, found))})'
        )
    return names


def _values(metadata: pq.FileMetaData, names: Iterable[str]) -> int:
    """Numbers in some columns, which a few bytes may repeat a billion times."""
    wanted = set(names)
    groups = (metadata.row_group(number) for number in range(metadata.num_row_groups))
    chunks = (group.column(number) for group in groups for number in range(group.num_columns))
    return sum(
        chunk.num_values for chunk in chunks if chunk.path_in_schema.split('.')[0] in wanted
    )


def _fault_of_parquet(path: Path, error: BaseException) -> str:
    if path.is_dir():
        return 'is a folder, expected a parquet file'
    with path.open('rb') as file:
        start = file.read(len(_POINTER))
        size = file.seek(0, 2)
        file.seek(max(size - 4, 0))
        end = file.read()
    if start == _POINTER:
        return 'is a pointer to a file that was not downloaded: run git lfs pull in its folder'
    if start[:4] == b'PAR1' and end != b'PAR1':
        return (
            'has no footer: its recording was interrupted, or it was not copied to its end; its '
            'rows cannot be read'
        )
    return f'is no parquet file, or damaged ({error})'


def _is_list(kind: pa.DataType) -> bool:
    return (
        pa.types.is_fixed_size_list(kind) or pa.types.is_list(kind) or pa.types.is_large_list(kind)
    )


def _not_numbers(column: pa.Array) -> str:
    """What a column holds instead; of text, the first that is no number."""
    if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
        for row, text in enumerate(column.to_pylist()):
            try:
                float(text)
            except ValueError:
                return f'got {text!r} in row {row}'
    return f'got {column.type}'
