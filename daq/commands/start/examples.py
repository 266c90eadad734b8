"""Rig files that come with the package."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

from daq.base.contract.errors import ConfigError
from daq.rig.problems import did_you_mean

SHARED_FOLDER = "share/rotorscope/examples/"


def example_files() -> dict[str, Path]:
    """Name -> rig file: of the installation, or of the sources where it runs from these."""
    installed = []
    try:
        own = metadata.distribution("rotorscope")
        installed = [Path(str(own.locate_file(f))) for f in own.files or () if SHARED_FOLDER in f.as_posix()]
    except metadata.PackageNotFoundError:
        pass
    sources = Path(__file__).parents[3] / "configs"
    there = [path for path in installed if path.is_file()] or sorted(sources.glob("*"))
    return {path.stem: path.resolve() for path in sorted(there) if path.suffix == ".toml"}


def example(name: str) -> Path:
    """The rig file of an example. Raises ConfigError naming those that there are."""
    files = example_files()
    if name in files:
        return files[name]
    known = did_you_mean(name, list(files), "there are")
    raise ConfigError(f"--example {name}: there is no example of this name; {known}")
