"""Tables that users write: CSV in UTF-8 with a header, separated by commas or semicolons; `#` begins a comment."""

from __future__ import annotations

import csv
from pathlib import Path

from ladarreg_core.errors import FormatError
from ladarreg_core.formats.parsing.untrusted import one_line


def read_csv_table(file: Path, *, most_bytes: int, needs: str) -> tuple[list[str], list[list[str]]]:
    """Return the header of a table, in lower case, and its rows of stripped cells; both empty without a line.

    Args:
        file: the file.
        most_bytes: its largest size.
        needs: what such a table is, for messages, e.g. `a CSV with the columns scan and photo`.

    Raises:
        FormatError: if it is larger, no text, or its rows are damaged.
        OSError: if it cannot be read.
    """
    with open(file, "rb") as stream:
        data = stream.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise FormatError(f"it is larger than {most_bytes >> 20} MB; give {needs}")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise FormatError("it is no text in UTF-8; save the table as CSV in UTF-8") from None
    if "\0" in text:
        raise FormatError(f"it is no text; give {needs}")
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    delimiter = ";" if lines and ";" in lines[0] and "," not in lines[0] else ","
    try:
        table = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=delimiter, strict=True)]
    except csv.Error as error:
        raise FormatError(f"its rows are damaged ({one_line(error, 60)})") from None
    return ([cell.lower() for cell in table[0]], table[1:]) if table else ([], [])
