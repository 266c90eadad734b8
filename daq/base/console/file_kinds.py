"""Kinds of files by their ending: files that a result never replaces, and files given in place of a log."""

from __future__ import annotations

from pathlib import Path

LOG_MAGIC = b"\x89MCAP0\r\n"  # first and last bytes of an MCAP file
# Data files that `import` reads
IMPORTED_SUFFIXES = (
    ".npz", ".csv", ".tsv", ".lvm", ".mat", ".mf4", ".mdf", ".uff", ".unv", ".uf", ".wav", ".tdms", ".h5", ".hdf5",
    ".parquet",
)  # fmt: skip
NO_RECORDS = {
    ".toml": "is a rig file by its ending, and no log: rotorscope check {} says what is open in it",
    ".dbc": "is a DBC by its ending, and no log: rotorscope init --from {} makes a rig file of it",
}

OTHER_RESULTS = (".toml", ".dbc", ".rrd", ".html", ".json")  # endings of what other options write
CONTENT_OF_MAGIC = {
    b"PK\x03\x04": "is a ZIP archive: unpack it, and give the file that is in it",
    b"\x1f\x8b": "is compressed with gzip: unpack it first",
}
# First bytes of kinds of files: endings of the files that begin so, and what to say of others
KINDS_OF_MAGIC = {
    b"PK\x03\x04": ((".npz",), "is a ZIP archive or a spreadsheet: unpack it, or save the sheet as .csv"),
    b"\x1f\x8b": ((), CONTENT_OF_MAGIC[b"\x1f\x8b"]),
    b"\x89PNG": ((), "is a picture: give the data that it shows"),
    b"%PDF": ((), "is a PDF: give the data that it shows"),
    b"\x89HDF": ((".h5", ".hdf5", ".mat"), "is an HDF5 file by its first bytes: name it .h5"),
    b"MDF     ": ((".mf4", ".mdf"), "is an MDF file by its first bytes: name it .mf4"),
    LOG_MAGIC: ((".mcap",), "is a log by its first bytes: name it .mcap"),
}


def is_log(path: Path) -> bool:
    """Whether a file that can be read begins as a log."""
    return _head(path) == LOG_MAGIC


def content(path: Path) -> str:
    """Kind of a readable file that is given as a log, by its first bytes; "" where they do not show it."""
    head = _head(path)
    if not head:
        return "is empty: check that it is the right file, and whole"
    return next((said for magic, said in CONTENT_OF_MAGIC.items() if head.startswith(magic)), "")


def other_content(path: Path) -> str:
    """Kind of a readable file by its first bytes, where its ending is of another kind; else ""."""
    head = _head(path)
    found = (
        said
        for magic, (endings, said) in KINDS_OF_MAGIC.items()
        if head.startswith(magic) and path.suffix.lower() not in endings
    )
    return next(found, "")


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(len(LOG_MAGIC))


def another_ending(path: Path) -> str:
    """Error about the name of a new log whose ending is that of another kind; "" if the name is valid."""
    suffix = path.suffix.lower()
    if suffix not in (*IMPORTED_SUFFIXES, *OTHER_RESULTS):
        return ""
    return f'a log is no file that ends in "{path.suffix}"; choose a name that ends in .mcap'


def other_kind(path: Path) -> str:
    """Kind of a file that is given in place of a log, by its ending, and the command that takes it; "" if not known."""
    if path.suffix.lower() in IMPORTED_SUFFIXES:
        return f"is no log (.mcap); make one of it: rotorscope import {path} --rig RIG --out LOG.mcap"
    return NO_RECORDS.get(path.suffix.lower(), "").format(path)
